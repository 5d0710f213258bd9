# SPDX-License-Identifier: Apache-2.0
"""The least a node can do: answer every joint state at once, without decoding it."""

from __future__ import annotations

import rclpy
from rclpy.experimental import EventsExecutor
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from blf_dsc_controller.configuration.nodes import CONTROLLER
from blf_dsc_controller.messages.topics import COMMANDS, JOINT_STATES
from blf_dsc_controller.nodes.endpoints import qos_profile


def main() -> None:
    """Run until the process is interrupted."""
    rclpy.init()
    node = rclpy.create_node(CONTROLLER)
    offered = qos_profile(COMMANDS.offered)
    requested = qos_profile(JOINT_STATES.requested)
    commands = node.create_publisher(Float64MultiArray, COMMANDS.relative, offered)
    torque = serialize_message(Float64MultiArray(data=[1.0, 2.0]))
    node.create_subscription(
        JointState,
        JOINT_STATES.relative,
        lambda _: commands.publish(torque),
        requested,
        raw=True,
    )
    executor = EventsExecutor()
    executor.add_node(node)
    while True:
        executor.spin_once(timeout_sec=0.1)


if __name__ == '__main__':
    main()
