# SPDX-License-Identifier: Apache-2.0
"""The least a node can do: discard messages without decoding them, or answer at once.

Usage: python null_node.py NAME [TOPIC ...]

It subscribes to the topics; one with the controller's name answers every joint state with a torque.
"""

from __future__ import annotations

import sys

import rclpy
from rclpy.experimental import EventsExecutor
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from blf_dsc_controller.configuration.nodes import RecorderConfig
from blf_dsc_controller.messages.topics import COMMANDS, CONTROLLER, JOINT_STATES, STREAM
from blf_dsc_controller.nodes.endpoints import compatible_profile, qos_profile


def main() -> None:
    """Run until the process is interrupted."""
    rclpy.init(args=sys.argv)
    _, name, *discarded = sys.argv
    node = rclpy.create_node(name)
    profile = compatible_profile([STREAM], RecorderConfig().queue_depth)
    for topic in discarded:
        node.create_subscription(JointState, topic, lambda _: None, profile, raw=True)
    if name == CONTROLLER:
        commands = node.create_publisher(
            Float64MultiArray, COMMANDS.relative, qos_profile(COMMANDS.offered)
        )
        torque = serialize_message(Float64MultiArray(data=[1.0, 2.0]))
        node.create_subscription(
            JointState,
            JOINT_STATES.relative,
            lambda _: commands.publish(torque),
            qos_profile(JOINT_STATES.requested),
            raw=True,
        )
    executor = EventsExecutor()
    executor.add_node(node)
    while True:
        executor.spin_once(timeout_sec=0.1)


if __name__ == '__main__':
    main()
