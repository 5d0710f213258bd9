# SPDX-License-Identifier: Apache-2.0
"""The reference: its terms, and sent trajectories, how they join it, and every rejection."""

from __future__ import annotations

import os

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st

import blf_dsc_controller as blf
from blf_dsc_controller.reference import retargeting
from blf_dsc_controller.reference import terms as reference
from blf_dsc_controller.reference.stream import TargetStream
from blf_dsc_controller.reference.terms import (
    minimum_jerk,
    pack,
    pieces_of,
    remaining,
    sampled,
    sinusoids_term,
    spline_term,
    unpack,
)
from blf_dsc_controller.reference.trajectory import (
    Trajectory,
    plan_trajectory,
)

JOINTS = ('shoulder', 'elbow')


def limited(lower, upper):
    """Return a configuration with position limits [rad], 1.5 rad/s and 6 rad/s^2."""
    given = {'position_lower': lower, 'position_upper': upper}
    given |= {'velocity': [1.5, 1.5], 'acceleration': [6.0, 6.0]}
    limits = {f'limits.{name}': values for name, values in given.items()}
    return blf.change(blf.ControllerConfig(), limits | {'joints': list(JOINTS)})


LIMITS = limited([-4.0, -3.0], [4.0, 3.0])
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
    points = tuple(
        blf.TrajectoryPoint(t, *(tuple(row.tolist()) for row in each))
        for t, *each in rows
    )
    return Trajectory(joints, points, begin)


def plan(sent, vector=None, now=NOW):
    return plan_trajectory(sent, PAPER if vector is None else vector, now, LIMITS)


def at(vector, t):
    return sampled(vector, np.array([t]))[0]


@pytest.mark.parametrize('fields', FIELDS.values(), ids=FIELDS)
def test_trajectory_continues_the_reference_passes_its_points_and_holds_the_last(
    fields,
):
    motion = plan(trajectory(fields))
    assert motion.settled == NOW
    np.testing.assert_allclose(at(motion.vector, NOW), at(PAPER, NOW), atol=1e-13)
    np.testing.assert_allclose(at(motion.vector, NOW + 1e-8), at(PAPER, NOW), atol=1e-6)
    passed = sampled(motion.vector, NOW + np.array(TIMES)).transpose(1, 0, 2)
    np.testing.assert_allclose(passed[: len(fields)], fields, atol=1e-12)
    times = np.linspace(NOW, NOW + 4.0, 40_001)
    qr, dqr, ddqr = sampled(motion.vector, times).transpose(1, 0, 2)
    # 6 rad/s^2 times 1e-4 s is the most that a velocity may change from one time to the
    # next.
    assert np.abs(np.diff(dqr, axis=0)).max() <= 6.0e-4 * 1.001
    if len(fields) != 2:  # cubics jump in acceleration at their points
        assert np.abs(np.diff(ddqr, axis=0)).max() < 0.02  # a jerk below 200 rad/s^3
    np.testing.assert_array_equal(qr[times > NOW + 3.5][-1], GOALS[-1])
    np.testing.assert_array_equal(at(motion.vector, 1e4), [GOALS[-1], (0, 0), (0, 0)])
    # Joints are matched by name.
    swapped = trajectory(tuple(field[:, ::-1] for field in fields), joints=JOINTS[::-1])
    np.testing.assert_array_equal(plan(swapped).vector, motion.vector)


def test_present_reference_continues_until_the_trajectory_begins_and_past_points_are_skipped():
    later = plan(trajectory(begin=5.0)).vector
    for t in (NOW, 4.0, 4.999):
        np.testing.assert_array_equal(at(later, t), at(PAPER, t))
    np.testing.assert_allclose(at(later, 5.0), at(PAPER, 5.0), atol=1e-13)
    np.testing.assert_allclose(at(later, 6.0)[0], GOALS[0], atol=1e-12)
    late = plan(trajectory(begin=NOW - 1.5)).vector
    np.testing.assert_allclose(at(late, NOW), at(PAPER, NOW), atol=1e-13)
    np.testing.assert_allclose(at(late, NOW + 0.5)[0], GOALS[1], atol=1e-12)


