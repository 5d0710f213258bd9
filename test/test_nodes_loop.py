# SPDX-License-Identifier: Apache-2.0
"""Plant and controller as nodes in one process: the closed loop, and whose clock counts."""

from __future__ import annotations

import json

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from random_arm import random_urdf
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter
from rclpy.time import Time
from ros_rig import FakeClock, simulated, states, torques
from test_plant_sampled import ALL_KINDS

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.messages import topics
from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.nodes.plant_node import LOCKSTEP_START, PlantNode
from blf_dsc_controller.reference import terms as reference
from blf_dsc_controller.reference.approach import reference_of
from blf_dsc_controller.supervision.checks import Reason

MILLISECOND = 1_000_000  # ns
PUSHED = {'load.payload': 0.2, 'load.torque': [0.4, -0.3], 'sensor.offset': [1e-5, 0.0]}
OBSERVED = {'wait_for_subscribers': 1}
ARM = {'robot.urdf': random_urdf(3, seed=5)[0], 'robot.tip': 'tip'}
HELD = ARM | {'robot.drive_compensates': 'gravity'}
JOINTS = build(PlantConfig, HELD).joints
NOISY = {'sensor.position_noise': 1e-5, 'sensor.velocity': 'differenced', 'actuator.delay': 1}
JITTER = {
    'duration': 2.5,
    'sensor.position_noise': 1e-6,
    'sensor.velocity': 'differenced',
    'seed': 3,
}
WEAK = {  # gravity alone takes 9.7 N m
    'torque.limit': [9.0, 3.2],
    'safety.torque': 'hold_gravity',
    'safety.stop_ramp': 0.05,
}


def run_lockstep(ros, plant, controller=None):
    """Run to the end; return the torques and the stamps of the states."""
    commands = ros.listen(topics.COMMANDS)
    joint_states = ros.listen(topics.JOINT_STATES, raw=True)
    arm = ros.add(PlantNode, {'mode': 'lockstep', **OBSERVED, **plant})
    ros.add(ControllerNode, {'telemetry.enabled': False, **OBSERVED, **(controller or {})})
    truth = ros.listen(topics.TRUTH)
    samples = round(plant['duration'] * 1000) + 1
    ros.until(lambda: arm.finished and len(commands) >= samples)
    ros.until(lambda: len(joint_states) >= samples)
    assert len(truth) == (samples - 1) // 10 + 1
    return torques(commands), states(joint_states, arm.config.joints)[0]


CASES = {
    'learning': ({'duration': 10.0}, {}),
    'noise, differenced velocity and delay': ({'duration': 2.0, 'seed': 5, **NOISY}, {}),
    'all kinds of events': ({'duration': 0.2, **ALL_KINDS}, {}),
    'three joints of a URDF with a truth of their own, and a payload': (
        ARM
        | {'duration': 3.0, 'truth.mass_deviation': 0.3, 'actuator.delay': 1}
        | {'events.begin': [2.0], 'events.payload': [0.3]},
        ARM | {'learning.window': 1.0},
    ),
    'a driver of a real arm': (
        HELD
        | {'duration': 2.0, 'drive.mass_deviation': 0.2, 'actuator.delay': 2}
        | {'sensor.repeat_every': 20, 'sensor.published_joints': ['gripper', *reversed(JOINTS)]},
        HELD | {'learning.window': 1.0},
    ),
    'approach': ({'duration': 4.0, 'initial.position': [0.9, 2.9]}, {}),  # over 1.4 and 1.2 rad
    'error past the bound': (JITTER, WEAK),
    'torque saturated': (
        JITTER,
        WEAK | {'safety.error_ratio': 0.0, 'safety.saturation_time': 0.01},
    ),
    'velocity not plausible': (JITTER, {'safety.velocity_limit': 0.25}),
    'saturated for some samples': (JITTER, {'torque.limit': [10.5, 20.0]}),
    'estimated velocity': (JITTER, {'safety.velocity': 'estimated'}),
}


