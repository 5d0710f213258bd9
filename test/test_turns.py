# SPDX-License-Identifier: Apache-2.0
"""Joints that turn without end: motions go the short way, and encoders may wrap."""

from __future__ import annotations

import re
from math import pi, tau
from unittest.mock import Mock

import numpy as np
import pytest
from fault_table import JOINTS, Rig

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
from blf_dsc_controller.messages.codecs import Float64MultiArrayEncoder
from blf_dsc_controller.reference.terms import sampled
from blf_dsc_controller.reference.trajectory import Trajectory
from blf_dsc_controller.supervision.supervisor import Reason
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
    rig.step(500)  # in which it wraps again
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


# Motions.


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


def test_short_way_that_the_limits_forbid_is_not_taken():
    """As of a cable: from 2.9 to -2.9 rad through zero, and not past 3 rad."""
    limits = {'limits.position_lower': [-3.0] * 2, 'limits.position_upper': [3.0] * 2}
    still = {'reference.offset': [0.0, 0.0], **limits}
    rig = resting((2.9, 0.0), **still)
    point = TrajectoryPoint(20.0, (-2.9, 0.0))
    plan = rig.guard.motions.plan(Trajectory(JOINTS, (point,)))
    assert plan.motion.turned == ''
    assert sampled(plan.motion.vector, [99.0])[0, 0, 0] == pytest.approx(-2.9)


def test_normalised_stream_goes_on_past_pi_and_this_is_said_once():
    pytest.importorskip('ruckig', reason='needs ruckig')
    rig = resting((3.0, -3.0))
    log = Mock()
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
    said = [call.args[0] for call in log.method_calls]
    assert [line for line in said if 'short way' in line] == said[:1]


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