REPEATED = trajectory((np.hstack((GOALS, GOALS[:, 1:])),), joints=(*JOINTS, 'elbow'))
NOT_FINITE = VELOCITIES + np.array([[0.0], [np.inf], [0.0]])
MIXED = (
    blf.TrajectoryPoint(1.0, (1.6, 1.2), (0.0, 0.0)),
    blf.TrajectoryPoint(2.0, (1.6, 1.2)),
)
BAD = (
    (
        trajectory(joints=('shoulder', 'wrist')),
        "'wrist', but each of 'shoulder', 'elbow' is",
    ),
    (REPEATED, "'shoulder', 'elbow' is needed once"),
    (Trajectory(JOINTS, ()), 'it has no points'),
    (Trajectory(JOINTS, (blf.TrajectoryPoint(1.0, (1.0,)),)), '[1.0], but 2 finite'),
    (Trajectory(JOINTS, MIXED), 'do not all give the same'),
    (trajectory((GOALS, NOT_FINITE)), 'point 2 has velocities [inf, inf], but 2'),
    (trajectory(times=(1.0, 2.0, 1.5)), 'point 3 is at 1.5 s, not after'),
    (trajectory(begin=-0.5), 'it ended 0.3 s ago'),
    (
        trajectory((FAR,), times=(5.0, 10.0, 15.0)),
        "point 2 has joint 'elbow' at 3.5 rad, past its limit of 3 rad",
    ),
    (
        trajectory((GOALS[:1],), times=(3601.0,)),
        'it takes 3601 s, longer than 3600 s: send it in pieces',
    ),
)


def test_invalid_trajectory_is_rejected_with_the_reason():
    for bad, reason in BAD:
        with pytest.raises(blf.TrajectoryError) as rejection:
            plan(bad)
        assert reason in str(rejection.value)


def moving(velocity, acceleration=(0.0, 0.0)):
    """A reference at zero with these derivatives at t = 0."""
    terms = np.zeros((1, 2, 6))
    terms[0, :, 1] = velocity
    terms[0, :, 2] = 0.5 * np.asarray(acceleration)
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
    motion = plan(
        trajectory(fields, times=(time,)), moving(velocity, acceleration), 0.0
    )
    times = np.linspace(0.0, time + 1.0, 20_001)
    qr, dqr, _ = sampled(motion.vector, times).transpose(1, 0, 2)
    # All joints brake together, at no more than half of 6 rad/s^2, ddqr aside.
    h = max(0.2, 3.0 * max(map(abs, velocity)) / 6.0)
    room = 0.5 * h * np.abs(velocity) + h**2 * np.abs(acceleration) / 6.0 + 1e-9
    assert np.all(qr >= np.minimum(0.0, goal) - room)
    assert np.all(qr <= np.maximum(0.0, goal) + room)
    np.testing.assert_allclose(qr[-1], goal, atol=1e-9)
    np.testing.assert_array_equal(dqr[-1], (0.0, 0.0))


# Trajectories that the limits do not allow as they are sent.


def limits_used(motion, begin, end):
    _, dqr, ddqr = sampled(motion.vector, np.linspace(begin, end, 20_001)).transpose(
        1, 0, 2
    )
    return (np.abs(dqr) / 1.5).max(), (np.abs(ddqr) / 6.0).max()


def test_path_that_is_too_fast_is_stretched_and_passes_its_points_in_order():
    sent = trajectory((GOALS,), times=(0.3, 0.5, 0.7))
    motion = plan(sent)
    assert motion.note.startswith('as fast as the limits allow: its end is ')
    assert motion.end > NOW + 0.7
    assert max(limits_used(motion, NOW, motion.end)) <= 1.0 + 1e-9
    times = np.linspace(NOW, motion.end, 20_001)
    q = sampled(motion.vector, times)[:, 0]
    nearest = [np.abs(q - goal).max(axis=1) for goal in GOALS]
    # 20,000 samples of a motion of some seconds at 1.5 rad/s are less than 1 mrad apart
    assert max(distance.min() for distance in nearest) < 1e-3
    passed = [int(distance.argmin()) for distance in nearest]
    assert passed == sorted(passed)
    np.testing.assert_allclose(at(motion.vector, motion.end)[0], GOALS[-1], atol=1e-9)


