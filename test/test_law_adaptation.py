# SPDX-License-Identifier: Apache-2.0
"""The update laws (20) and (30), the projection onto the ball, and priors of different units."""

from __future__ import annotations

import numpy as np
import pytest
from closed_loop_case import arbitrary, controller, recommended
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import eigh

from blf_dsc_controller.law import adaptation, excitation, window

DT = 1e-3


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


@pytest.mark.parametrize('seed', range(3))
def test_excitation_is_relative_to_the_information_to_which_the_prior_pulls(seed):
    """lambda_min of Phi x = lambda R x; Phi + a R and b + a R theta_0 with a prior of weight a."""
    random, scale = np.random.default_rng(seed), np.array([1e-3, 5.0, 30.0, 1.0, 1e-2])
    A = random.normal(size=(5, 5))
    R = (A @ A.T + np.eye(5)) / np.outer(scale, scale)
    settings, state, signals = arbitrary(seed, information=R, rho=1e-5, prior_weight=0.0)
    rows = random.normal(size=(16, 6)) / np.append(scale, 1.0)
    state.running[:], state.rows[0], state.active[:] = rows.T @ rows, 8.0, 1.0
    Phi, b = state.running[:5, :5] / 8.0, state.running[:5, 5] / 8.0
    found = window.excitation(settings, state, signals, 200)
    values, vectors = eigh(Phi, R)
    assert found == pytest.approx(values[0], rel=1e-8)
    direction = state.min_eigenvector / state.min_eigenvector[0] * vectors[0, 0]
    np.testing.assert_allclose(direction, vectors[:, 0], rtol=1e-5)

    window.excitation(settings._replace(prior_weight=0.5), state, signals, 1)
    np.testing.assert_allclose(signals.Phi, Phi + 0.5 * R, rtol=1e-12)
    np.testing.assert_allclose(signals.b, b + 0.5 * R @ settings.initial_estimate, rtol=1e-12)


@pytest.mark.parametrize(('P2', 'physical'), [(0.32, True), (0.02, False), (-0.3, False)])
def test_only_estimates_with_a_positive_inertia_are_physical(P2, physical):
    law = controller(recommended())
    theta = np.array([1.0, P2, 0.0, 0.0, 0.0])
    law.signals.q[:] = 2.0, 1.4
    if P2 == 0.02:  # positive definite, but below a tenth of the initial estimate
        law.settings.initial_estimate[:3] = [1.0, 0.32, 0.0]
    assert excitation.is_physical(law.settings, law.signals, theta) == physical
