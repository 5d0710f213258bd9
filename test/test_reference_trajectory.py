# SPDX-License-Identifier: Apache-2.0
"""The reference: its terms, and sent trajectories, how they join it, and every rejection."""

from __future__ import annotations

import itertools

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st

from blf_dsc_controller.configuration.controller import ControllerConfig, MotionLimits
from blf_dsc_controller.reference import terms as reference
from blf_dsc_controller.reference.approach import MotionError
from blf_dsc_controller.reference.terms import (
    minimum_jerk,
    pack,
    pieces_of,
    sampled,
    sinusoids_term,
    spline_term,
    unpack,
)
from blf_dsc_controller.reference.trajectory import (
    Trajectory,
    TrajectoryError,
    TrajectoryPoint,
    plan_trajectory,
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


def value_at(terms, t):
    out = np.full((3, 3), np.nan)
    reference.evaluate(pack(3, terms), t, *out)
    return out


def test_terms_are_sums_of_tones_or_polynomials_of_the_current_piece():
    for t in (0.0, 1.234, 60.0):
        tones = np.cos(np.array(FREQUENCY) * t + PHASE)
        expected = OFFSET + np.array(AMPLITUDE) @ tones
        np.testing.assert_allclose(value_at([SINUSOIDS], t)[0], expected, atol=1e-15)
    for piece, t in ((0, 0.4), (0, 0.9), (1, 1.0), (2, 1.5), (3, 3.0), (3, 5)):
        expected = np.polynomial.polynomial.polyval(t - KNOTS[piece], COEFFICIENTS[piece].T)
        np.testing.assert_allclose(value_at([SPLINE], t)[0], expected, rtol=1e-13)
    before = value_at([SPLINE], 0.39)  # at rest at its first point
    np.testing.assert_array_equal(before, [COEFFICIENTS[0, :, 0], [0] * 3, [0] * 3])


@pytest.mark.parametrize('terms', KINDS.values(), ids=KINDS)
@pytest.mark.parametrize('t', [0.1, 0.7, 1.05, 1.234, 3.5])
def test_velocity_and_acceleration_are_the_derivatives_of_the_reference(terms, t):
    # Five-point stencil with step 1e-3: the fifth derivative, below 1e3 here, leaves 1e-10.
    h = 1e-3
    points = np.array([value_at(terms, t + side * h) for side in (-2, -1, 1, 2)])
    rate = (points[0] - 8.0 * points[1] + 8.0 * points[2] - points[3]) / (12.0 * h)
    _, dqr, ddqr = value_at(terms, t)

    np.testing.assert_allclose(dqr, rate[0], atol=1e-9)
    np.testing.assert_allclose(ddqr, rate[1], atol=1e-9)


def test_terms_are_blended_by_the_minimum_jerk_step():
    both = [SINUSOIDS, LATER]
    for t, s in ((0.5, 0.0), (1.3, 0.5), (2.1, 1.0)):
        expected = (1.0 - s) * value_at([SINUSOIDS], t)[0] + s * value_at([SPLINE], t)[0]
        np.testing.assert_allclose(value_at(both, t)[0], expected, rtol=1e-13)
    # Before and after only one of them counts, to the last bit; also without a blend.
    at_once = [SINUSOIDS, SPLINE._replace(begin=1.5)]
    for terms, alone, times in (
        (both, SINUSOIDS, (0.0, 0.49, 0.5)),
        (both, SPLINE, (2.1, 2.2, 50.0)),
        (at_once, SINUSOIDS, (1.4999,)),
        (at_once, SPLINE, (1.5,)),
    ):
        for t in times:
            np.testing.assert_array_equal(value_at(terms, t), value_at([alone], t))
    for t in (0.5, 2.1):  # over 2e-9 s the jerk, below 1e4 here, moves the acceleration by 2e-5
        before, after = (value_at(both, t + side) for side in (-1e-9, 1e-9))
        np.testing.assert_allclose(before, after, atol=1e-4)


MOMENTS = np.array([0.5, 1.0, 1.2, 2.5, 4.0])
POINTS = np.random.default_rng(3).normal(size=(5, 2))


def test_minimum_jerk_passes_through_its_points_from_rest_to_rest():
    motion = pack(2, [minimum_jerk(MOMENTS, POINTS)])
    now = sampled(motion, MOMENTS)
    np.testing.assert_allclose(now[:, 0], POINTS, atol=1e-12)
    np.testing.assert_allclose(now[0, 1:], 0.0, atol=1e-12)
    for t in (4.0, 9.0):
        np.testing.assert_array_equal(at(motion, t), [POINTS[-1], (0, 0), (0, 0)])
    np.testing.assert_allclose(at(motion, 4.0 - 1e-9)[1:], 0.0, atol=1e-6)


def test_minimum_jerk_is_continuous_up_to_its_snap():
    """Only then no other velocity or acceleration at an inner point costs less jerk."""
    knots, pieces = pieces_of(minimum_jerk(MOMENTS, POINTS), 2)
    for k, joint, order in itertools.product((1, 2, 3), (0, 1), range(5)):
        before, after = map(np.polynomial.Polynomial, pieces[k - 1 : k + 1, joint])
        end = before.deriv(order)(knots[k] - knots[k - 1])
        assert end == pytest.approx(after.deriv(order)(0.0), rel=1e-9, abs=1e-9)


JOINTS = ('shoulder', 'elbow')
LIMITS = ControllerConfig(
    JOINTS, limits=MotionLimits((-4.0, -3.0), (4.0, 3.0), (1.5, 1.5), (6.0, 6.0))
)
PAPER = pack(2, [sinusoids_term((1.9935, 1.3961), (0.3, 0.3), (1.0,), (0.0,))])
NOW = 3.3  # s
GOALS = np.array([[1.6, 1.2], [2.0, 1.5], [1.8, 1.0]])
FAR = np.array([[1.6, 1.2], [2.0, 3.5], [1.8, 1.0]])
VELOCITIES = np.array([[0.2, 0.0], [0.1, -0.2], [0.0, 0.0]])
ACCELERATIONS = np.array([[0.1, 0.4], [-0.3, 0.2], [0.0, 0.0]])
TIMES = (1.0, 2.0, 3.5)
FIELDS = {
    'positions': (GOALS,),
    'positions and velocities': (GOALS, VELOCITIES),
    'positions, velocities and accelerations': (GOALS, VELOCITIES, ACCELERATIONS),
}


def trajectory(fields=(GOALS,), times=TIMES, joints=JOINTS, begin=None):
    rows = zip(times, *fields, strict=True)
    points = tuple(TrajectoryPoint(t, *(tuple(row.tolist()) for row in each)) for t, *each in rows)
    return Trajectory(joints, points, begin)


def plan(sent, vector=None, now=NOW):
    return plan_trajectory(sent, PAPER if vector is None else vector, now, LIMITS)


def at(vector, t):
    return sampled(vector, np.array([t]))[0]


@pytest.mark.parametrize('fields', FIELDS.values(), ids=FIELDS)
def test_trajectory_continues_the_reference_passes_its_points_and_holds_the_last(fields):
    motion = plan(trajectory(fields))
    assert motion.settled == NOW
    np.testing.assert_allclose(at(motion.vector, NOW), at(PAPER, NOW), atol=1e-13)
    np.testing.assert_allclose(at(motion.vector, NOW + 1e-8), at(PAPER, NOW), atol=1e-6)
    passed = sampled(motion.vector, NOW + np.array(TIMES)).transpose(1, 0, 2)
    np.testing.assert_allclose(passed[: len(fields)], fields, atol=1e-12)
    times = np.linspace(NOW, NOW + 4.0, 40_001)
    qr, dqr, ddqr = sampled(motion.vector, times).transpose(1, 0, 2)
    # 6 rad/s^2 times 1e-4 s is the most that a velocity may change from one time to the next.
    assert np.abs(np.diff(dqr, axis=0)).max() <= 6.0e-4 * 1.001
    if len(fields) != 2:  # cubics jump in acceleration at their points
        assert np.abs(np.diff(ddqr, axis=0)).max() < 0.02  # a jerk below 200 rad/s^3
    np.testing.assert_array_equal(qr[times > NOW + 3.5][-1], GOALS[-1])
    np.testing.assert_array_equal(at(motion.vector, 1e4), [GOALS[-1], (0, 0), (0, 0)])
    # Joints are matched by name.
    swapped = trajectory(tuple(field[:, ::-1] for field in fields), joints=JOINTS[::-1])
    np.testing.assert_array_equal(plan(swapped).vector, motion.vector)


def test_cubics_are_hermite_splines_with_a_smooth_lead_in():
    """Halfway between two points, h apart: their mean plus h/8 times the decrease in velocity.

    After braking, the lead-in is the quintic that set out from rest when the trajectory began.
    """
    motion = plan(trajectory((GOALS, VELOCITIES)))
    halfway = at(motion.vector, NOW + 1.5)[0]
    expected = 0.5 * (GOALS[0] + GOALS[1]) + (VELOCITIES[0] - VELOCITIES[1]) / 8.0
    np.testing.assert_allclose(halfway, expected, atol=1e-12)
    before, after = (at(motion.vector, NOW + 1.0 + side)[2] for side in (-1e-9, 1e-9))
    np.testing.assert_allclose(before, after, atol=1e-6)
    assert np.abs(after).min() > 0.1
    knots, pieces = pieces_of(unpack(motion.vector)[-1], 2)
    lead_in = np.polynomial.Polynomial(pieces[1, 0])
    at_begin = [lead_in.deriv(order)(NOW - knots[1]) for order in (1, 2)]
    np.testing.assert_allclose(at_begin, 0.0, atol=1e-9)


def test_trajectory_that_begins_now_at_another_position_is_blended_in():
    """A second one, planned while the blend is under way, is settled with that blend."""
    first = plan(trajectory((GOALS[::-1],), times=(0.0, 4.0, 8.0)))
    assert NOW + 0.1 < first.settled < NOW + 4.0
    np.testing.assert_allclose(at(first.vector, NOW), at(PAPER, NOW), atol=1e-13)
    np.testing.assert_allclose(at(first.vector, NOW + 4.0)[0], GOALS[1], atol=1e-12)
    later = plan(trajectory(begin=first.settled + 0.5), first.vector, NOW + 0.05)
    assert later.settled == first.settled


def test_single_point_at_time_zero_is_reached_as_fast_as_the_limits_allow():
    motion = plan(trajectory((GOALS[:1],), times=(0.0,)))
    after = at(motion.vector, motion.settled)
    np.testing.assert_allclose(after, [GOALS[0], (0, 0), (0, 0)], atol=1e-12)
    _, dqr, ddqr = sampled(motion.vector, np.linspace(NOW, motion.settled, 5001)).transpose(1, 0, 2)
    used = max((np.abs(dqr) / 1.5).max(), (np.abs(ddqr) / 6.0).max())
    assert used == pytest.approx(1.0, abs=0.05)


def test_present_reference_continues_until_the_trajectory_begins_and_past_points_are_skipped():
    later = plan(trajectory(begin=5.0)).vector
    for t in (NOW, 4.0, 4.999):
        np.testing.assert_array_equal(at(later, t), at(PAPER, t))
    np.testing.assert_allclose(at(later, 5.0), at(PAPER, 5.0), atol=1e-13)
    np.testing.assert_allclose(at(later, 6.0)[0], GOALS[0], atol=1e-12)
    late = plan(trajectory(begin=NOW - 1.5)).vector
    np.testing.assert_allclose(at(late, NOW), at(PAPER, NOW), atol=1e-13)
    np.testing.assert_allclose(at(late, NOW + 0.5)[0], GOALS[1], atol=1e-12)


def test_later_trajectory_replaces_running_and_waiting_ones():
    first = plan(trajectory()).vector
    waiting = plan(trajectory(begin=20.0), first, NOW + 1.0).vector
    last = plan(trajectory((GOALS[::-1] + 0.1,)), waiting, NOW + 1.5).vector
    np.testing.assert_allclose(at(last, NOW + 1.5), at(first, NOW + 1.5), atol=1e-12)
    for t in (NOW + 5.0, 22.0):
        np.testing.assert_allclose(at(last, t)[0], GOALS[0] + 0.1, atol=1e-12)
    assert len(unpack(last)) == 2
    for k in range(20):  # what is finished is forgotten
        last = plan(trajectory((GOALS + 0.01 * k,)), last, NOW + 2.0 + k).vector
        assert len(unpack(last)) == 2


NAN = float('nan')


def points_at(*times):
    return Trajectory(JOINTS, tuple(TrajectoryPoint(float(t), (1.0, 1.0)) for t in times))


def one_point(*fields, **more):
    return Trajectory(JOINTS, (TrajectoryPoint(1.0, *fields, **more),))


MIXED = (TrajectoryPoint(1.0, (1.6, 1.2), (0.0, 0.0)), TrajectoryPoint(2.0, (1.6, 1.2)))
REPEATED = trajectory((np.hstack((GOALS, GOALS[:, 1:])),), joints=(*JOINTS, 'elbow'))
MOVING_ON = VELOCITIES + np.array([[0.0], [np.inf], [0.0]])
TOO_FAST = trajectory((GOALS * [[1.0, 1.0], [1.9, 1.0], [1.0, 1.0]],), times=(2.0, 3.0, 6.0))
BAD = (
    (trajectory(joints=('shoulder', 'wrist')), "'wrist', but each of 'shoulder', 'elbow' is"),
    (trajectory((GOALS[:, :1],), joints=JOINTS[:1]), "its joints are 'shoulder', but each of"),
    (REPEATED, "'shoulder', 'elbow' is needed once"),
    (Trajectory((), ()), 'its joints are none, but'),
    (Trajectory(JOINTS, ()), 'it has no points'),
    (one_point(()), 'point 1 has no positions'),
    (one_point((1.0,)), 'point 1 has positions [1.0], but 2 finite'),
    (one_point((1.0, 1.0), (0.0, 0.0, 0.0)), 'point 1 has velocities [0.0, 0.0, 0.0], but'),
    (one_point((1.0, 1.0), (), (0.0, 0.0)), 'accelerations, but no velocities'),
    (one_point((1.0, 1.0), effort=(1.0, 1.0)), 'leave effort empty'),
    (Trajectory(JOINTS, MIXED), 'do not all give the same'),
    (trajectory((GOALS * [[1.0, NAN]],)), 'point 1 has positions [1.6, nan], but 2'),
    (trajectory((GOALS, MOVING_ON)), 'point 2 has velocities [inf, inf], but 2'),
    (trajectory(times=(1.0, 1.0, 2.0)), 'point 2 is at 1 s, not after'),
    (trajectory(times=(1.0, 2.0, 1.5)), 'point 3 is at 1.5 s, not after'),
    (trajectory(times=(-1.0, 1.0, 2.0)), 'point 1 is 1 s before the beginning'),
    (trajectory(begin=-0.5), 'it ended 0.3 s ago'),
    (trajectory((GOALS, VELOCITIES[::-1])), 'it ends with shoulder at 0.2 rad/s, but the last'),
    (TOO_FAST, "the velocity of joint 'shoulder' would be"),
    (trajectory((GOALS[:1],), times=(0.2,)), 'past its limit of -6 rad/s^2'),
    (trajectory((FAR,), times=(5.0, 10.0, 15.0)), "the position of joint 'elbow' would be"),
    (trajectory((FAR,), times=(0.0, 5.0, 10.0)), 'limits.position_lower'),
    (points_at(1.0, 3601.0), 'it takes 3601 s, longer than 3600 s: send it in pieces'),
    (points_at(*range(1, 1002)), 'it has 1001 points, more than 1000: send it in pieces'),
)


def test_invalid_trajectory_is_rejected_with_the_reason():
    for bad, reason in BAD:
        with pytest.raises(TrajectoryError) as rejection:
            plan(bad)
        assert isinstance(rejection.value, MotionError)
        assert reason in str(rejection.value)


def test_all_problems_are_reported_at_once():
    points = TrajectoryPoint(1.0, (1.0,)), TrajectoryPoint(2.0, (NAN, 1.0))
    with pytest.raises(TrajectoryError) as rejection:
        plan(Trajectory(('shoulder', 'wrist'), points))
    assert len(rejection.value.problems) == 3


def moving(velocity, acceleration=(0.0, 0.0)):
    """A reference at zero with these derivatives at t = 0."""
    terms = np.zeros((1, 2, 6))
    terms[0, :, 1], terms[0, :, 2] = velocity, 0.5 * np.asarray(acceleration)
    return pack(2, [spline_term(np.zeros(1), terms)])


speeds = st.floats(-1.4, 1.4)


@hypothesis.given(
    velocity=st.tuples(speeds, speeds),
    acceleration=st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)),
    goal=st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0)),
    time=st.floats(8.0, 600.0),
    count=st.integers(1, 3),
)
def test_goal_with_much_time_is_not_overshot_by_more_than_the_braking_distance(
    velocity, acceleration, goal, time, count
):
    """Without braking first, the reference swings by 0.2 v T: 56 m for a joint with 1.4 rad/s."""
    fields = np.array([goal, np.zeros(2), np.zeros(2)])[:count, np.newaxis]
    motion = plan(trajectory(fields, times=(time,)), moving(velocity, acceleration), 0.0)
    times = np.linspace(0.0, time + 1.0, 20_001)
    qr, dqr, _ = sampled(motion.vector, times).transpose(1, 0, 2)
    # All joints brake together, at no more than half of 6 rad/s^2, ddqr aside.
    h = max(0.2, 3.0 * max(map(abs, velocity)) / 6.0)
    room = 0.5 * h * np.abs(velocity) + h**2 * np.abs(acceleration) / 6.0 + 1e-9
    assert np.all(qr >= np.minimum(0.0, goal) - room)
    assert np.all(qr <= np.maximum(0.0, goal) + room)
    np.testing.assert_allclose(qr[-1], goal, atol=1e-9)
    np.testing.assert_array_equal(dqr[-1], (0.0, 0.0))


@pytest.mark.parametrize(('speed', 'goal', 'time'), [(1.4, 0.3, 0.45), (0.6, 0.9, 1.0)])
def test_point_that_needs_more_time_for_braking_is_still_reached(speed, goal, time):
    """The gentle braking does not fit, or leaves too little time; up to all the time there is."""
    sent = trajectory((np.array([[goal, 0.0]]),), times=(time,))
    motion = plan(sent, moving((speed, 0.0)), 0.0)
    np.testing.assert_allclose(at(motion.vector, time), [(goal, 0.0), (0, 0), (0, 0)], atol=1e-9)
