# SPDX-License-Identifier: Apache-2.0
"""Approaches within the limits, and starts from anywhere: the bound holds, or a rejection."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from fault_table import Rig

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.motion_groups import (
    Approach,
    MotionLimits,
    Reference,
)
from blf_dsc_controller.configuration.nodes import CONTROLLER, load
from blf_dsc_controller.configuration.plant import Initial, PlantConfig
from blf_dsc_controller.configuration.schema import build, change
from blf_dsc_controller.errors import (
    ConfigurationError,
    StartError,
)
from blf_dsc_controller.factory.controller import begin, controller_of
from blf_dsc_controller.reference.approach import (
    MotionError,
    blend,
    end_of_waypoints,
    plan_start,
    reference_of,
    stop,
    worst_violation,
)
from blf_dsc_controller.reference.terms import (
    minimum_jerk,
    pack,
    sampled,
    sinusoids_term,
    unpack,
)
from blf_dsc_controller.simulation.loop import simulate

JOINTS = ('shoulder', 'elbow')
PAPER = sinusoids_term((1.9935, 1.3961), (0.3, 0.3), (1.0,), (0.0,))
POINTS = minimum_jerk(
    np.array([0.0, 5.0, 11.0]), np.array([[0.0, 1.0], [1.0, -1.0], [0.3, 0.0]])
)
T0 = 1.7  # s
AT_REST = np.array([[-0.4, 2.9], [0.0, 0.0]])
MOVING = np.array([[0.8, 1.5], [0.6, -0.9]])


def limits(
    velocity=(1.5, 1.0), acceleration=(4.0, 1.5), reach=(6.0, 6.0), longest=30.0
):
    lower = tuple(-limit for limit in reach)
    allowed = MotionLimits(lower, reach, velocity, acceleration)
    return ControllerConfig(JOINTS, limits=allowed, approach=Approach(longest=longest))


def approach_to(main, start, limits):
    """Motion to `main` from a measured state."""
    return blend([stop(T0, *start, limits)], main, T0, limits)


def maxima(motion, end):
    """Largest velocity and acceleration of each joint from T0 on (2, n)."""
    fine = np.linspace(T0, end, 100_001)
    return np.abs(sampled(motion.vector, fine)[:, 1:]).max(axis=0)


def at(vector, t):
    return sampled(vector, np.array([t]))[0]


def test_target_is_checked_beyond_the_longest_blend():
    """A short blend is over long before the target is too fast."""
    late = minimum_jerk(T0 + np.array([5.0, 5.5]), np.array([[0.0, 0.0], [3.0, 0.0]]))
    start = stop(T0, *np.zeros((2, 2)), limits())
    with pytest.raises(MotionError, match='the reference exceeds the limits'):
        blend([start], late, T0, limits(), longest=1.0)
    blend([start], late, T0, limits(longest=2.0), longest=1.0)


@pytest.mark.parametrize('main', [PAPER, POINTS], ids=['sinusoids', 'points'])
@pytest.mark.parametrize('start', [AT_REST, MOVING], ids=['at rest', 'moving'])
def test_approach_leads_from_the_measured_state_to_the_reference_as_fast_as_allowed(
    main, start
):
    motion = approach_to(main, start, limits())
    before = motion.settled - 1e-7
    after = motion.settled
    np.testing.assert_allclose(at(motion.vector, T0), [*start, (0.0, 0.0)], atol=1e-12)
    for t in (after, after + 1.0, 1e4):
        np.testing.assert_array_equal(at(motion.vector, t), at(pack(2, [main]), t))
    # 1e-5 allows for the jerk over 1e-7 s: position, velocity and acceleration do not
    # jump.
    np.testing.assert_allclose(
        at(motion.vector, before), at(motion.vector, after), atol=1e-5
    )
    # The planner looks at times a 200th of the approach apart or closer: it misses at
    # most 0.1 %.
    allowed = limits().limits.velocity, limits().limits.acceleration
    assert np.all(maxima(motion, motion.settled + 10.0) <= 1.001 * np.array(allowed))
    with pytest.raises(MotionError):
        approach_to(main, start, limits(longest=0.98 * (motion.settled - T0)))


def test_motion_beyond_the_limits_is_rejected_with_the_name_of_the_joint():
    with pytest.raises(MotionError, match=r'limits\.velocity') as rejection:
        approach_to(PAPER, AT_REST, limits(velocity=(1.0, 0.25)))
    violation = rejection.value.violation
    assert (violation.joint, violation.quantity) == ('elbow', 'velocity')
    assert abs(violation.value) == pytest.approx(0.3, rel=1e-4)  # 0.3 sin t
    assert abs(violation.limit) == 0.25

    start = MOVING.copy()
    start[1, 0] = -1.7  # too fast already
    with pytest.raises(MotionError) as rejection:
        approach_to(PAPER, start, limits())
    violation = rejection.value.violation
    assert (violation.joint, violation.quantity, violation.limit) == (
        'shoulder',
        'velocity',
        -1.5,
    )
    assert violation.value <= -1.7
    for part in ('shoulder', '-1.5 rad/s', 'at most 30 s', 'approach.longest'):
        assert part in str(rejection.value)


def test_positions_are_checked_relative_to_the_middle_of_their_range():
    allowed = MotionLimits((-1.0, 0.5), (3.0, 1.5), (9.0, 9.0), (9.0, 9.0))
    config = ControllerConfig(JOINTS, limits=allowed)
    violation = worst_violation(pack(2, [PAPER]), np.linspace(0.0, 7.0, 1001), config)
    assert (violation.joint, violation.quantity, violation.limit) == (
        'elbow',
        'position',
        1.5,
    )
    assert violation.value == pytest.approx(1.6961, abs=1e-5)
    assert worst_violation(pack(2, [PAPER]), np.linspace(2.0, 4.0, 101), config) is None


@pytest.mark.parametrize(
    ('speed', 'acceleration', 'quantity'),
    [(0.2, 0.1, 'acceleration'), (0.1, 0.2, 'velocity')],
)
def test_violation_is_the_largest_of_all_quantities(speed, acceleration, quantity):
    """Of 0.3 sin t, whose velocity and acceleration reach 0.3."""
    wide = (9.0, 9.0)
    allowed = MotionLimits((-9.0, -9.0), wide, (9.0, speed), (9.0, acceleration))
    config = ControllerConfig(JOINTS, limits=allowed)
    violation = worst_violation(pack(2, [PAPER]), np.linspace(0.0, 7.0, 1001), config)
    assert (violation.joint, violation.quantity) == ('elbow', quantity)
    assert violation.ratio == pytest.approx(3.0, rel=1e-3)


CONFIG = ControllerConfig()
FIRST = np.array([2.2935, 1.6961])  # qr(0)
STILL = np.zeros(2)
BOUND = 2e-3  # rad
STARTS = FIRST + np.random.default_rng(7).uniform(-2.0, 2.0, (4, 2))


def run(config, start, duration, velocity=(0.0, 0.0)):
    """Time, qr, dqr, xi1 and torque of a run from a state."""
    initial = Initial(tuple(start), velocity)
    plant = replace(PlantConfig(), initial=initial, duration=float(duration))
    record = simulate(config, plant)
    qr, dqr, xi1, _, torque = np.split(record.samples[:, :10], 5, axis=1)
    return record.stamps * 1e-9, qr, dqr, xi1, torque


@pytest.mark.parametrize('start', STARTS, ids=range(4))
def test_arm_reaches_the_reference_from_anywhere_within_the_bound(start):
    settled = begin(controller_of(CONFIG), CONFIG, start, STILL)
    t, qr, _, xi1, _ = run(CONFIG, start, 12.0)
    assert 0.5 < settled < 5.0  # a step of 2 rad at 1.5 rad/s takes 2.5 s
    assert np.abs(xi1).max() < BOUND
    np.testing.assert_allclose(qr[0], start, atol=1e-12)
    away = np.abs(qr - sampled(reference_of(CONFIG), t)[:, 0])
    assert away[t >= settled].max() <= 1e-14
    assert away[t < settled].max() > BOUND


@pytest.mark.parametrize(
    ('speed', 'frequency', 'upper', 'share'),
    [
        (0.6, 1.0, 6.0, 0.6),
        (0.0, 1.0, 6.0, 1.0),  # from rest
        (0.011, 1.0, 6.0, 1.0),  # which is a step of the velocity of a Damiao motor
        (1.0, 1.0, 6.0, 1.0),  # it would take 4.8 s
        # braked by half of 2 rad/s^2 within 0.27 rad from 2.3 rad, by half of 1.2 in 0.45 rad
        (0.6, 1.0, 2.65, 1.0),
        (0.6, 2.2, 6.0, 1.0),  # the reference itself has 1.45 rad/s^2
    ],
)
def test_arm_in_motion_is_taken_over_gently_where_that_is_possible(
    speed, frequency, upper, share
):
    config = replace(
        CONFIG,
        reference=replace(CONFIG.reference, frequency=(frequency,)),
        limits=replace(CONFIG.limits, position_upper=(upper, upper)),
    )
    start, velocity = np.array([2.3, 1.4]), np.array([speed, 0.0])
    motion = plan_start(config, np.full(2, BOUND), start, velocity)
    t = np.linspace(0.0, motion.settled, 10_000)
    q, _, ddq = sampled(motion.vector, t).transpose(1, 0, 2)
    used = (np.abs(ddq) / config.limits.acceleration).max()
    assert used <= share * 1.001
    assert used > 0.6 * 1.001 or share < 1.0
    assert q.max() <= upper


def test_fast_reference_is_approached_through_rest_at_its_middle():
    """At 96 % of the velocity limit it leaves too little speed to cover four radians directly."""
    config = replace(
        CONFIG,
        reference=Reference(amplitude=(0.72, 0.72), frequency=(2.0,), phase=(0.0,)),
        limits=replace(CONFIG.limits, acceleration=(3.0, 3.0)),
        approach=Approach(longest=15.0),  # s; the direct approach takes 19 s
    )
    start = np.array(config.reference.offset) + 4.0
    motion = plan_start(config, np.full(2, BOUND), start, STILL)
    assert len(unpack(motion.vector)) == 3
    assert motion.settled <= config.approach.longest
    t = np.linspace(0.0, motion.settled + 5.0, 20_000)
    q, dq, ddq = sampled(motion.vector, t).transpose(1, 0, 2)
    np.testing.assert_allclose(q[0], start)
    assert np.all(np.abs(dq) <= config.limits.velocity)
    assert np.all(np.abs(ddq) <= config.limits.acceleration)
    assert np.abs(np.diff(q, axis=0)).max() < 1e-2
    after = t >= motion.settled
    np.testing.assert_array_equal(
        q[after], sampled(reference_of(config), t[after])[:, 0]
    )


def test_start_inside_the_bound_needs_no_approach():
    law = controller_of(CONFIG)
    assert begin(law, CONFIG, FIRST + 0.9 * BOUND, STILL, 0.0) == 0.0
    np.testing.assert_array_equal(law.reference_vector, reference_of(CONFIG))
    # It may begin later: the paper's reference is 0.6 rad away by then.
    assert begin(law, CONFIG, FIRST, STILL, 3.0) > 3.0
    np.testing.assert_allclose(law.reference_at(3.0), [FIRST, STILL, STILL], atol=1e-12)


TIMES = {'reference.times': [0.0, 1.0], 'reference.waypoints': [0.0] * 3}
REPEATED = {'reference.times': [0.0, 1.0, 1.0], 'reference.waypoints': [0.0] * 6}
SWINGING = {'reference.phase': [-np.pi / 2]}  # passes its middle at 0.3 rad/s at t = 0


def test_start_that_is_too_slow_is_rejected_if_approaches_are_disabled():
    config = build(ControllerConfig, SWINGING | {'approach.enabled': False})
    law = controller_of(config)
    offset = np.array(config.reference.offset)
    moving = np.full(2, 0.3)
    with pytest.raises(StartError, match=r'starts -0.* velocity'):
        begin(law, config, offset, STILL)
    assert begin(law, config, offset, moving) == 0.0
    # Catching up takes v^2 / (2 a) = 0.9 bounds at a = 2 rad/s^2, which leaves a tenth
    # of it.
    slower = moving - np.sqrt(2.0 * 2.0 * 0.9 * BOUND)
    assert begin(law, config, offset + 0.09 * BOUND, slower) == 0.0
    with pytest.raises(StartError, match='velocity'):
        begin(law, config, offset + 0.11 * BOUND, slower)


def test_hold_reference_stays_where_the_arm_is_or_where_it_comes_to_rest():
    config = build(ControllerConfig, {'reference.type': 'hold'})
    _, qr, _, xi1, _ = run(config, FIRST - 0.7, 1.0)
    np.testing.assert_array_equal(qr, np.tile(FIRST - 0.7, (1001, 1)))
    assert np.abs(xi1).max() < BOUND
    _, qr, _, xi1, _ = run(config, FIRST, 6.0, velocity=(0.5, -0.5))
    # at half of 2 rad/s^2, on average, from 0.5 rad/s: 3 v / 4 s
    brakes = 0.5 * (3.0 * 0.5 / 2.0) * np.array([0.5, -0.5])
    np.testing.assert_allclose(qr[-1], FIRST + brakes, atol=1e-12)
    assert np.abs(xi1).max() < 0.5 * BOUND


@pytest.mark.parametrize('velocity', ['measured', 'estimated'])
@pytest.mark.parametrize('rest', [True, False])
def test_reactivation_on_the_reference_tracks_at_once_only_at_its_velocity(
    rest, velocity
):
    """An arm that the brakes hold needs an approach.

    One that moves with the reference joins it within 0.1 s.
    """
    rig = Rig({'safety.velocity': velocity, 'torque.limit': [40.0, 40.0]})
    rig.step(1500)  # at 0.3 rad/s
    rig.guard.deactivate()
    if rest:
        rig.plant.state[3:5] = 0.0
    rig.step(1)
    rig.guard.starting.activate()
    first = len(rig.commands)
    rig.step(1500)
    assert rig.guard.supervisor.running, rig.supervisor.text
    assert rig.guard.samples.ratio.max() < 0.6
    # it starts from the beginning, or goes on
    assert (rig.guard.reference.time < 2.0) == rest
    assert rest or rig.guard.reference.settled < 1.6
    assert np.abs(rig.commands[first:]).max() < 15.0


def test_reference_continues_after_a_deactivation_but_begins_anew_after_a_stop():
    rig = Rig()
    rig.step(500)
    rig.guard.deactivate()
    rig.step(1)
    rig.guard.starting.activate()
    rig.step(500)
    assert rig.guard.reference.time == pytest.approx(1.0)
    rig.deliver(b'')
    rig.step(1)
    rig.guard.starting.activate()
    rig.step(1)
    assert rig.supervisor.running
    assert rig.guard.reference.time == 0.0


def test_waypoints_are_passed_at_their_times_and_the_last_is_held():
    points = np.array([[2.0, 1.0], [2.4, 1.5], [1.8, 1.2]])
    reference = Reference(
        type='waypoints', times=(0.0, 1.5, 3.5), waypoints=tuple(points.ravel())
    )
    motion = sampled(
        reference_of(replace(CONFIG, reference=reference)), [0.0, 1.5, 3.5, 5.0]
    )
    np.testing.assert_allclose(motion[:, 0], points[[0, 1, 2, 2]], atol=1e-12)
    np.testing.assert_array_equal(motion[[0, 2, 3], 1], 0.0)


BY_JOINT = [0.0, 0.1, 0.0, -1.0, 0.0, 1.0]  # two points of three joints


@pytest.mark.parametrize(
    ('given', 'remedy'),
    [
        (
            {'reference.times': [0.0, 5.0], 'reference.points': BY_JOINT},
            r'write reference.waypoints: \[0.0, 0.0, 0.0, 0.1, -1.0, 1.0\]',
        ),
        ({'reference.points': [1.0]}, 'write them as reference.waypoints'),
        ({'reference.points': []}, 'leave it out'),
    ],
)
@pytest.mark.parametrize('section', ['blf_dsc_controller', '/**'])
def test_waypoints_of_an_older_file_are_refused_with_the_remedy(
    given, remedy, section, tmp_path
):
    """They stood joint by joint, and would silently be other postures."""
    lines = [f'    {name}: {value}' for name, value in given.items()]
    path = tmp_path / 'older.yaml'
    path.write_text('\n'.join([f'{section}:', '  ros__parameters:', *lines]))
    with pytest.raises(ConfigurationError, match='one row per point') as caught:
        load(path, CONTROLLER, ControllerConfig)
    (problem,) = (each for each in caught.value.problems if 'replaced by' in each)
    assert problem.startswith(f'line {2 + len(given)}: reference.points: ')
    assert re.search(remedy, problem)


def test_waypoints_of_an_arm_are_read_point_by_point_and_their_end_is_told():
    robot = {'robot.urdf': 'ur5e.urdf', 'robot.tip': 'tool0'}
    rest, end = [0.0] * 6, [0.1, -1.0, 1.0, 0.0, 0.0, 0.0]
    between = [0.2, -0.5, 0.5, 0.3, 0.2, 0.1]
    times = {'reference.type': 'waypoints', 'reference.times': [0.0, 3.0, 5.0]}
    points = {'reference.waypoints': rest + between + end}
    config = build(ControllerConfig, robot | times | points)
    motion = sampled(reference_of(config), [3.0, 5.0])
    np.testing.assert_allclose(motion[:, 0], [between, end])
    assert end_of_waypoints(config) == (
        'the waypoints end after 5 s at shoulder_pan_joint 0.1 rad, shoulder_lift_joint -1 rad, '
        'elbow_joint 1 rad, wrist_1_joint 0 rad, wrist_2_joint 0 rad, wrist_3_joint 0 rad'
    )
    assert end_of_waypoints(CONFIG) == ''


@pytest.mark.parametrize(
    ('given', 'problem'),
    [
        ({'reference.type': 'spiral'}, 'type: got "spiral", but it must be one of'),
        ({'reference.type': 'waypoints'}, 'times: got none'),
        (REPEATED, 'times: got 1 s after 1 s, but they must increase'),
        (TIMES, r'waypoints: got 3, but 4 entries are needed'),
        ({'limits.velocity': [0.0, 1.0]}, 'limits.velocity: got 0.0 at entry 1'),
        (
            {'limits.position_lower': [1.0, 7.0]},
            'position_upper: got 6.28319 rad for joint2, but',
        ),
    ],
)
def test_invalid_reference_is_rejected_with_the_reason(given, problem):
    with pytest.raises(ConfigurationError, match=problem):
        build(ControllerConfig, given)


def test_new_bound_is_validated_by_its_present_width():
    rig = Rig({'barrier.initial_bound': [0.02, 0.02], 'barrier.funnel_rate': 1.0})
    rig.step(60)
    guard = rig.guard
    narrow = {'barrier.bound': [0.1 * np.abs(guard.controller.sample.xi1).max()] * 2}
    assert guard.problems(change(guard.config, narrow)) == []
    still = {'barrier.initial_bound': [0.0, 0.0], 'barrier.funnel_rate': 0.0}
    assert guard.problems(change(guard.config, narrow | still))


@pytest.mark.parametrize('at', [120.0, -2.0 * np.pi - 0.11])
def test_arm_far_beyond_its_limits_is_not_held(at):
    """For example, an arm that reports degrees."""
    config = replace(CONFIG, reference=Reference(type='hold'))
    with pytest.raises(
        StartError,
        match=r"joint 'joint2' would be held at .* rad, and its limits are -6.2.*degrees, give",
    ):
        plan_start(config, np.full(2, BOUND), np.array([0.0, at]), STILL)
    at_rest = np.array([0.0, 2.0 * np.pi + 0.09])
    assert plan_start(config, np.full(2, BOUND), at_rest, STILL).settled == 0.0