def test_chunk_whose_first_points_cannot_be_reached_in_time_keeps_the_later_ones():
    """Bare positions of a curve: it is followed with the velocities that these mean."""
    times = 0.05 * np.arange(1, 11)
    curve = 0.4 * times + 0.5 * times**2
    chunk = trajectory((GOALS[:1] + curve[:, None],), times=times)
    at_rest = pack(2, [minimum_jerk(np.zeros(1), GOALS[:1])])
    motion = plan(chunk, at_rest, NOW)
    assert motion.note.startswith('its path is joined after ')
    assert motion.end == pytest.approx(NOW + 0.5)
    joined = NOW + times[NOW + times > motion.settled]
    assert joined.size > 2
    np.testing.assert_allclose(
        sampled(motion.vector, joined)[:, 0],
        GOALS[0] + curve[-joined.size :, None],
        atol=1e-9,
    )
    rates = sampled(motion.vector, joined[:-1])[:, 1]
    wanted = 0.4 + times[-joined.size : -1]
    np.testing.assert_allclose(rates, np.tile(wanted, (2, 1)).T, rtol=0.05)
    assert max(limits_used(motion, NOW, motion.end)) <= 1.0 + 1e-9


# Random sequences of trajectories, chunks, streamed targets and stops, adopted as the
# guard does: planned from the reference in force at one sample for a time ahead, and
# followed from a later sample on. A stop takes effect at once.
SEQUENCES = 10_000 if os.environ.get('NIGHTLY') else 150
WITH_KINK = 1877  # whose jerk jumps within a blend, between two samples
PERIOD = 1e-3  # s
FASTEST = np.array(LIMITS.limits.velocity)
STRONGEST = np.array(LIMITS.limits.acceleration)


def random_trajectory(rng, at, vector):
    """Return a trajectory of 1 to 4 points near the reference, that may begin later or earlier."""
    count = rng.integers(1, 5)
    times = np.cumsum(rng.uniform(0.02, 0.8, count))
    if rng.random() < 0.1:
        times[0] = 0.0
    start = sampled(vector, np.array([at]))[0]
    steps = (
        rng.normal(size=(count, 2)) * 0.3 * np.append(times[0], np.diff(times))[:, None]
    )
    ballistic = start[0] + 0.7 * start[1] * times[0]
    fields = [ballistic + np.cumsum(steps, axis=0)]
    for _ in range(rng.integers(0, 3)):
        rates = rng.normal(size=(count, 2)) * 0.1
        rates[-1] = 0.0
        fields.append(rates)
    begin = None
    if rng.random() < 0.4:
        begin = at + rng.uniform(-0.3, 0.5)
    return trajectory(fields, times=times.tolist(), begin=begin)


def check_seams(before, vector, first, last):
    """Check a reference against that before it until it begins, and both sides of each seam."""
    times = PERIOD * np.arange(first, last + 1)
    old, new = (sampled(each, times)[:, :2] for each in (before, vector))
    np.testing.assert_allclose(new, old, rtol=0.0, atol=1e-9)
    seams = []
    for term in unpack(vector):
        seams += [term.begin, term.settled]
        if term.code == reference.SPLINE:
            seams += pieces_of(term, 2)[0].tolist()
    after = np.array([seam for seam in seams if seam > times[0]])
    both = [sampled(vector, each)[:, :2] for each in (np.nextafter(after, 0.0), after)]
    np.testing.assert_allclose(*both, rtol=0.0, atol=1e-9)