@pytest.mark.parametrize('name', CASES)
def test_lockstep_torques_and_stops_match_the_offline_run_bit_for_bit(ros, name):
    plant, law = CASES[name]
    over_ros, stamps = run_lockstep(ros, plant, law)
    offline, supervisor = simulated(plant, law), ros.nodes[-1].guard.supervisor
    np.testing.assert_array_equal(over_ros, offline.torque)
    stops = [(stop.reason, stop.text) for stop in offline.stops]
    assert stops == [(supervisor.reason, supervisor.text)] * supervisor.stops
    assert [reason for reason, _ in stops] == [name] * (name in set(Reason))
    eventless = {name: value for name, value in plant.items() if not name.startswith('events.')}
    same = eventless == plant or (over_ros == simulated(eventless, law).torque).all()
    assert same == (eventless == plant)
    np.testing.assert_array_equal(stamps, LOCKSTEP_START + MILLISECOND * np.arange(len(stamps)))


def test_nodes_on_simulated_time_follow_the_clock_of_the_plant(ros):
    clock = ros.listen(topics.CLOCK)
    plant = {'duration': 0.5, 'publish_clock': True}
    over_ros, _ = run_lockstep(ros, plant, {'use_sim_time': True})
    ros.until(lambda: len(clock) == 501)
    now = Time(nanoseconds=LOCKSTEP_START + 500 * MILLISECOND)
    ros.until(lambda: ros.nodes[-1].get_clock().now().nanoseconds == now.nanoseconds)
    np.testing.assert_array_equal(over_ros, simulated({'duration': 0.5}).torque)


def test_plant_counts_real_time_in_whole_samples(ros):
    received = {
        topic: ros.listen(topic, raw=True)
        for topic in (topics.JOINT_STATES, topics.REFERENCE, topics.TIMING, topics.TRUTH)
    }
    clock = FakeClock()
    given = {'mode': 'realtime', 'duration': 0.3, **OBSERVED}
    plant = ros.add(PlantNode, given, clock=clock)
    controller = ros.add(ControllerNode, {'telemetry.decimation': 1}, clock=clock)
    ros.until(lambda: clock.advance(0.01) or received[topics.JOINT_STATES])
    ros.until(plant.input.torque.any)
    # In time, except for three steps that the plant has to take at once.
    for steps in [1] * 100 + [3] + [1] * 197:
        ros.until(lambda: plant._has_torque)
        goal = plant.plant.sample + steps
        clock.advance(1e-3 * steps)
        ros.until(lambda k=goal: plant.plant.sample == k)
    assert not plant.finished
    clock.advance(0.05)
    ros.until(lambda: plant.finished)
    ros.until(lambda: len(received[topics.REFERENCE]) == controller.guard.controller.samples)
    ros.until(lambda: len(received[topics.TIMING]) == 300)

    stamps, _ = states(received[topics.JOINT_STATES])
    np.testing.assert_array_equal(stamps, stamps[0] + MILLISECOND * np.arange(301))

    # However late the torque for a state was, the reference is that of the state's own time.
    reference_stamps, values = states(received[topics.REFERENCE])
    assert set(reference_stamps) <= set(stamps)
    vector = reference_of(ControllerConfig())
    qr, dqr, ddqr = np.zeros((3, 2))
    for stamp, value in zip(reference_stamps, values, strict=True):
        reference.evaluate(vector, (stamp - stamps[0]) * 1e-9, qr, dqr, ddqr)
        np.testing.assert_array_equal(value[0], qr)

    stamps_of_steps, timing = states(received[topics.TIMING], ('latency', 'lateness', 'late_steps'))
    np.testing.assert_array_equal(stamps_of_steps, stamps[1:])
    latency, lateness, late_steps = timing[:, 0].T
    assert not latency.any()  # the clock stands still while the plant waits for a torque
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
    ros.add(ControllerNode, OBSERVED | {'telemetry.enabled': False})
    ros.until(lambda: arm.plant.sample > 50)
    request = SetParametersAtomically.Request()
    request.parameters = [Parameter(k, value=v).to_parameter_msg() for k, v in PUSHED.items()]
    response = ros.call(SetParametersAtomically, '/sim_plant/set_parameters_atomically', request)
    assert response.result.successful, response.result.reason
    ros.until(lambda: arm.finished and len(commands) == 1001)

    configured, change = [json.loads(message.data) for message in changes]
    assert configured['configured']
    assert change['parameters'] == PUSHED
    at = (change['stamp'] - LOCKSTEP_START) * 1e-9
    assert 0.05 < at < 1.0
    load = {f'events.{name.partition(".")[2]}': np.ravel(v).tolist() for name, v in PUSHED.items()}
    expected = simulated({'duration': 1.0, 'events.begin': [at], **load}).torque
    np.testing.assert_array_equal(torques(commands), expected)
