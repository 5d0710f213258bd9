# SPDX-License-Identifier: Apache-2.0
"""Warnings of the controller node: rejected columns with their reason, gains that cannot work."""

from __future__ import annotations

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import Log
from rclpy.qos import DurabilityPolicy, QoSProfile
from ros_rig import JOINTS, START
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from blf_dsc_controller.messages.codecs import JointStateEncoder
from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.nodes.plant_node import PlantNode

COSINE = {'learning.frequencies': [1.0], 'learning.bias': False}


# Transient local, to get from /rosout what was logged before discovery. rcl keeps one publisher
# for each logger name, so the nodes of each test are in a namespace of their own.
LATCHED = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def listen(ros, kind, topic, qos=100):
    received = []
    ros.tester.create_subscription(kind, topic, received.append, qos)
    return received


def test_rejected_columns_are_logged_and_diagnosed_with_the_reason(ros):
    """On the paper's reference, cos t on both joints is indistinguishable from m2 l2^2."""
    log, diagnostics = (
        listen(ros, Log, '/rosout', LATCHED),
        listen(ros, DiagnosticArray, '/diagnostics'),
    )
    ros.add(ControllerNode, COSINE, namespace='rejected')
    arm = ros.add(PlantNode, {'mode': 'lockstep', 'duration': 7.0}, namespace='rejected')

    def rejected():
        return [
            (status.message, value)
            for array in diagnostics
            for status in array.status
            for value in status.values
            if value.key.startswith('rejected cos 1 rad/s')
        ]

    ros.until(lambda: arm.finished and rejected())
    message, value = rejected()[-1]
    assert message.startswith('not estimated: cos 1 rad/s')
    assert 'cannot distinguish it from m2*l2^2' in value.value
    warnings = [line.msg for line in log if 'is not estimated' in line.msg]
    assert len(warnings) == 1  # once, not in every sample
    assert 'cannot distinguish it from m2*l2^2' in warnings[0]


def test_configuration_warnings_are_logged_before_the_first_state(ros):
    log = listen(ros, Log, '/rosout', LATCHED)
    ros.add(ControllerNode, {'learning.window': 5.0}, namespace='warned')
    ros.until(lambda: any('learning.window: 5 s' in line.msg for line in log))


@pytest.mark.parametrize('simulated', [True, False])
def test_stamps_that_disable_the_watchdog_cause_one_warning_except_in_lockstep(ros, simulated):
    log = listen(ros, Log, '/rosout', LATCHED)
    space = f'unwatched_{simulated}'
    law = ros.add(ControllerNode, namespace=space)
    if simulated:
        ros.add(PlantNode, {'mode': 'lockstep'}, namespace=space)
    else:
        commands = f'/{space}/blf_dsc_controller/commands'
        ros.tester.create_subscription(Float64MultiArray, commands, lambda _: None, 1)
        states = ros.tester.create_publisher(JointState, f'/{space}/joint_states', 1)
        ros.until(states.get_subscription_count)
        states.publish(JointStateEncoder(JOINTS).encode(10**9, START, (0.0, 0.0), (0.0, 0.0)))

    ros.until(lambda: law.guard.start_stamp > 0 and law._warned_at == law.guard.start_stamp)
    ros.spin(0.3)
    warnings = [line.msg for line in log if 'a silence is not detected' in line.msg]
    assert len(warnings) == (not simulated)


@pytest.mark.parametrize('kind', [ControllerNode, PlantNode])
def test_second_publisher_on_the_same_topic_is_reported(ros, kind):
    space = f'others_{kind.__name__}'
    log = listen(ros, Log, '/rosout', LATCHED)
    diagnostics = listen(ros, DiagnosticArray, '/diagnostics')
    first = ros.add(kind, namespace=space)
    second = ros.add(kind, namespace=space)
    ros.until(lambda: first.others == second.others == 1)
    is_plant = kind is PlantNode
    name = 'joint_states' if is_plant else 'blf_dsc_controller/commands'
    does = 'publishes joint states' if is_plant else 'commands torques'
    ros.until(
        lambda: any(f'another node publishes on /{space}/{name}, too' in line.msg for line in log)
    )
    ros.until(
        lambda: any(
            status.message == f'another node {does}, too'
            for array in diagnostics
            for status in array.status
        )
    )
    ros.kill(second)
    ros.until(lambda: first.others == 0)


def test_joint_states_at_too_high_a_rate_are_reported(ros):
    log = listen(ros, Log, '/rosout', LATCHED)
    ros.add(ControllerNode, namespace='often')
    ros.add(PlantNode, mode='lockstep', sample_time=0.0005, namespace='often')
    ros.until(lambda: any('joint states come every 0.0005 s, but' in line.msg for line in log))
