# SPDX-License-Identifier: Apache-2.0
"""The tan barrier: gradient of a potential, the paper's inside the knee, a spring past it."""

from __future__ import annotations

from cmath import cos as complex_cos
from cmath import tan as complex_tan
from functools import partial
from math import pi

import numpy as np
import pytest

from blf_dsc_controller.law import barrier

BOUND, WEIGHT, LIMIT = 0.002, 1000.0, 2e4
KNEE = barrier.knee(BOUND, WEIGHT, LIMIT)
INSIDE = np.linspace(0.01, 0.99, 25) * KNEE
PAST = KNEE + np.linspace(0.01, 3.0, 25) * BOUND
RECOMMENDED = (BOUND, WEIGHT, LIMIT, KNEE)


def printed_potential(xi, bound):
    """Equation (3); takes complex xi."""
    return bound**2 / pi * complex_tan(pi * xi * xi / (2.0 * bound**2))


def printed_torque(xi, bound):
    """The entries of -tau_c below (16); takes complex xi."""
    return xi / complex_cos(pi * xi * xi / (2.0 * bound**2)) ** 2


def complex_step(function, xi):
    """Derivative to rounding, without taking a difference."""
    return function(xi + 1e-30j).imag / 1e-30


def each(function, errors, *arguments):
    """Values of a function of one error at many."""
    return np.array([function(xi, *arguments) for xi in errors])


def test_barrier_inside_the_knee_is_that_of_the_paper_times_the_weight():
    for ours, printed in (
        (barrier.potential, printed_potential),
        (barrier.gradient, printed_torque),
    ):
        expected = WEIGHT * each(printed, INSIDE, BOUND).real
        np.testing.assert_allclose(each(ours, INSIDE, *RECOMMENDED), expected, rtol=1e-12)


def test_gradient_and_slope_are_the_first_two_derivatives_inside_the_knee():
    for derivative, printed in (
        (each(barrier.gradient, INSIDE, *RECOMMENDED), printed_potential),
        (each(barrier.slope, INSIDE, BOUND, WEIGHT), printed_torque),
    ):
        expected = [complex_step(partial(printed, bound=BOUND), xi) for xi in INSIDE]
        np.testing.assert_allclose(derivative, WEIGHT * np.array(expected), rtol=1e-12)


def test_gradient_is_the_finite_difference_of_the_potential():
    # With h = 1e-8 rad the third derivative (below 1e11 N m/rad^3) adds 1e-6 N m to ~10.
    h, errors = 1e-8, np.array([*-PAST, -KNEE, *-INSIDE, *INSIDE, KNEE, *PAST])
    below, above = (each(barrier.potential, errors + side, *RECOMMENDED) for side in (-h, h))
    gradient = each(barrier.gradient, errors, *RECOMMENDED)
    np.testing.assert_allclose((above - below) / (2.0 * h), gradient, rtol=1e-6, atol=1e-6)


def test_torque_and_slope_are_continuous_at_the_knee():
    h = 1e-10
    below, at, above = (barrier.gradient(KNEE + side, *RECOMMENDED) for side in (-h, 0.0, h))

    assert at == pytest.approx(WEIGHT * printed_torque(KNEE, BOUND).real, rel=1e-12)
    assert (at - below) / h == pytest.approx(LIMIT, rel=1e-4)  # rounding of 10 N m over h
    assert (above - at) / h == pytest.approx(LIMIT, rel=1e-4)


@pytest.mark.parametrize('weight', [1.0, 1000.0, 2e4])
def test_knee_is_where_the_slope_reaches_its_limit(weight):
    knee = barrier.knee(BOUND, weight, LIMIT)

    assert 0.0 <= knee < BOUND
    assert barrier.slope(knee, BOUND, weight) == pytest.approx(LIMIT, rel=1e-9)


def test_slope_never_exceeds_its_limit_and_reaches_it_past_the_knee():
    xi = np.linspace(-3.0 * BOUND, 3.0 * BOUND, 4001)
    slope = np.diff([barrier.gradient(x, *RECOMMENDED) for x in xi]) / np.diff(xi)
    past = np.minimum(np.abs(xi[1:]), np.abs(xi[:-1])) >= KNEE

    assert slope.min() >= WEIGHT * (1.0 - 1e-9)
    assert slope.max() <= LIMIT * (1.0 + 1e-9)
    np.testing.assert_allclose(slope[past], LIMIT, rtol=1e-9)


def test_barrier_is_symmetric():
    for xi in (0.0, *INSIDE, KNEE, *PAST):
        assert barrier.gradient(-xi, *RECOMMENDED) == -barrier.gradient(xi, *RECOMMENDED)
        assert barrier.potential(-xi, *RECOMMENDED) == barrier.potential(xi, *RECOMMENDED)


def test_barrier_near_zero_is_a_spring_of_stiffness_weight():
    xi = 1e-9  # s = 4e-13, so the correction 2 s^2 is below rounding
    assert barrier.gradient(0.0, *RECOMMENDED) == 0.0
    assert barrier.potential(0.0, *RECOMMENDED) == 0.0
    assert barrier.gradient(xi, *RECOMMENDED) == pytest.approx(WEIGHT * xi, rel=1e-12)
    assert barrier.potential(xi, *RECOMMENDED) == pytest.approx(0.5 * WEIGHT * xi**2, rel=1e-12)


def test_potential_without_slope_limit_is_unbounded_at_the_bound():
    """With s = pi/2 (1 - e)^2, tan s is 1 / (pi e) to first order in the distance e."""
    knee = barrier.knee(BOUND, 1.0, 1e300)
    for distance in (1e-4, 1e-5, 1e-6):
        potential = barrier.potential(BOUND * (1.0 - distance), BOUND, 1.0, 1e300, knee)
        assert potential == pytest.approx(BOUND**2 / pi / (pi * distance), rel=2.0 * distance)


def test_barrier_is_finite_and_pushes_back_at_and_beyond_the_bound():
    torques = [barrier.gradient(xi, *RECOMMENDED) for xi in (BOUND, 2.0 * BOUND, 1.0)]
    assert np.all(np.isfinite(torques))
    assert 0.0 < torques[0] < torques[1] < torques[2]
