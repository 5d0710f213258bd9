# SPDX-License-Identifier: Apache-2.0
"""Joints that turn without end: motions go the short way, and encoders may wrap."""

from __future__ import annotations

import re
from dataclasses import replace
from math import nan, pi, tau

import numpy as np
import pytest
from fault_table import JOINTS, MILLISECOND, Rig
from hypothesis import given
from hypothesis import strategies as st

import blf_dsc_controller as blf
from blf_dsc_controller import (
    ControllerConfig,
    Phase,
    PlantConfig,
    TrajectoryPoint,
    share_folder,
)
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.control.motion_input import MotionInput
from blf_dsc_controller.identification.recording import resampled
from blf_dsc_controller.messages.codecs import Float64MultiArrayEncoder
from blf_dsc_controller.reference.terms import sampled
from blf_dsc_controller.reference.trajectory import Trajectory, TrajectoryError
from blf_dsc_controller.reference.turns import short_way
from blf_dsc_controller.supervision.supervisor import Reason
from blf_dsc_controller.supervision.torque_watchdog import TorqueWatchdog
from blf_dsc_controller.supervision.wraps import Wraps
from sim_plant.plant import plant_of

BOUNDED = (share_folder() / 'config' / 'two_link.urdf').read_text()
ENDLESS = BOUNDED.replace('revolute', 'continuous')
ARM = {'robot.urdf': ENDLESS, 'robot.payload': 0.1}
# Both joints pass pi in either direction, joint1 at 0.6 rad/s at most.
SWING = {
    'reference.type': 'sinusoids',
    'reference.offset': [3.1, -3.1],
    'reference.amplitude': [0.3, 0.2],
    'reference.frequency': [2.0],
    'reference.phase': [0.0],
}
START = {'initial.position': [3.4, -2.9]}


def within_a_turn(q):
    """Return angles in (-pi, pi], as planners and many encoders have them."""
    return pi - np.mod(pi - np.asarray(q), tau)


def from_zero(q):
    """Return angles in [0, 2 pi), as others have them."""
    return np.mod(q, tau)


def rig_of(urdf=ENDLESS, wrap=None, start=START, **law):
    rig = Rig(
        {**ARM, **SWING, **law, 'robot.urdf': urdf}, plant=start | {'robot.urdf': urdf}
    )
    if wrap is not None:
        rig.sense = lambda state: [state.raw(q=wrap(state.q))]
    return rig


# Positions that wrap.


@pytest.mark.parametrize('lost', [np.nan, np.inf])
def test_a_turn_is_counted_across_a_state_whose_position_is_lost(lost):
    wraps = Wraps(build(ControllerConfig, {**ARM, **SWING}))
    for q in (np.pi - 1e-3, lost, -np.pi + 1e-3):
        measurement = np.zeros(6)
        measurement[0] = q
        got, fault = wraps.count(measurement, 1e-3, 3.0)
    assert fault is None
    assert got[0] == pytest.approx(np.pi + 1e-3)


@pytest.mark.parametrize('velocity', ['measured', 'estimated'])
@pytest.mark.parametrize('wrap', [within_a_turn, from_zero])
def test_wrapping_positions_of_continuous_joints_change_no_torque(wrap, velocity):
    """The turns of [0, 2 pi) differ from those at the start by one for joint2, always."""
    plain, wrapped = (
        rig_of(wrap=each, **{'safety.velocity': velocity}) for each in (None, wrap)
    )
    sent = []
    for rig in (plain, wrapped):
        rig.step(4000)  # more than a period: each joint passes pi twice
        assert rig.supervisor.phase is Phase.TRACKING, rig.supervisor.text
        sent.append(np.array(rig.commands))
    # Rounding of a turn, 4e-16 rad, times the gains, which are below 1e6 N m/rad.
    np.testing.assert_allclose(sent[1], sent[0], atol=1e-8)


