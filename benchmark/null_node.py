# SPDX-License-Identifier: Apache-2.0
"""The least a node can do: echo a torque immediately, or discard messages.

Usage: python null_node.py echo           echo, without decoding the messages
       python null_node.py listen         subscribe to states and telemetry in serialised form
       python null_node.py drop TOPICS    subscribe to this many topics in serialised form
"""

from __future__ import annotations

import sys
from typing import Any

import rclpy
from rclpy.experimental import EventsExecutor
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from blf_dsc_controller.configuration.nodes import RecorderConfig
from blf_dsc_controller.messages import topics
from blf_dsc_controller.nodes.controller_node import STREAMS
from blf_dsc_controller.nodes.endpoints import compatible_profile, qos_profile


def echo(node: Any) -> None:
    """Make a node respond to every joint state with the same torque."""
    publisher = node.create_publisher(
        Float64MultiArray, topics.COMMANDS.relative, qos_profile(topics.COMMANDS.offered)
    )
    torque = serialize_message(Float64MultiArray(data=[1.0, 2.0]))
    node.create_subscription(
        JointState,
        topics.JOINT_STATES.relative,
        lambda _: publisher.publish(torque),
        qos_profile(topics.JOINT_STATES.requested),
        raw=True,
    )


def listen(node: Any) -> None:
    """Make a node discard joint states and the controller's streams."""
    for topic in (topics.JOINT_STATES, *STREAMS):
        profile = compatible_profile([topic.offered], topic.offered.depth)
        node.create_subscription(JointState, topic.relative, lambda _: None, profile, raw=True)


def drop(node: Any, count: int) -> None:
    """Make a node discard the messages of `count` topics, with the recorder's QoS."""
    profile = compatible_profile([topics.STREAM], RecorderConfig().queue_depth)
    for i in range(count):
        node.create_subscription(JointState, f'topic{i}', lambda _: None, profile, raw=True)


def main() -> None:
    """Run until the process is interrupted."""
    rclpy.init(args=sys.argv)
    kind, *arguments = sys.argv[1:]
    node = rclpy.create_node('listener' if kind == 'listen' else topics.CONTROLLER)
    if kind == 'drop':
        drop(node, int(arguments[0]))
    elif kind == 'listen':
        listen(node)
    else:
        echo(node)
    executor = EventsExecutor()
    executor.add_node(node)
    while True:
        executor.spin_once(timeout_sec=0.1)


if __name__ == '__main__':
    main()
