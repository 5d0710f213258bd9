# SPDX-License-Identifier: Apache-2.0
"""Splines pass through their points; minimum-jerk splines have less jerk than their neighbours."""

from __future__ import annotations

import numpy as np
import pytest

from blf_dsc_controller.reference.polynomials import hermite, minimum_jerk
from blf_dsc_controller.reference.terms import pack, sampled

TIMES = np.array([0.5, 1.0, 1.2, 2.5, 4.0])
POINTS = np.random.default_rng(3).normal(size=(3, 5, 2))
BEGIN = np.array([[0.4, -0.3], [1.0, 2.0]])


def at(term, times):
    return sampled(pack(2, [term]), np.asarray(times))


def jerk_cost(term):
    """Integral of the squared jerk, by differences of the exact acceleration."""
    fine = np.linspace(TIMES[0], TIMES[-1], 20_001)
    jerk = np.diff(at(term, fine)[:, 2], axis=0) / (fine[1] - fine[0])
    return np.sum(jerk**2) * (fine[1] - fine[0])


def test_hermite_has_the_given_values_at_every_point_from_both_sides():
    h = 1e-9
    for k, t in enumerate(TIMES):
        sides = [t + h] if k == 0 else [t - h, t] if k + 1 < len(TIMES) else [t - h]
        for side in sides:
            # The jerk between points 0.2 s apart is of the order 1e3.
            np.testing.assert_allclose(
                at(hermite(TIMES, POINTS), [side])[0], POINTS[:, k], atol=1e-5
            )


@pytest.mark.parametrize('begin', [None, BEGIN], ids=['at rest', 'moving'])
def test_minimum_jerk_passes_through_its_points_and_ends_at_rest(begin):
    motion = minimum_jerk(TIMES, POINTS[0], begin)
    now = at(motion, TIMES)
    np.testing.assert_allclose(now[:, 0], POINTS[0], atol=1e-12)
    np.testing.assert_allclose(now[0, 1:], np.zeros((2, 2)) if begin is None else begin, atol=1e-12)
    np.testing.assert_array_equal(at(motion, [4.0, 9.0])[:, 1:], 0.0)
    np.testing.assert_array_equal(at(motion, [4.0, 9.0])[:, 0], POINTS[0][[-1, -1]])
    np.testing.assert_allclose(at(motion, [4.0 - 1e-9])[0, 1:], 0.0, atol=1e-6)


def test_other_velocities_or_accelerations_at_a_point_cost_more_jerk():
    inner = at(minimum_jerk(TIMES, POINTS[0]), TIMES).transpose(1, 0, 2)
    least = jerk_cost(hermite(TIMES, inner))
    assert least == pytest.approx(jerk_cost(minimum_jerk(TIMES, POINTS[0])))
    for row in (1, 2):
        for k in (1, 2, 3):
            for step in (-0.3, 0.3):
                other = inner.copy()
                other[row, k, 0] += step
                assert jerk_cost(hermite(TIMES, other)) > least * (1.0 + 1e-6)


def test_minimum_jerk_between_two_points_is_the_known_polynomial():
    x = np.linspace(0.0, 1.0, 11)
    step = at(minimum_jerk(np.array([0.0, 2.0]), np.array([[0.0, 1.0], [1.0, 3.0]])), 2.0 * x)
    expected = 10.0 * x**3 - 15.0 * x**4 + 6.0 * x**5
    np.testing.assert_allclose(step[:, 0, 0], expected, atol=1e-14)
    np.testing.assert_allclose(step[:, 0, 1], 1.0 + 2.0 * expected, atol=1e-14)
