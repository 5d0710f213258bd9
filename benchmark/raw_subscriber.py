# SPDX-License-Identifier: Apache-2.0
"""Subscribe to some topics in serialised form and throw every message away.

Usage: python raw_subscriber.py NUMBER_OF_TOPICS
"""

from __future__ import annotations

import sys

import rclpy
from rclpy.experimental import EventsExecutor
from sensor_msgs.msg import JointState

from blf_dsc_controller.configuration.nodes import RecorderConfig
from blf_dsc_controller.messages.topics import STREAM
from blf_dsc_controller.nodes.raw_subscriptions import compatible_profile


def main() -> None:
    """Take messages, of the quality that the recorder asks for, until the process is ended."""
    rclpy.init()
    node = rclpy.create_node('raw_subscriber')
    profile = compatible_profile([STREAM], RecorderConfig().queue_depth)
    for i in range(int(sys.argv[1])):
        node.create_subscription(JointState, f'topic{i}', _drop, profile, raw=True)
    executor = EventsExecutor()
    executor.add_node(node)
    while True:
        executor.spin_once(timeout_sec=0.1)


def _drop(_message: bytes) -> None:
    pass


if __name__ == '__main__':
    main()
