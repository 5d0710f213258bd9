# SPDX-License-Identifier: Apache-2.0
"""Terms of the reference: values, derivatives, blending; splines, minimum jerk among them."""

from __future__ import annotations

import numpy as np
import pytest

from blf_dsc_controller.reference import terms as reference
from blf_dsc_controller.reference.terms import (
    hermite,
    minimum_jerk,
    pack,
    sampled,
    sinusoids_term,
    spline_term,
    unpack,
)

OFFSET = (0.5, -1.0, 2.0)
FREQUENCY, PHASE = (1.0, 2.7), (0.3, -1.1)
AMPLITUDE = ((0.3, 0.1), (0.0, -0.2), (0.25, 0.05))  # a row for each joint
SINUSOIDS = sinusoids_term(OFFSET, np.ravel(AMPLITUDE), FREQUENCY, PHASE)
KNOTS = np.array([0.4, 1.0, 1.1, 3.0])
COEFFICIENTS = np.random.default_rng(0).normal(size=(4, 3, 6))
SPLINE = spline_term(KNOTS, COEFFICIENTS)
LATER = SPLINE._replace(begin=0.5, fade=1.6)
KINDS = {
    'sinusoids': [SINUSOIDS],
    'spline': [SPLINE],
    'one into the other': [SINUSOIDS, LATER],
    'three at once': [SINUSOIDS, LATER, SINUSOIDS._replace(begin=1.0, fade=2.0)],
}


def at(terms, t):
    out = np.full((3, 3), np.nan)
    reference.evaluate(pack(3, terms), t, *out)
    return out


def test_terms_are_sums_of_tones_or_polynomials_of_the_current_piece():
    for t in (0.0, 1.234, 60.0):
        expected = [
            offset + np.sum(row * np.cos(np.array(FREQUENCY) * t + PHASE))
            for offset, row in zip(OFFSET, AMPLITUDE, strict=True)
        ]
        np.testing.assert_allclose(at([SINUSOIDS], t)[0], expected, atol=1e-15)
    for piece, t in ((0, 0.4), (0, 0.9), (1, 1.0), (2, 1.5), (3, 3.0), (3, 5)):
        x = t - KNOTS[piece]
        expected = [np.polynomial.polynomial.polyval(x, c) for c in COEFFICIENTS[piece]]
        np.testing.assert_allclose(at([SPLINE], t)[0], expected, rtol=1e-13)
    before = at([SPLINE], 0.39)  # at rest at its first point
    np.testing.assert_array_equal(before, [COEFFICIENTS[0, :, 0], [0] * 3, [0] * 3])


@pytest.mark.parametrize('terms', KINDS.values(), ids=KINDS)
@pytest.mark.parametrize('t', [0.1, 0.7, 1.05, 1.234, 3.5])
def test_velocity_and_acceleration_are_the_derivatives_of_the_reference(terms, t):
    # Five-point stencil with step 1e-3: the fifth derivative, below 1e3 here, leaves 1e-10.
    h = 1e-3
    points = np.array([at(terms, t + side * h) for side in (-2, -1, 1, 2)])
    rate = (points[0] - 8.0 * points[1] + 8.0 * points[2] - points[3]) / (12.0 * h)
    _, dqr, ddqr = at(terms, t)

    np.testing.assert_allclose(dqr, rate[0], atol=1e-9)
    np.testing.assert_allclose(ddqr, rate[1], atol=1e-9)


def test_terms_are_blended_by_the_minimum_jerk_step():
    both = [SINUSOIDS, LATER]
    for t, s in ((0.5, 0.0), (1.3, 0.5), (2.1, 1.0)):
        expected = (1.0 - s) * at([SINUSOIDS], t)[0] + s * at([SPLINE], t)[0]
        np.testing.assert_allclose(at(both, t)[0], expected, rtol=1e-13)
    # Before and after only one of them counts, to the last bit.
    for t in (0.0, 0.49, 0.5):
        np.testing.assert_array_equal(at(both, t), at([SINUSOIDS], t))
    for t in (2.1, 2.2, 50.0):
        np.testing.assert_array_equal(at(both, t), at([SPLINE], t))
    for t in (0.5, 2.1):  # over 2e-9 s the jerk, below 1e4 here, moves the acceleration by 2e-5
        before, after = (at(both, t + side) for side in (-1e-9, 1e-9))
        np.testing.assert_allclose(before, after, atol=1e-4)
    without_fade = [SINUSOIDS, SPLINE._replace(begin=1.5)]
    np.testing.assert_array_equal(at(without_fade, 1.4999), at([SINUSOIDS], 1.4999))
    np.testing.assert_array_equal(at(without_fade, 1.5), at([SPLINE], 1.5))


