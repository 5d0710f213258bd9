# SPDX-License-Identifier: Apache-2.0
"""The loop over ROS with a plant that behaves like drivers of real arms."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from random_arm import random_urdf
from ros_rig import simulated_torques, torques

from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import Float64MultiArrayEncoder, JointStateDecoder
from blf_dsc_controller.nodes.plant_node import PlantNode

ARM = {
    'robot.urdf': random_urdf(3, seed=5)[0],
    'robot.tip': 'tip',
    'robot.drive_compensates': 'gravity',
}


def test_loop_with_such_a_driver_matches_the_offline_run_bit_for_bit(ros):
    """Compensated gravity, reordered names, repeated readings, an extra period of delay."""
    arm = ros.add(PlantNode, {'mode': 'lockstep', **ARM})
    joints = arm.config.joints
    ros.kill(arm)
    plant = ARM | {
        'duration': 2.0,
        'drive.mass_deviation': 0.2,
        'actuator.delay': 2,
        'sensor.repeat_every': 20,
        'sensor.published_joints': ['gripper', *reversed(joints)],
    }
    law = ARM | {'learning.window': 1.0, 'telemetry.enabled': False, 'wait_for_subscribers': 1}
    commands, diagnostics = ros.listen(topics.COMMANDS), ros.listen(topics.DIAGNOSTICS)
    node, controller = ros.loop(plant, law)
    ros.until(lambda: node.finished and len(commands) >= 2001)
    over_ros = torques(commands)
    np.testing.assert_array_equal(over_ros, simulated_torques(plant, law))
    assert controller.guard.supervisor.reason == 'none'
    parts = [part for array in diagnostics for part in array.status]
    (*_, load) = (part for part in parts if part.name.endswith('/load'))
    assert load.message.startswith('held: ')
    assert [pair.key for pair in load.values] == [*topics.LOAD]


def test_first_states_may_be_incomplete(ros):
    received = ros.listen(topics.JOINT_STATES, raw=True)
    node = ros.add(PlantNode, ARM | {'mode': 'lockstep', 'sensor.incomplete_states': 3})
    ros.publisher(topics.COMMANDS)
    ros.until(lambda: len(received) == 4)
    decoder = JointStateDecoder(node.config.joints, ('position',))
    stamps = []
    for raw in received:
        stamps.append(decoder.decode(raw))
        assert np.isfinite(decoder.position).all()
        assert np.isfinite(decoder.velocity).all() == (len(stamps) == 4)
    assert np.diff(stamps).tolist() == [1_000_000] * 3


def test_reflex_is_reported_and_lasts_until_a_reset(ros):
    node = ros.add(PlantNode, ARM | {'mode': 'lockstep', 'actuator.reflex_rate': 1000.0})
    commands = ros.publisher(topics.COMMANDS)
    received = ros.listen(topics.JOINT_STATES, raw=True)
    ros.until(lambda: len(received) == 1 and commands.get_subscription_count() > 0)
    for sample in (1, 2):
        commands.publish(Float64MultiArrayEncoder(3).encode([5.0, 0.0, 0.0]))
        ros.until(lambda sample=sample: node.plant.sample == sample)
    assert node.plant.is_stopped
    decoder = JointStateDecoder(node.config.joints)
    ros.until(lambda: len(received) == 3)
    decoder.decode(received[-1])
    assert not decoder.velocity.any()
    node.reset()
    assert not node.plant.is_stopped