def random_chunk(rng, at, vector):
    """Return bare positions every 50 ms, the first ones late or in the past, that end in motion."""
    times = 0.05 * np.arange(1.0, rng.integers(4, 20))
    start = sampled(vector, np.array([at]))[0]
    slope = start[1] + rng.normal(size=2) * 0.2
    curve = rng.normal(size=2) * 0.5
    t = times[:, np.newaxis]
    positions = start[0] + rng.normal(size=2) * 0.003 + t * slope + t * t * curve
    begin = at + rng.uniform(-0.1, 0.05)
    return trajectory((positions,), times=times.tolist(), begin=begin)


def random_target(rng, stream, at, vector):
    """Return the next target of a stream, which moves, jumps, or gives its velocity."""
    start = sampled(vector, np.array([at]))[0]
    size = rng.choice([0.001, 0.02, 0.5])
    given = rng.normal(size=2) if rng.random() < 0.3 else None
    return stream.target(
        at,
        start[0] + 0.05 * start[1] + size * rng.normal(size=2),
        timeout=0.25,
        velocities=given,
        ahead=float(rng.uniform(0.0, 0.2)) if given is not None else 0.0,
    )


def random_plan(rng, stream, at, vector):
    """Return the reference of a random command that is planned for a time."""
    kind = rng.choice(['trajectory', 'chunk', 'target'], p=[0.4, 0.2, 0.4])
    if kind == 'target':
        target = random_target(rng, stream, at, vector)
        return retargeting.plan_target(target, vector, at, LIMITS).vector
    make = random_trajectory if kind == 'trajectory' else random_chunk
    return plan(make(rng, at, vector), vector, at).vector


def sequence_of_references(seed):
    """Return the reference (k, 3, 2) at every sample, while ten commands are sent."""
    rng = np.random.default_rng(seed)
    stream = TargetStream()
    vector, sample, seen, accepted = PAPER, 3300, [], 0
    for _ in range(10):
        is_stop = rng.random() < 0.15
        lead = 0 if is_stop else int(rng.choice([0, 4, 20, 160, 320]))
        taken = int(rng.integers(0, lead + 1))  # samples that planning takes
        at = (sample + lead) * PERIOD
        try:
            if is_stop:
                planned = retargeting.plan_stop(vector, at, LIMITS).vector
            else:
                planned = random_plan(rng, stream, at, vector)
        except blf.TrajectoryError:
            planned = vector
        seen.append(sampled(vector, PERIOD * np.arange(sample, sample + taken)))
        sample += taken
        accepted += planned is not vector
        before, vector = vector, remaining(planned, (sample - 1) * PERIOD)
        check_seams(before, vector, sample - 1, sample + lead - taken)
        assert len(unpack(remaining(vector, 1e3))) == 1  # what is finished is forgotten
        gap = int(rng.choice([1, 7, 10, 50, 400, 1500]))
        seen.append(sampled(vector, PERIOD * np.arange(sample, sample + gap)))
        sample += gap
    return np.concatenate(seen), accepted


def test_random_sequences_of_commands_never_jump_and_keep_the_limits():
    """What velocity and acceleration at two samples explain: Taylor's remainders.

    Between two samples h apart, the velocity changes by at most the largest
    acceleration a times h, and the position by h times the mean of the velocities, up
    to a h^2 / 4. `check_seams` finds smaller jumps.
    """
    accepted = 0
    for seed in (*range(SEQUENCES), WITH_KINK):
        reference, count = sequence_of_references(seed)
        accepted += count
        q, v, a = reference.transpose(1, 0, 2)
        # Blends are checked every 1 ms and where their jerk jumps: between, 1e-3 of
        # their acceleration is missed.
        assert np.all(np.abs(a) <= STRONGEST * 1.001), seed
        assert np.all(np.abs(v) <= FASTEST * 1.001), seed
        rise = np.abs(np.diff(v, axis=0))
        assert np.all(rise <= PERIOD * STRONGEST * 1.001 + 1e-9), seed
        mean = 0.5 * PERIOD * (v[1:] + v[:-1])
        slack = 0.25 * PERIOD * PERIOD * STRONGEST * 1.001
        slip = np.abs(np.diff(q, axis=0) - mean)
        assert np.all(slip <= slack + 1e-9), seed
    assert accepted > 3 * SEQUENCES  # of ten in each
