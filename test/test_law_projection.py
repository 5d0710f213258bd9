# SPDX-License-Identifier: Apache-2.0
"""The projection keeps P^ in its ball, and keeps the Lyapunov function (29) decreasing."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from blf_dsc_controller.law import projection

RADIUS = 3.0
GAIN = np.array([0.05, 1.0, 20.0])


def projected(estimate, rate, gain=GAIN):
    rate = rate.copy()
    projection.project(estimate, rate, gain, RADIUS)
    return rate


def on_sphere(random, size=3):
    w = random.normal(size=size)
    return w * RADIUS / np.linalg.norm(w) * (1.0 + 1e-15)


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
    projection.retract(estimate, gain, radius)
    for _ in range(20):
        rate = random.normal(size=size) * speed
        projection.project(estimate, rate, gain, radius)
        estimate += 1e-2 * rate
        projection.retract(estimate, gain, radius)
        assert np.linalg.norm(estimate) <= radius * (1.0 + 1e-15)


def test_nothing_is_changed_inside_the_ball():
    estimate, rate = np.array([1.0, -2.0, 1.9]), np.array([1e3, -5.0, 7.0])
    np.testing.assert_array_equal(projected(estimate, rate), rate)
    before = estimate.copy()
    projection.retract(estimate, GAIN, RADIUS)
    np.testing.assert_array_equal(estimate, before)


def test_inward_and_tangential_rates_are_kept_on_the_sphere():
    estimate = np.array([RADIUS, 0.0, 0.0])
    for rate in (np.array([-1.0, 4.0, 2.0]), np.array([0.0, 4.0, 2.0])):
        np.testing.assert_array_equal(projected(estimate, rate), rate)


def test_outward_part_of_the_rate_is_removed_on_the_sphere():
    for random in map(np.random.default_rng, range(10)):
        w = on_sphere(random)
        v = random.normal(size=3)
        v *= np.sign(w @ v)

        rate = projected(w, v)

        metric = w @ (GAIN * w)
        np.testing.assert_allclose(rate, v - GAIN * w * (w @ v) / metric, atol=1e-13)
        assert w @ rate == pytest.approx(0.0, abs=1e-13)


def test_retracted_estimate_counts_as_on_the_sphere():
    """Even if rounding puts it just inside: otherwise half the steps would not be projected."""
    for seed in range(100):
        random = np.random.default_rng(seed)
        w, v = random.normal(size=(2, 3))
        w *= 2.0 * RADIUS / np.linalg.norm(w)
        projection.retract(w, GAIN, RADIUS)
        v *= np.sign(w @ v)

        assert w @ projected(w, v) == pytest.approx(0.0, abs=1e-12)


def test_projection_never_slows_the_decrease_of_the_lyapunov_function():
    """d/dt (1/2 P~^T Gamma^-1 P~) = -P~^T Gamma^-1 P^', for any true P inside the ball."""
    for random in map(np.random.default_rng, range(200)):
        w, v = on_sphere(random), random.normal(size=3)
        true = on_sphere(random) * random.uniform()
        slope = [-(true - w) @ (rate / GAIN) for rate in (projected(w, v), v)]
        assert slope[0] <= slope[1] + 1e-12


def test_retracted_estimate_is_the_nearest_in_the_ball_in_the_metric_of_gamma():
    """Then 1/2 P~^T Gamma^-1 P~ does not grow for any true P inside the ball."""
    for random in map(np.random.default_rng, range(100)):
        gain = 10.0 ** random.uniform(-3.0, 3.0, 4)
        outside = random.normal(size=4)
        outside *= RADIUS * 10.0 ** random.uniform(0.0, 3.0) / np.linalg.norm(outside)
        inside = outside.copy()

        projection.retract(inside, gain, RADIUS)

        # Nearest: the difference is Gamma w nu, with the same nu > 0 in each direction.
        nu = (outside - inside) / (gain * inside)
        np.testing.assert_allclose(nu, np.full(4, nu.max()), rtol=1e-6)
        assert nu.min() > 0.0
        assert np.linalg.norm(inside) == pytest.approx(RADIUS, rel=1e-12)
        true = np.array([on_sphere(random, 4) * random.uniform() for _ in range(10)])
        before, after = (((true - w) ** 2 / gain).sum(axis=1) for w in (outside, inside))
        assert np.all(after <= before * (1.0 + 1e-9))


def test_uniform_gamma_retracts_along_the_radius():
    estimate = np.array([3.0, 4.0])
    projection.retract(estimate, np.array([0.5, 0.5]), 2.5)
    np.testing.assert_allclose(estimate, [1.5, 2.0], rtol=1e-15)


@pytest.mark.parametrize('bad', [np.nan, np.inf])
def test_non_finite_estimates_are_left_for_the_supervisor(bad):
    estimate = np.array([bad, 1.0, 1.0])
    projection.retract(estimate, GAIN, RADIUS)
    assert not np.isfinite(estimate[0])
