# SPDX-License-Identifier: Apache-2.0
"""The least a node can do: echo a torque immediately, or discard messages.

Usage: python null_node.py typed|raw      echo, typed as usual in rclpy, or serialised
       python null_node.py listen         subscribe to states and telemetry in serialised form
       python null_node.py drop TOPICS    subscribe to this many topics in serialised form
"""

from __future__ import annotations

import sys
from array import array
from typing import Any

import rclpy
from rclpy.experimental import EventsExecutor
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from blf_dsc_controller.configuration.nodes import RecorderConfig
from blf_dsc_controller.messages import topics
from blf_dsc_controller.nodes.controller_node import STREAMS
from blf_dsc_controller.nodes.endpoints import qos_profile
from blf_dsc_controller.nodes.raw_subscriptions import compatible_profile


def echo(node: Any, kind: str) -> None:
    """Make a node respond to every joint state with the same torque, `typed` or `raw`."""
    publisher = node.create_publisher(
        Float64MultiArray, topics.COMMANDS.relative, qos_profile(topics.COMMANDS.offered)
    )
    torque = Float64MultiArray(data=[1.0, 2.0])
    serialised = serialize_message(torque)

    def typed(_state: JointState) -> None:
        torque.data = array('d', (1.0, 2.0))
        publisher.publish(torque)

    def raw(_state: bytes) -> None:
        publisher.publish(serialised)

    callbacks: dict[str, Any] = {'typed': typed, 'raw': raw}
    node.create_subscription(
        JointState,
        topics.JOINT_STATES.relative,
        callbacks[kind],
        qos_profile(topics.JOINT_STATES.requested),
        raw=kind == 'raw',
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
        echo(node, kind)
    executor = EventsExecutor()
    executor.add_node(node)
    while True:
        executor.spin_once(timeout_sec=0.1)


if __name__ == '__main__':
    main()