def test_terms_survive_packing_and_are_evaluated_at_many_times_at_once():
    terms = [SINUSOIDS, LATER, SPLINE]
    for term, unpacked in zip(terms, unpack(pack(3, terms)), strict=True):
        assert (term.code, term.begin, term.fade) == (unpacked.code, unpacked.begin, unpacked.fade)
        np.testing.assert_array_equal(term.content, unpacked.content)
    times = np.linspace(0.0, 4.0, 9)
    together = reference.sampled(pack(3, [SINUSOIDS, LATER]), times)
    apart = np.array([at([SINUSOIDS, LATER], t) for t in times])
    np.testing.assert_allclose(together, apart, rtol=1e-14, atol=1e-14)  # cosines of two libraries


TIMES = np.array([0.5, 1.0, 1.2, 2.5, 4.0])
STATES = np.random.default_rng(3).normal(size=(3, 5, 2))
BEGIN = np.array([[0.4, -0.3], [1.0, 2.0]])


def states(term, times):
    return sampled(pack(2, [term]), np.asarray(times))


def jerk_cost(term):
    """Integral of the squared jerk, by differences of the exact acceleration."""
    fine = np.linspace(TIMES[0], TIMES[-1], 20_001)
    jerk = np.diff(states(term, fine)[:, 2], axis=0) / (fine[1] - fine[0])
    return np.sum(jerk**2) * (fine[1] - fine[0])


def test_hermite_has_the_given_values_at_every_point_from_both_sides():
    h = 1e-9
    for k, t in enumerate(TIMES):
        sides = [t + h] if k == 0 else [t - h, t] if k + 1 < len(TIMES) else [t - h]
        for side in sides:
            # The jerk between points 0.2 s apart is of the order 1e3.
            np.testing.assert_allclose(
                states(hermite(TIMES, STATES), [side])[0], STATES[:, k], atol=1e-5
            )


@pytest.mark.parametrize('begin', [None, BEGIN], ids=['at rest', 'moving'])
def test_minimum_jerk_passes_through_its_points_and_ends_at_rest(begin):
    motion = minimum_jerk(TIMES, STATES[0], begin)
    now = states(motion, TIMES)
    np.testing.assert_allclose(now[:, 0], STATES[0], atol=1e-12)
    np.testing.assert_allclose(now[0, 1:], np.zeros((2, 2)) if begin is None else begin, atol=1e-12)
    np.testing.assert_array_equal(states(motion, [4.0, 9.0])[:, 1:], 0.0)
    np.testing.assert_array_equal(states(motion, [4.0, 9.0])[:, 0], STATES[0][[-1, -1]])
    np.testing.assert_allclose(states(motion, [4.0 - 1e-9])[0, 1:], 0.0, atol=1e-6)


def test_other_velocities_or_accelerations_at_a_point_cost_more_jerk():
    inner = states(minimum_jerk(TIMES, STATES[0]), TIMES).transpose(1, 0, 2)
    least = jerk_cost(hermite(TIMES, inner))
    assert least == pytest.approx(jerk_cost(minimum_jerk(TIMES, STATES[0])))
    for row in (1, 2):
        for k in (1, 2, 3):
            for step in (-0.3, 0.3):
                other = inner.copy()
                other[row, k, 0] += step
                assert jerk_cost(hermite(TIMES, other)) > least * (1.0 + 1e-6)


def test_minimum_jerk_between_two_points_is_the_known_polynomial():
    x = np.linspace(0.0, 1.0, 11)
    step = states(minimum_jerk(np.array([0.0, 2.0]), np.array([[0.0, 1.0], [1.0, 3.0]])), 2.0 * x)
    expected = 10.0 * x**3 - 15.0 * x**4 + 6.0 * x**5
    np.testing.assert_allclose(step[:, 0, 0], expected, atol=1e-14)
    np.testing.assert_allclose(step[:, 0, 1], 1.0 + 2.0 * expected, atol=1e-14)
