# SPDX-License-Identifier: Apache-2.0
"""Approaches: from the state of the arm to the reference, within the limits."""

from __future__ import annotations

import numpy as np
import pytest

from blf_dsc_controller.configuration.controller import Approach, ControllerConfig, MotionLimits
from blf_dsc_controller.reference.approach import blend, stop
from blf_dsc_controller.reference.limits import MotionError, worst_violation
from blf_dsc_controller.reference.polynomials import minimum_jerk
from blf_dsc_controller.reference.terms import pack, sampled, sinusoids_term

JOINTS = ('shoulder', 'elbow')
PAPER = sinusoids_term((1.9935, 1.3961), (0.3, 0.3), (1.0,), (0.0,))
POINTS = minimum_jerk(np.array([0.0, 5.0, 11.0]), np.array([[0.0, 1.0], [1.0, -1.0], [0.3, 0.0]]))
T0 = 1.7  # s
AT_REST = np.array([[-0.4, 2.9], [0.0, 0.0]])
MOVING = np.array([[0.8, 1.5], [0.6, -0.9]])


def limits(velocity=(1.5, 1.5), acceleration=(2.0, 2.0), reach=(6.0, 6.0), longest=30.0):
    lower = tuple(-limit for limit in reach)
    allowed = MotionLimits(lower, reach, velocity, acceleration)
    return ControllerConfig(JOINTS, limits=allowed, approach=Approach(longest=longest))


def approach_to(main, start, limits):
    """Motion to `main` from a measured state."""
    return blend([stop(T0, *start, limits)], main, T0, limits)


def at(vector, t):
    return sampled(vector, np.array([t]))[0]


@pytest.mark.parametrize('main', [PAPER, POINTS], ids=['sinusoids', 'points'])
@pytest.mark.parametrize('start', [AT_REST, MOVING], ids=['at rest', 'moving'])
def test_approach_begins_at_the_measured_state_and_ends_on_the_reference(main, start):
    motion = approach_to(main, start, limits())
    before, after = motion.settled - 1e-7, motion.settled

    np.testing.assert_allclose(at(motion.vector, T0), [*start, (0.0, 0.0)], atol=1e-12)
    for t in (after, after + 1.0, 1e4):
        np.testing.assert_array_equal(at(motion.vector, t), at(pack(2, [main]), t))
    # 1e-5 allows for the jerk over 1e-7 s: position, velocity and acceleration do not jump.
    np.testing.assert_allclose(at(motion.vector, before), at(motion.vector, after), atol=1e-5)


@pytest.mark.parametrize('main', [PAPER, POINTS], ids=['sinusoids', 'points'])
@pytest.mark.parametrize('start', [AT_REST, MOVING], ids=['at rest', 'moving'])
def test_approach_keeps_the_limits_and_a_slightly_shorter_one_would_not(main, start):
    motion = approach_to(main, start, limits())
    fine = np.linspace(T0, motion.settled + 10.0, 100_001)
    _, dqr, ddqr = sampled(motion.vector, fine).transpose(1, 0, 2)

    # The planner looks at times a 200th of the approach apart or closer: it misses at most 0.1 %.
    assert np.all(np.abs(dqr).max(axis=0) <= 1.001 * np.array(limits().limits.velocity))
    assert np.all(np.abs(ddqr).max(axis=0) <= 1.001 * np.array(limits().limits.acceleration))
    shorter = 0.98 * (motion.settled - T0)
    with pytest.raises(MotionError):
        approach_to(main, start, limits(longest=shorter))


def test_each_joint_keeps_its_own_limits():
    motion = approach_to(PAPER, AT_REST, limits(velocity=(0.4, 3.0), acceleration=(9.0, 1.0)))
    _, dqr, ddqr = sampled(motion.vector, np.linspace(T0, 40.0, 40_001)).transpose(1, 0, 2)
    assert np.abs(dqr[:, 0]).max() == pytest.approx(0.4, rel=0.05)  # the active limit is reached
    assert np.abs(ddqr[:, 1]).max() <= 1.001


def test_running_reference_blends_into_another_without_a_jump():
    motion = blend([PAPER], POINTS, T0, limits())
    np.testing.assert_allclose(
        at(motion.vector, T0), at(pack(2, [PAPER]), T0), rtol=1e-14, atol=1e-14
    )
    np.testing.assert_array_equal(
        at(motion.vector, motion.settled), at(pack(2, [POINTS]), motion.settled)
    )


def test_reference_beyond_the_limits_is_rejected_with_the_name_of_the_joint():
    with pytest.raises(MotionError) as rejection:
        approach_to(PAPER, AT_REST, limits(velocity=(1.0, 0.25)))

    violation = rejection.value.violation
    assert (violation.joint, violation.quantity) == ('elbow', 'velocity')
    assert abs(violation.value) == pytest.approx(0.3, rel=1e-4)  # 0.3 sin t
    assert abs(violation.limit) == 0.25
    assert 'limits.velocity' in str(rejection.value)


def test_arm_that_is_already_too_fast_is_rejected_with_the_name_of_the_joint():
    start = MOVING.copy()
    start[1, 0] = -1.7
    with pytest.raises(MotionError) as rejection:
        approach_to(PAPER, start, limits())

    violation = rejection.value.violation
    assert (violation.joint, violation.quantity, violation.limit) == ('shoulder', 'velocity', -1.5)
    assert violation.value <= -1.7
    for part in ('shoulder', '-1.5 rad/s', 'at most 30 s', 'approach.longest'):
        assert part in str(rejection.value)


def test_approach_that_would_take_too_long_is_rejected():
    with pytest.raises(MotionError):
        approach_to(PAPER, AT_REST, limits(longest=0.5))


def test_positions_are_checked_relative_to_the_middle_of_their_range():
    allowed = MotionLimits((-1.0, 0.5), (3.0, 1.5), (9.0, 9.0), (9.0, 9.0))
    config = ControllerConfig(JOINTS, limits=allowed)
    violation = worst_violation(pack(2, [PAPER]), np.linspace(0.0, 7.0, 1001), config)
    assert (violation.joint, violation.quantity, violation.limit) == ('elbow', 'position', 1.5)
    assert violation.value == pytest.approx(1.6961, abs=1e-5)
    assert worst_violation(pack(2, [PAPER]), np.linspace(2.0, 4.0, 101), config) is None
