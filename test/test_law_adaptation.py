# SPDX-License-Identifier: Apache-2.0
"""The update laws (20) and (30) against numpy on random states, and when they freeze."""

from __future__ import annotations

import numpy as np
import pytest
from arbitrary_case import arbitrary
from closed_loop_case import controller, plant, quick, record

from blf_dsc_controller.law import adaptation, cholesky
from blf_dsc_controller.law.settings import UPDATES

DT = 1e-3
SHAPES = [(1, 1), (2, 3), (3, 4)]


def case(seed, n, p, *, latched=True, update='newton', **changes):
    """Random case whose latched window belongs to random regressor rows."""
    settings, state, signals = arbitrary(seed, n, p, update=UPDATES.index(update), **changes)
    rows = np.random.default_rng(seed).normal(size=(40, settings.m))
    state.Phi[:] = rows.T @ rows / len(rows)
    state.factor[:] = state.Phi + settings.rho * np.eye(settings.m)
    cholesky.factor(state.factor)
    state.latched[0] = latched
    return settings, state, signals


def tracking_part(settings, signals):
    """-Gamma H^T xi2 on the parameters, nothing on the columns."""
    rate = np.zeros(settings.m)
    rate[: settings.p] = -signals.H[:, : settings.p].T @ signals.xi2
    return settings.Gamma * rate


def prediction_part(settings, state):
    """Gamma kappa W (b - Phi theta^)."""
    eps = state.b - state.Phi @ state.estimate
    if settings.update == UPDATES.index('newton'):
        eps = np.linalg.solve(state.Phi + settings.rho * np.eye(settings.m), eps)
    return settings.Gamma * settings.kappa * eps


def estimates_after(settings, state, signals, *, saturated=False):
    adaptation.adapt(settings, state, signals, DT, saturated)
    return state.estimate.copy(), state.disturbance.copy()


