# SPDX-License-Identifier: Apache-2.0
"""Plant and controller as nodes in one process: the closed loop, its clocks, its lifecycle."""

from __future__ import annotations

import json
from functools import partial

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from random_arm import random_urdf
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter
from ros_rig import (
    LIMIT,
    FakeClock,
    activate,
    cleanup,
    configure,
    deactivate,
    simulated,
    states,
    torques,
    values,
)
from std_srvs.srv import Trigger

import blf_dsc_controller as blf
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import JointStateDecoder
from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.nodes.endpoints import message_class
from blf_dsc_controller.nodes.plant_node import PlantNode
from blf_dsc_controller.run import FIRST_STAMP
from blf_dsc_controller.supervision.supervisor import Reason

MILLISECOND = 1_000_000  # ns
PUSHED = {'load.payload': 0.2, 'load.torque': [0.4, -0.3], 'sensor.offset': [1e-5, 0.0]}
OBSERVED = {'wait_for_subscribers': 1}
ARM = {'robot.urdf': random_urdf(3, seed=5)[0], 'robot.tip': 'tip'}
HELD = ARM | {'robot.drive_compensates': 'gravity'}
JOINTS = build(blf.PlantConfig, HELD).joints
NOISY = {
    'sensor.position_noise': 1e-5,
    'sensor.velocity': 'differenced',
    'actuator.delay': 1,
}
JITTER = {
    'duration': 2.5,
    'sensor.position_noise': 1e-6,
    'sensor.velocity': 'differenced',
    'seed': 3,
}
WEAK = {  # gravity alone takes 9.7 N m
    'torque.limit': [9.0, 3.2],
    'safety.torque': 'hold_gravity',
}