@pytest.mark.parametrize('damaged', [nan, 0.0])
def test_safe_torque_sees_no_wrap_when_velocities_are_lost(damaged):
    """They are then differenced from the positions, or contradicted by them."""
    sent = []
    for wrap in (None, within_a_turn):
        rig = rig_of(wrap=wrap, **{'safety.damping': [5.0, 5.0]})
        rig.step(200)
        sense = rig.sense
        rig.sense = lambda state, sense=sense: sense(
            state._replace(dq=np.full(2, damaged))
        )
        rig.step(1500)
        assert rig.supervisor.phase is Phase.SAFE_STOP
        sent.append(np.array(rig.commands))
    np.testing.assert_allclose(sent[1], sent[0], atol=1e-8)


@pytest.mark.parametrize('velocity', ['measured', 'estimated'])
def test_wrap_of_a_joint_with_a_range_is_named_and_its_torque_sees_none(velocity):
    """Differenced, it would be a velocity of 6283 rad/s, damped by all the torque there is."""
    law = {'safety.torque': 'hold_gravity', 'safety.velocity': velocity}
    rig = rig_of(BOUNDED, within_a_turn, {'initial.position': [3.0, -2.9]}, **law)
    while rig.supervisor.phase is not Phase.SAFE_STOP:
        rig.step()
        assert len(rig.commands) < 4000
    assert rig.supervisor.reason is Reason.WRAPPED
    assert re.search(
        r"the position of joint 'joint(1' has wrapped from 3|2' has wrapped from -3)\.14.*: let "
        'its driver count turns, or, if it turns without end, make it continuous in the URDF',
        rig.supervisor.text,
    )
    first = len(rig.commands)
    for _ in range(500):  # in which it wraps again
        rig.step()
        # A difference is that of half a sample before, and 110 rad/s^2 at most,
        # when the stop begins to brake.
        used = rig.guard.safe_torque.last.dq
        np.testing.assert_allclose(used, rig.state().dq, atol=0.055)
    assert np.abs(np.diff(rig.commands[first:], axis=0)).max() < 0.5  # N m


def test_positions_are_believed_at_the_next_start_after_a_wrap():
    """A driver that was restarted counts anew; nothing passes for a velocity."""
    start = {'initial.position': [3.0, -2.9]}
    for velocity in ('measured', 'estimated'):
        law = {'safety.torque': 'hold_gravity', 'safety.velocity': velocity}
        rig = rig_of(BOUNDED, start=start, **law, **{'reference.type': 'hold'})
        rig.step(10)
        rig.sense = lambda state: [state.raw(q=state.q - [tau, 0.0])]
        rig.step(10)
        assert rig.supervisor.reason is Reason.WRAPPED
        rig.guard.starting.reset()
        rig.step(500)
        assert rig.supervisor.running, rig.supervisor.text
        assert rig.guard.controller.signals.q[0] == pytest.approx(3.0 - tau, abs=0.01)


def test_watchdog_sees_no_wrap_in_its_differenced_velocities():
    watchdog = TorqueWatchdog(build(ControllerConfig, ARM), 0.05)
    for k in range(200):  # at 1 rad/s past pi
        q = within_a_turn([3.1 + 1e-3 * k, 0.0])
        watchdog.take_state(
            1 + k * MILLISECOND, np.array([*q, nan, nan, 0, 0]), 1e-3 * k
        )
        if k:
            np.testing.assert_allclose(watchdog._safe.last.dq, [1.0, 0.0], atol=1e-9)


def test_bag_of_wrapping_positions_replays_and_its_reference_goes_with_them(tmp_path):
    """What was measured is recorded as it was."""
    config = build(ControllerConfig, ARM | SWING)
    plant = plant_of(build(PlantConfig, {**START, 'robot.urdf': ENDLESS}))
    with blf.ArmController(config, record=tmp_path / 'bag') as controller:
        for k in range(1000):
            q, dq, effort = plant.measure().reshape(3, -1)
            plant.step(controller.update(1e-3 * k, within_a_turn(q), dq, effort))
    result = blf.verify(tmp_path / 'bag')
    assert (result.difference, result.is_partial) == (None, False)
    run = blf.read_run(tmp_path / 'bag')
    assert np.abs(np.diff(run.position, axis=0)).max() > 6.0  # it has wrapped
    np.testing.assert_allclose(
        run.reference, run.position - run.error, rtol=0, atol=1e-15
    )