@pytest.mark.parametrize('seed', range(5))
@pytest.mark.parametrize(('n', 'p'), SHAPES)
@pytest.mark.parametrize('update', UPDATES)
def test_update_is_the_written_law(seed, n, p, update):
    settings, state, signals = random_case = case(seed, n, p, update=update)
    rate = tracking_part(settings, signals) + prediction_part(settings, state)
    expected = state.estimate + DT * rate
    d3_rate = -state.gain_scale * settings.gamma * (signals.xi2 + settings.eta * state.disturbance)
    d3 = state.disturbance + DT * d3_rate

    estimate, disturbance = estimates_after(*random_case)

    np.testing.assert_allclose(estimate, expected, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(signals.rate, rate, rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(disturbance, d3, rtol=0.0, atol=1e-15)


@pytest.mark.parametrize(('n', 'p'), SHAPES)
def test_only_the_tracking_error_adapts_before_the_latch(n, p):
    settings, state, signals = random_case = case(1, n, p, latched=False)
    expected = state.estimate + DT * tracking_part(settings, signals)

    estimate, _ = estimates_after(*random_case)

    np.testing.assert_allclose(estimate, expected, rtol=0.0, atol=1e-14)


@pytest.mark.parametrize(('n', 'p'), SHAPES)
def test_only_the_prediction_error_adapts_at_a_torque_limit(n, p):
    settings, state, _ = random_case = case(2, n, p)
    expected = state.estimate + DT * prediction_part(settings, state)
    d3 = state.disturbance.copy()

    estimate, disturbance = estimates_after(*random_case, saturated=True)

    np.testing.assert_allclose(estimate, expected, rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(disturbance, d3)


@pytest.mark.parametrize('most', [np.inf, 1e-3])
@pytest.mark.parametrize('saturated', [False, True])
def test_learning_does_not_change_the_torque(saturated, most):
    """Only the tracking error changes H theta^ + d^3 (`bumpless`), also where a column is cut."""
    limits = {'least': np.full(7, -np.inf), 'most': np.append(np.full(6, np.inf), most)}
    settings, state, signals = random_case = case(8, 3, 4, bumpless=1, eta=0.0, **limits)
    state.estimate[-1] = 0.0
    gamma = state.gain_scale * settings.gamma
    change = signals.H @ tracking_part(settings, signals) - gamma * signals.xi2
    expected = signals.H @ state.estimate + state.disturbance + DT * change * (not saturated)
    learned = signals.H @ prediction_part(settings, state)

    estimate, disturbance = estimates_after(*random_case, saturated=saturated)

    assert np.abs(learned).min() > 0.1
    np.testing.assert_allclose(signals.H @ estimate + disturbance, expected, atol=1e-12)
    assert (estimate[-1] == most) == np.isfinite(most)


def test_newton_converges_at_the_same_rate_in_all_directions_unlike_gradient():
    """theta~ shrinks by 1 - Gamma kappa T per step for eigenvalues of Phi from 1e-2 to 1e2."""
    shrunk = {}
    for update in UPDATES:
        settings, state, signals = case(
            3, 2, 3, update=update, rho=1e-12, Gamma=np.full(5, 2.0), kappa=2.0
        )
        state.Phi[:] = np.diag([1e-2, 0.1, 1.0, 10.0, 100.0])
        state.factor[:] = state.Phi + settings.rho * np.eye(settings.m)
        cholesky.factor(state.factor)
        state.b[:] = 0.0  # the truth is zero
        state.estimate[:] = 1.0
        signals.xi2[:] = 0.0
        shrunk[update] = estimates_after(settings, state, signals)[0]
    np.testing.assert_allclose(shrunk['newton'], 1.0 - 2.0 * 2.0 * DT, rtol=1e-9)
    np.testing.assert_allclose(
        shrunk['gradient'], 1.0 - 2.0 * 2.0 * DT * np.array([1e-2, 0.1, 1.0, 10.0, 100.0])
    )


def test_parameters_are_projected_and_columns_are_not():
    settings, state, signals = case(4, 2, 3, latched=False, radius=1.0)
    p = settings.p
    state.estimate[:p] /= np.linalg.norm(state.estimate[:p]) * (1.0 - 1e-12)
    state.estimate[p:] = 50.0  # far outside, if they counted
    signals.xi2[:] *= np.sign(tracking_part(settings, signals)[:p] @ state.estimate[:p])  # outward
    v, w, Gamma = tracking_part(settings, signals)[:p], state.estimate[:p].copy(), settings.Gamma

    estimate, _ = estimates_after(settings, state, signals)

    assert w @ v > 0.0
    tangential = v - Gamma[:p] * w * (w @ v) / (w @ (Gamma[:p] * w))
    np.testing.assert_allclose(signals.rate[:p], tangential, atol=1e-12)
    assert np.linalg.norm(estimate[:p]) <= 1.0 + 1e-15
    np.testing.assert_array_equal(estimate[p:], 50.0)


def test_latched_window_has_no_effect_without_weight():
    """kappa = 0 is the law without learning, bit for bit."""
    latched, never = controller(quick(kappa=0.0)), controller(quick(sigma=np.inf))
    with_latch, without = (record(law, plant(), 1.5) for law in (latched, never))

    assert latched.state.latched[0] == 1.0
    assert never.state.latched[0] == 0.0
    np.testing.assert_array_equal(with_latch.torque, without.torque)
    np.testing.assert_array_equal(with_latch.estimate, without.estimate)


def test_disturbance_estimate_takes_nothing_over_before_the_latch():
    """The ball may move P^ then; (30) alone moves d^3."""
    settings, state, signals = random_case = case(6, 2, 3, latched=False, radius=1.0, bumpless=1)
    state.estimate[:3] *= 3.0 / np.linalg.norm(state.estimate[:3])
    d3_rate = -state.gain_scale * settings.gamma * (signals.xi2 + settings.eta * state.disturbance)
    d3 = state.disturbance + DT * d3_rate

    estimate, disturbance = estimates_after(*random_case)

    assert np.linalg.norm(estimate[:3]) < 1.1
    np.testing.assert_allclose(disturbance, d3, rtol=0.0, atol=1e-15)