def run_lockstep(ros, plant, controller=None):
    """Run to the end; return the torques and the stamps of the states."""
    commands = ros.listen(topics.COMMANDS)
    joint_states = ros.listen(topics.JOINT_STATES, raw=True)
    arm = ros.add(PlantNode, {'mode': 'lockstep', **OBSERVED, **plant})
    ros.observe(ros.add(ControllerNode, {**OBSERVED, **(controller or {})}))
    truth = ros.listen(topics.TRUTH)
    samples = round(plant['duration'] * 1000) + 1
    limit = LIMIT + 0.01 * samples
    ros.until(lambda: arm.finished and len(commands) >= samples, limit)
    ros.until(lambda: len(joint_states) >= samples)
    ros.until(lambda: len(truth) == (samples - 1) // 10 + 1)
    return torques(commands), states(joint_states, arm.config.joints)[0]


CASES = {
    'learning': ({'duration': 2.0}, {'learning.window': 1.0}),
    'noise, differenced velocity and delay': (
        {'duration': 2.0, 'seed': 5, **NOISY},
        {},
    ),
    'a push against which it holds': (
        {
            'duration': 3.0,
            'events.begin': [2.5],
            'events.duration': [0.2],
            'events.torque': [2.0, 0.0],
        },
        {'contact.enabled': True, 'contact.reaction': 'hold', 'learning.window': 1.0},
    ),
    'three joints of a URDF with a truth of their own, and a payload': (
        ARM
        | {'duration': 3.0, 'truth.mass_deviation': 0.3, 'actuator.delay': 1}
        | {'events.begin': [2.0], 'events.payload': [0.3]},
        ARM | {'learning.window': 1.0},
    ),
    'a driver of a real arm': (
        HELD
        | {'duration': 2.0, 'drive.mass_deviation': 0.2, 'actuator.delay': 2}
        | {
            'sensor.repeat_every': 20,
            'sensor.published_joints': ['gripper', *reversed(JOINTS)],
        },
        HELD | {'learning.window': 1.0},
    ),
    'springs, a torque loop and a base that gives way': (
        ARM
        | {
            'duration': 0.5,
            'truth.rotor_inertia': [0.2, 0.2, 0.2],
            'joint.stiffness': [1e5, 1e5, 1e5],
            'actuator.loop_gain': 4.0,
            'actuator.loop_damping': 0.008,
            'base.mass': 200.0,
        },
        ARM | {'learning.window': 0.2},
    ),
    # over 1.4 and 1.2 rad
    'approach': ({'duration': 2.0, 'initial.position': [0.9, 2.9]}, {}),
    'error past the bound': (JITTER, WEAK),
}


@pytest.mark.parametrize('name', CASES)
def test_lockstep_torques_and_stops_match_the_offline_run_bit_for_bit(ros, name):
    plant, law = CASES[name]
    over_ros, stamps = run_lockstep(ros, plant, law)
    offline = simulated(plant, law)
    supervisor = ros.nodes[-1].guard.supervisor
    np.testing.assert_array_equal(over_ros, offline.torque)
    reasons = [stop.reason for stop in offline.stops]
    assert reasons == [supervisor.reason] * supervisor.stops
    assert reasons == [name] * (name in set(Reason))
    for stop in offline.stops:  # what the arm does later is added to the text
        assert supervisor.text.startswith(stop.text)
    eventless = {
        name: value for name, value in plant.items() if not name.startswith('events.')
    }
    same = eventless == plant or (over_ros == simulated(eventless, law).torque).all()
    assert same == (eventless == plant)
    np.testing.assert_array_equal(
        stamps, FIRST_STAMP + MILLISECOND * np.arange(len(stamps))
    )


@pytest.mark.parametrize(
    ('kind', 'success', 'message'),
    [
        ('hold', True, 'the external torque is zero here'),
        ('sinusoids', False, 'tare: the arm moves, or has just come to rest'),
    ],
)
def test_external_torque_and_its_interval_are_published_and_tared_at_rest(
    ros, kind, success, message
):
    """Once the arm has been held for half a second, and not in motion."""
    received = ros.listen(topics.EXTERNAL_TORQUE, raw=True)
    ros.add(PlantNode, {'mode': 'lockstep'})
    given = {
        'contact.enabled': True,
        'reference.type': kind,
        'telemetry.decimation': 1,
    }
    node = ros.add(ControllerNode, given)
    ros.until(lambda: len(received) > 500)
    joints = node.config.joints
    names = (*joints, *(joint + topics.INTERVAL for joint in joints))
    decoder = JointStateDecoder(names, required=('effort',))
    decoder.decode(received[-1])
    assert (decoder.effort[2:] > np.abs(decoder.effort[:2])).all()
    response = ros.call(Trigger, f'{node.get_name()}/tare', Trigger.Request())
    assert response.success is success
    assert response.message.startswith(message)
    ros.until(lambda: len(received) > 520)
    assert node.guard.controller.is_tared is success


def test_plant_counts_real_time_in_whole_samples(ros):
    received = {
        topic: ros.listen(topic, raw=True)
        for topic in (topics.JOINT_STATES, topics.TIMING, topics.TRUTH)
    }
    clock = FakeClock()
    given = {'mode': 'realtime', 'duration': 0.3, **OBSERVED}
    plant = ros.add(PlantNode, given, clock=clock)
    ros.add(ControllerNode, clock=clock)
    ros.until(lambda: clock.advance(0.01) or received[topics.JOINT_STATES])
    ros.until(plant.input.torque.any)
    # In time, except for three steps that the plant has to take at once.
    for steps in [1] * 100 + [3] + [1] * 197:
        ros.until(lambda: plant.has_torque)
        goal = plant.plant.sample + steps
        clock.advance(1e-3 * steps)
        ros.until(lambda k=goal: plant.plant.sample == k)
    assert not plant.finished
    clock.advance(0.05)
    ros.until(lambda: plant.finished)
    ros.until(lambda: len(received[topics.TIMING]) == 300)

    stamps, _ = states(received[topics.JOINT_STATES])
    np.testing.assert_array_equal(stamps, stamps[0] + MILLISECOND * np.arange(301))

    stamps_of_steps, timing = states(
        received[topics.TIMING], ('latency', 'lateness', 'late_steps')
    )
    np.testing.assert_array_equal(stamps_of_steps, stamps[1:])
    latency, lateness, late_steps = timing[:, 0].T
    # the clock stands still while the plant waits for a torque
    assert not latency.any()
    expected = np.zeros(300)
    expected[100:102] = 0.002, 0.001
    np.testing.assert_allclose(lateness, expected, atol=1e-9)
    # Two of the three steps had no torque yet; nothing counts after the last step.
    np.testing.assert_array_equal(late_steps, np.clip(np.arange(300) - 100, 0, 2))
    assert late_steps[-1] == plant.latency.late_steps


def test_parameter_change_takes_effect_at_the_published_sample(ros):
    changes = ros.listen(topics.CHANGES)
    commands = ros.listen(topics.COMMANDS)
    ros.listen(topics.JOINT_STATES)
    ros.listen(topics.TRUTH)
    arm = ros.add(PlantNode, {'mode': 'lockstep', 'duration': 1.0, **OBSERVED})
    ros.observe(ros.add(ControllerNode, OBSERVED))
    ros.until(lambda: arm.plant.sample > 50)
    request = SetParametersAtomically.Request()
    request.parameters = [
        Parameter(k, value=v).to_parameter_msg() for k, v in PUSHED.items()
    ]
    response = ros.call(
        SetParametersAtomically, '/sim_plant/set_parameters_atomically', request
    )
    assert response.result.successful, response.result.reason
    ros.until(lambda: arm.finished and len(commands) == 1001)
    ros.until(lambda: len(changes) == 2)

    configured, change = [json.loads(message.data) for message in changes]
    assert configured['configured']
    assert change['parameters'] == PUSHED
    at = (change['stamp'] - FIRST_STAMP) * 1e-9
    assert 0.05 < at < 1.0
    load = {
        f'events.{name.partition(".")[2]}': np.ravel(v).tolist()
        for name, v in PUSHED.items()
    }
    expected = simulated({'duration': 1.0, 'events.begin': [at], **load}).torque
    np.testing.assert_array_equal(torques(commands), expected)


# Under a lifecycle manager: transitions, resets in any order, one node killed.

SECOND = 1_000_000_000  # ns


def is_running(node):
    return node.guard is not None and node.guard.supervisor.running


def assert_runs(ros, arm, law, samples=60):
    """Run the loop on, and check that the law is running and the error within its bound."""
    ros.run(arm, samples)
    assert is_running(law), law.guard.supervisor.text
    assert law.guard.samples.ratio.max() < 1.0


def test_loop_waits_for_a_recorder_and_not_for_any_listener(ros):
    waiting = {'wait_for_subscribers': 1}
    arm, law = ros.loop(waiting, waiting)
    outputs = topics.JOINT_STATES, topics.TRUTH, topics.COMMANDS
    listener = ros.add(partial(Node, 'listener'))
    for topic in outputs:
        type_ = message_class(topic.type)
        listener.create_subscription(type_, topic.resolved, lambda _: None, 10)
    ros.spin(0.5)
    assert arm.plant.sample == 0
    for topic in outputs:
        ros.listen(topic)
    ros.observe(law)
    ros.until(lambda: arm.plant.sample > 0)


def test_transitions_pause_and_restart_the_loop_and_impossible_ones_are_rejected(ros):
    arm, law = ros.loop()
    assert not activate(ros, law)
    assert not configure(ros, arm)
    assert not cleanup(ros, law)
    ros.run(arm, 50)
    assert deactivate(ros, arm)
    sample = arm.plant.sample
    ros.spin(0.3)
    assert arm.plant.sample == sample
    assert activate(ros, arm)
    assert_runs(ros, arm, law)
    for node in (law, arm):
        assert deactivate(ros, node)
        assert cleanup(ros, node)
        assert node.state_label == 'unconfigured'
    for node in (arm, law):
        assert configure(ros, node)
        assert activate(ros, node)
    assert_runs(ros, arm, law)


@pytest.mark.parametrize('order', ['c', 'pc', 'ccp'])
def test_loop_runs_after_resets_in_any_order(ros, order):
    arm, law = ros.loop()
    ros.run(arm, 300)
    for letter in order:
        assert ros.reset(arm if letter == 'p' else law).success
        ros.spin(0.02)
    if 'p' in order:
        ros.until(lambda: arm.plant.sample > 30)
    assert_runs(ros, arm, law)


def test_reset_of_both_nodes_repeats_the_run(ros):
    commands = ros.listen(topics.COMMANDS)
    clock = FakeClock()
    arm, law = ros.loop({'sensor__position_noise': 1e-5, 'seed': 3}, clock=clock)
    ros.spin(0.3)
    assert not arm.is_offered  # peers need time to settle
    ros.until(lambda: clock.advance(0.01) or arm.is_offered)
    ros.run(arm, 100)
    begin = arm.stamp - arm.plant.elapsed_ns
    ros.reset(arm)
    # Clock and plant stand still until all torques of the first run have arrived.
    samples = (arm.stamp - SECOND - begin) // (SECOND // 1000) + 1
    ros.until(lambda: len(commands) == samples)
    assert arm.plant.sample == 0
    first = torques(commands)[:100]
    commands.clear()
    ros.until(lambda: clock.advance(0.01) or arm.is_offered)
    assert law.guard.controller.samples < 50  # it has been reset before
    ros.until(lambda: len(commands) >= 100)
    np.testing.assert_array_equal(torques(commands)[:100], first)


def test_restarted_controller_continues_from_where_the_arm_is(ros, monkeypatch):
    monkeypatch.setattr('blf_dsc_controller.nodes.plant_node._REPEAT_PERIOD', 0.1)
    arm, law = ros.loop()
    ros.run(arm, 50)
    ros.kill(law)
    ros.until(lambda: arm.stamp == law.guard.journal.stamp + SECOND // 1000)
    sample = arm.plant.sample
    ros.spin(0.3)
    assert arm.plant.sample == sample  # without torques, time stands still
    restarted = ros.add(ControllerNode)
    assert_runs(ros, arm, restarted)


def test_stale_torque_is_not_applied_in_real_time(ros):
    diagnostics = ros.listen(topics.DIAGNOSTICS)
    states = ros.listen(topics.JOINT_STATES)
    clock = FakeClock()
    arm = ros.add(PlantNode, clock=clock)
    law = ros.add(ControllerNode, clock=clock)
    ros.until(lambda: clock.advance(0.01) or states)
    ros.until(arm.input.torque.any)
    for sample in range(1, 21):
        clock.advance(0.001)
        ros.until(lambda k=sample: arm.plant.sample == k and arm.has_torque)
    assert arm.plant.measure()[4:].any()
    ros.kill(law)
    ros.until(lambda: clock.advance(0.001) or arm.input.stale_steps > 5)
    assert not arm.plant.measure()[4:].any()
    ros.until(
        lambda: any(
            (status.name, status.level) == ('sim_plant/torque', b'\2')
            and 'too old' in status.message
            and 'none is applied until another comes' in status.message
            for array in diagnostics
            for status in array.status
        )
    )


def test_state_is_latched_and_gives_the_reason(ros):
    arm, _ = ros.loop()
    ros.run(arm, 20)
    msgs = ros.listen(topics.STATE)
    ros.until(lambda: msgs)
    assert msgs[-1].message == 'tracking'
    assert values(msgs[-1])['phase'] == 'tracking'
    arm.start_stamp -= 10**9
    ros.until(lambda: len(msgs) > 1)
    assert msgs[-1].level == b'\2'
    assert msgs[-1].message.startswith(
        'stopped: the stamp of a joint state is 0.999 s before'
    )
    assert values(msgs[-1])['phase'] == 'safe stop'
    assert values(msgs[-1])['reason'] == 'stamp backward'