def test_identification_counts_turns_of_any_source():
    stamp = np.arange(2000) * MILLISECOND
    q = np.column_stack((1e-3 * np.arange(2000) * 8.0, np.sin(stamp * 1e-9)))
    torque = np.zeros_like(q)
    turning = np.ones(2, bool)
    plain, counted = (
        resampled(JOINTS, stamp, each, torque, 'a test', turning)
        for each in (q, within_a_turn(q))
    )
    np.testing.assert_allclose(counted.q[:], plain.q[:], atol=1e-12)


# Motions.

ANGLES = st.floats(-50.0, 50.0)


@given(
    positions=st.lists(st.tuples(ANGLES, ANGLES), min_size=1, max_size=6),
    start=st.tuples(ANGLES, ANGLES),
)
def test_each_angle_is_the_same_posture_and_nearest_to_the_one_before(positions, start):
    config = build(ControllerConfig, {**ARM, 'robot.urdf': HALF_ENDLESS})
    given = np.array(positions)
    shifted, told = short_way(given, np.array(start), config)
    np.testing.assert_array_equal(shifted[:, 1], given[:, 1])  # has a range
    turns = (shifted - given)[:, 0] / tau
    np.testing.assert_allclose(turns, np.rint(turns), atol=1e-9)
    steps = np.diff(shifted[:, 0], prepend=start[0])
    assert np.abs(steps).max() <= pi + 1e-9
    assert bool(told) == bool(np.rint(turns).any())
    kept = np.rint(turns) == 0.0
    np.testing.assert_array_equal(shifted[kept, 0], given[kept, 0])


HALF_ENDLESS = BOUNDED.replace('revolute', 'continuous', 1)


@pytest.mark.parametrize(
    ('limits', 'sent', 'followed'),
    [
        ((-20.0, 20.0), -2.9, tau - 2.9),  # the short way from 2.9
        ((-3.0, 3.0), -2.9, -2.9),  # which a cable forbids
        ((1.0, 5.0), -2.0, tau - 2.0),  # the only one
    ],
)
def test_limits_of_less_than_a_turn_leave_one_angle(limits, sent, followed):
    config = build(ControllerConfig, ARM)
    lower, upper = ((limit,) * 2 for limit in limits)
    within = replace(config.limits, position_lower=lower, position_upper=upper)
    config = replace(config, limits=within)
    (shifted,), _ = short_way(np.full((1, 2), sent), np.full(2, 2.9), config)
    np.testing.assert_allclose(shifted, followed, atol=1e-12)


def resting(q, urdf=ENDLESS, **law):
    """Return a rig whose arm holds q."""
    rig = rig_of(
        urdf, start={'initial.position': [*q]}, **{'reference.type': 'hold'}, **law
    )
    rig.step(100)
    return rig


def planned(start, end, wrap=within_a_turn):
    """Return a plan of a motion in eleven points within a second."""
    share = np.linspace(0.0, 1.0, 11)[1:, np.newaxis]
    points = wrap(start + share * (np.asarray(end) - start))
    return [
        TrajectoryPoint(0.1 * (1 + k), tuple(row))
        for k, row in enumerate(points.tolist())
    ]


