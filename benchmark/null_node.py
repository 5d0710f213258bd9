# SPDX-License-Identifier: Apache-2.0
"""The least a node can do: echo a torque at once. Typed as usual in rclpy, or serialised.

Usage: python null_node.py typed|raw [ROS arguments]
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

from blf_dsc_controller.messages import topics
from blf_dsc_controller.nodes.endpoints import qos_profile


def echo(node: Any, kind: str) -> None:
    """Let a node answer every joint state with the same torque, `typed` or `raw`."""
    publisher = node.create_publisher(
        Float64MultiArray, topics.COMMANDS.relative, qos_profile(topics.COMMANDS.offered)
    )
    answer = Float64MultiArray(data=[1.0, 2.0])
    serialised = serialize_message(answer)

    def typed(_state: JointState) -> None:
        answer.data = array('d', (1.0, 2.0))
        publisher.publish(answer)

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


def main() -> None:
    """Answer until the process is ended."""
    rclpy.init(args=sys.argv)
    node = rclpy.create_node(topics.CONTROLLER)
    echo(node, sys.argv[1])
    executor = EventsExecutor()
    executor.add_node(node)
    while True:
        executor.spin_once(timeout_sec=0.1)


if __name__ == '__main__':
    main()
