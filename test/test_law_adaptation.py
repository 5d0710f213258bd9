# SPDX-License-Identifier: Apache-2.0
"""The update laws (20) and (30), the projection onto the ball, and priors of different units."""

from __future__ import annotations

from math import sqrt

import numpy as np
import pytest
from closed_loop_case import arbitrary, closed_loop, controller, plant, quick, recommended, record
from hypothesis import given
from hypothesis import strategies as st
from plain_law import R, dynamics
from plants import QUIET
from scipy.linalg import eigh

from blf_dsc_controller.compiled import cholesky
from blf_dsc_controller.law import adaptation, excitation, window
from blf_dsc_controller.law.settings import COMPENSATIONS, UPDATES

DT = 1e-3


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


@pytest.mark.parametrize(('n', 'p'), [(1, 1), (2, 3), (3, 4)])
@pytest.mark.parametrize('update', UPDATES)
@pytest.mark.parametrize('mode', ['learning', 'not latched', 'saturated'])
def test_update_is_the_written_law(n, p, update, mode):
    """Before the latch only the tracking error adapts, at a torque limit only the prediction's.

    The tracking error adapts each parameter in its own scale, the variance of its prior.
    """
    scale = np.random.default_rng(0).uniform(0.01, 3.0, p + n)
    latched, saturated = mode != 'not latched', mode == 'saturated'
    settings, state, signals = case(n, n, p, latched=latched, update=update, variance=scale)
    rate, d3 = np.zeros(settings.m), state.disturbance.copy()
    if latched:
        rate += prediction_part(settings, state)
    if not saturated:
        rate += scale * tracking_part(settings, signals)
        d3 -= DT * state.gain_scale * settings.gamma * (signals.xi2 + settings.eta * d3)
    expected = state.estimate + DT * rate

    adaptation.adapt(settings, state, signals, DT, saturated)

    np.testing.assert_allclose(state.estimate, expected, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(signals.rate, rate, rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(state.disturbance, d3, rtol=0.0, atol=1e-15)


@pytest.mark.parametrize('most', [np.inf, 1e-3])
@pytest.mark.parametrize('saturated', [False, True])
def test_learning_does_not_change_the_torque(saturated, most):
    """Only the tracking error changes H theta^ + d^3 (`bumpless`), also where a column is cut."""
    limits = {'least': np.full(7, -np.inf), 'most': np.append(np.full(6, np.inf), most)}
    settings, state, signals = case(8, 3, 4, bumpless=1, eta=0.0, **limits)
    state.estimate[-1] = 0.0
    state.b[:] += 5.0 * (state.Phi + settings.rho * np.eye(settings.m))[:, -1]  # raises the last
    gamma = state.gain_scale * settings.gamma
    change = signals.H @ tracking_part(settings, signals) - gamma * signals.xi2
    expected = signals.H @ state.estimate + state.disturbance + DT * change * (not saturated)
    assert np.abs(signals.H @ prediction_part(settings, state)).min() > 0.1
    adaptation.adapt(settings, state, signals, DT, saturated)
    torque = signals.H @ state.estimate + state.disturbance
    np.testing.assert_allclose(torque, expected, atol=1e-12)
    assert (state.estimate[-1] == most) == np.isfinite(most)


def test_disturbance_estimate_takes_nothing_over_before_the_latch():
    """The ball may move P^ then; (30) alone moves d^3."""
    settings, state, signals = case(6, 2, 3, latched=False, radius=1.0, bumpless=1)
    state.estimate[:3] *= 3.0 / np.linalg.norm(state.estimate[:3])
    rate = state.gain_scale * settings.gamma * (signals.xi2 + settings.eta * state.disturbance)
    d3 = state.disturbance - DT * rate
    adaptation.adapt(settings, state, signals, DT, False)  # noqa: FBT003
    assert np.linalg.norm(state.estimate[:3]) < 1.1
    np.testing.assert_allclose(state.disturbance, d3, rtol=0.0, atol=1e-15)


RADIUS = 3.0
GAIN = np.array([0.05, 1.0, 20.0])


def projected(estimate, rate):
    rate = rate.copy()
    adaptation.project(estimate, rate, GAIN, RADIUS)
    return rate


@given(
    st.integers(0, 2**32 - 1),
    st.integers(1, 9),
    st.sampled_from([1e-3, 1.0, 1e6]),
    st.floats(0.1, 100.0),
)
def test_no_step_leaves_the_ball(seed, size, speed, radius):
    random = np.random.default_rng(seed)
    gain = 10.0 ** random.uniform(-3.0, 3.0, size)
    estimate = random.normal(size=size) * radius
    adaptation.retract(estimate, gain, radius)
    for _ in range(20):
        rate = random.normal(size=size) * speed
        adaptation.project(estimate, rate, gain, radius)
        estimate += 1e-2 * rate
        adaptation.retract(estimate, gain, radius)
        assert np.linalg.norm(estimate) <= radius * (1.0 + 1e-15)


def test_only_the_outward_part_of_the_rate_is_removed_and_only_on_the_sphere():
    """A retracted estimate counts as on it, even if rounding puts it just inside."""
    for random in map(np.random.default_rng, range(100)):
        w, v = random.normal(size=(2, 3))
        w *= 2.0 * RADIUS / np.linalg.norm(w)
        adaptation.retract(w, GAIN, RADIUS)
        v *= np.sign(w @ v)
        np.testing.assert_array_equal(projected(0.99 * w, v), v)
        np.testing.assert_array_equal(projected(w, -v), -v)
        tangential = v - GAIN * w * (w @ v) / (w @ (GAIN * w))
        np.testing.assert_allclose(projected(w, v), tangential, atol=1e-13)


def test_retracted_estimate_is_the_nearest_in_the_ball_in_the_metric_of_gamma():
    """Then 1/2 P~^T Gamma^-1 P~ does not grow for any true P inside the ball."""
    for random in map(np.random.default_rng, range(100)):
        gain = 10.0 ** random.uniform(-3.0, 3.0, 4)
        outside = random.normal(size=4)
        outside *= RADIUS * 10.0 ** random.uniform(0.0, 3.0) / np.linalg.norm(outside)
        inside = outside.copy()
        adaptation.retract(inside, gain, RADIUS)
        # Nearest: the difference is Gamma w nu, with the same nu > 0 in each direction.
        nu = (outside - inside) / (gain * inside)
        np.testing.assert_allclose(nu, np.full(4, nu.max()), rtol=1e-6)
        assert nu.min() > 0.0
        assert np.linalg.norm(inside) == pytest.approx(RADIUS, rel=1e-12)


@pytest.mark.parametrize('bad', [np.nan, np.inf])
def test_non_finite_estimates_are_left_for_the_supervisor(bad):
    estimate = np.array([bad, 1.0, 1.0])
    adaptation.retract(estimate, GAIN, RADIUS)
    assert not np.isfinite(estimate[0])


SCALE = np.array([1e-3, 5.0, 0.2, 30.0, 1.0, 1e-2, 4.0])  # of theta: p = 4 and 3 columns


@pytest.mark.parametrize('seed', range(3))
def test_excitation_is_relative_to_the_information_to_which_the_prior_pulls(seed):
    """lambda_min of Phi x = lambda R x; Phi + a R and b + a R theta_0 with a prior of weight a."""
    random, scale = np.random.default_rng(seed), SCALE
    A = random.normal(size=(7, 7))
    R = (A @ A.T + np.eye(7)) / np.outer(scale, scale)
    settings, state, signals = arbitrary(seed, information=R, rho=1e-5, prior_weight=0.0)
    rows = random.normal(size=(24, 8)) / np.append(scale, 1.0)
    state.running[:], state.rows[0], state.active[:] = rows.T @ rows, 8.0, 1.0
    Phi, b = state.running[:7, :7] / 8.0, state.running[:7, 7] / 8.0
    found = window.excitation(settings, state, signals, 200)
    values, vectors = eigh(Phi, R)
    assert found == pytest.approx(values[0], rel=1e-8)
    direction = state.min_eigenvector / state.min_eigenvector[0] * vectors[0, 0]
    np.testing.assert_allclose(direction, vectors[:, 0], rtol=1e-5)

    window.excitation(settings._replace(prior_weight=0.5), state, signals, 1)
    np.testing.assert_allclose(signals.Phi, Phi + 0.5 * R, rtol=1e-12)
    np.testing.assert_allclose(signals.b, b + 0.5 * R @ settings.initial_estimate, rtol=1e-12)


@pytest.mark.parametrize('compensation', range(len(COMPENSATIONS)))
def test_damping_by_the_initial_inertia_is_omega_v_M_xi2(compensation):
    measurement = np.array([2.2935, 1.6961, 0.3, -0.2, 0.0, 0.0])
    demands = []
    for rate in (0.0, 30.0):
        gains = {'Kp': np.zeros(2), 'damping_rate': rate, 'compensation': compensation}
        law = controller(recommended(**gains))
        law.state.estimate[:3] *= 1.2  # what is learned is not damped
        law.update(0.0, 1e-3, measurement)
        demands.append(law.signals.demand.copy())
    M, _, _ = dynamics(law.settings.initial_estimate[:3], R, *measurement[:4].reshape(2, 2))
    expected = -30.0 * M @ law.signals.xi2
    np.testing.assert_allclose(demands[1] - demands[0], expected, rtol=1e-9)


def test_window_of_every_fifth_row_gives_the_same_estimate():
    sparse = controller(quick(row_interval=5, window=200, sigma=1e-9))
    dense = controller(quick(sigma=1e-9))
    found, expected = (
        record(law, plant(constant=QUIET, amplitude=QUIET), 4.0).estimate[-1, :3]
        for law in (sparse, dense)
    )
    assert sparse.state.ring.size * 5 == dense.state.ring.size
    assert sparse.state.rows[0] == 200.0
    sparse.reset()
    record(sparse, plant(), 0.5)
    assert sparse.state.rows[0] == 99.0
    np.testing.assert_allclose(found, expected, rtol=0.02)


def test_rows_of_a_joint_at_rest_count_less():
    """Both sides of X theta = u are scaled by |dqr| / sqrt(dqr^2 + v^2)."""
    scaled, plain = (controller(quick(motion_scale=scale)) for scale in (0.05, 0.0))
    for _ in zip(*(closed_loop(law, plant(), 0.5) for law in (scaled, plain)), strict=True):
        dqr = plain.signals.dqr[0]
        weight = abs(dqr) / sqrt(dqr**2 + 0.05**2)
        np.testing.assert_allclose(scaled.signals.row, weight * plain.signals.row, rtol=1e-9)


@pytest.mark.parametrize(('P2', 'physical'), [(0.32, True), (0.02, False), (-0.3, False)])
def test_only_estimates_with_a_positive_inertia_are_physical(P2, physical):
    law = controller(recommended())
    theta = np.array([1.0, P2, 0.0, 0.0, 0.0])
    q = np.array([2.0, 1.4])
    if P2 == 0.02:  # positive definite, but below a tenth of the initial estimate
        law.settings.initial_estimate[:3] = [1.0, 0.32, 0.0]
    assert excitation.is_physical(law.settings, law.signals, q, theta) == physical