@pytest.mark.parametrize('points', [slice(None), slice(-1, None)])
@pytest.mark.parametrize('start', [(3.3, -1.0), (3.1, -3.1), (-3.2, 3.2)])
def test_normalised_plan_is_followed_the_short_way(start, points):
    """Also where it passes pi: 0.1 rad became a turn of 6.18 rad at the speed limit."""
    rig = resting(start)
    end = np.add(start, [0.1, -0.1])
    sent, meant = (
        planned(np.array(start), end, wrap)[points]
        for wrap in (within_a_turn, np.asarray)
    )
    plan = rig.guard.motions.plan(Trajectory(JOINTS, tuple(sent)))
    rig.guard.motions.adopt(plan)
    is_other = any(
        np.abs(np.subtract(a.positions, b.positions)).max() > 1.0
        for a, b in zip(sent, meant, strict=True)
    )
    told = 'goes the short way, shifted by whole turns: joint1 by '
    assert (told in plan.motion.turned) == is_other
    times = np.linspace(rig.guard.reference.time, plan.motion.end, 500)
    q, dq = sampled(plan.motion.vector, times)[:, :2].transpose(1, 0, 2)
    np.testing.assert_allclose(q[-1], end, atol=1e-9)
    assert np.abs(q - start).max() < 0.11
    assert np.abs(dq).max() < 0.3  # 0.1 rad/s on average


def test_joints_with_a_range_go_where_they_are_sent():
    """An angle beyond the range stays an error."""
    rig = resting((3.3, -1.0), BOUNDED)
    points = tuple(planned(np.array([3.3, -1.0]), [3.4, -1.0])[-1:])
    late = points[0]._replace(time=30.0)
    plan = rig.guard.motions.plan(Trajectory(JOINTS, (late,)))
    assert plan.motion.turned == ''
    assert sampled(plan.motion.vector, [99.0])[0, 0, 0] == pytest.approx(3.4 - tau)
    beyond = TrajectoryPoint(5.0, (6.4, -1.0))
    with pytest.raises(TrajectoryError, match='position_upper'):
        rig.guard.motions.plan(Trajectory(JOINTS, (beyond,)))


class Kept:
    """A log that keeps what it is told."""

    def __init__(self):
        self.lines = []

    def info(self, message):
        self.lines.append(message)

    def warning(self, message, **_):
        self.lines.append(message)

    error = warning


def test_normalised_stream_goes_on_past_pi_and_this_is_said_once():
    pytest.importorskip('ruckig', reason='needs ruckig')
    rig = resting((3.0, -3.0))
    log = Kept()
    inputs = MotionInput(2, lambda: rig.guard, lambda _: False, log)
    encoder = Float64MultiArrayEncoder(2)
    true = np.array([3.0, -3.0])
    for _ in range(100):  # at 50 Hz, 0.3 rad/s
        true += [0.006, -0.006]
        inputs.take_positions(encoder.encode(within_a_turn(true)))
        rig.step(20)
        assert np.abs(rig.guard.controller.signals.dqr).max() < 0.5
    assert inputs.targets == 100
    rig.step(500)
    q, dq, _ = rig.guard.controller.reference_at(rig.guard.reference.time)
    np.testing.assert_allclose(q, true, atol=0.03)  # it coasts for 0.06 s, and brakes
    assert not dq.any()
    assert [line for line in log.lines if 'short way' in line] == log.lines[:1]


@pytest.mark.parametrize(
    'reference',
    [
        {
            'reference.type': 'waypoints',
            'reference.times': [0.0, 2.0],
            'reference.waypoints': [
                *within_a_turn([6.3, -3.2]),
                *within_a_turn([6.5, -3.4]),
            ],
        },
        {
            **SWING,
            'reference.offset': within_a_turn([6.3, -3.2]).tolist(),
            'reference.amplitude': [0.1, 0.1],
        },
    ],
    ids=['waypoints', 'sinusoids'],
)
def test_configured_reference_begins_where_the_arm_is(reference):
    limits = {'limits.position_lower': [-9.0] * 2, 'limits.position_upper': [9.0] * 2}
    rig = rig_of(start={'initial.position': [6.3, -3.2]}, **limits, **reference)
    moved = []
    for _ in range(60):
        rig.step(50)
        moved.append(rig.guard.controller.signals.qr - [6.3, -3.2])
    assert rig.supervisor.running, rig.supervisor.text
    assert np.abs(moved).max() < 0.21
    assert (
        'shifted by whole turns: joint1 by +1; joint2 by -1'
        in rig.guard.reference.turned
    )
