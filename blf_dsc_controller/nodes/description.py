# SPDX-License-Identifier: Apache-2.0
"""The URDF from a latched topic, such as the one published by robot_state_publisher."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from rclpy.serialization import deserialize_message
from std_msgs.msg import String

from blf_dsc_controller.errors import ConfigurationError
from blf_dsc_controller.messages.topics import ROBOT_DESCRIPTION
from blf_dsc_controller.nodes import process
from blf_dsc_controller.nodes.raw_subscriptions import RawSubscriptions

if TYPE_CHECKING:
    from rclpy.node import Node

TIMEOUT = 60.0  # s
_POLL = 0.05  # s
_SILENCE = 5.0  # s between two log lines


def wait_for_description(node: Node, name: str) -> str:
    """Return the URDF from a topic, resolving its name for the node; a signal ends the process.

    Raises ConfigurationError if none is received within a minute.
    """
    topic = node.resolve_topic_name(name)
    hidden = RawSubscriptions(node, depth=1)
    hidden.subscribe(topic, ROBOT_DESCRIPTION.type, [ROBOT_DESCRIPTION.offered], 0)
    begin = time.monotonic()
    try:
        while not (messages := hidden.take()):
            if process.interrupted():
                raise SystemExit(0)
            if time.monotonic() > begin + TIMEOUT:
                raise ConfigurationError([_nothing(topic, hidden.node.count_publishers(topic))])
            node.get_logger().info(
                f'waiting for the URDF on {topic}', throttle_duration_sec=_SILENCE
            )
            time.sleep(_POLL)
    finally:
        hidden.close()
    text: str = deserialize_message(messages[-1].raw, String).data
    if not text.strip():
        raise ConfigurationError([f'robot.urdf: the URDF on {topic} is empty: did xacro fail?'])
    return text


def _nothing(topic: str, publishers: int) -> str:
    found = 'nobody publishes there'
    if publishers:
        found = f'its {publishers} publisher(s) may not be latched (transient local)'
    return (
        f'robot.urdf: no URDF was received on {topic} within {TIMEOUT:g} s, and {found}: start '
        'robot_state_publisher, correct the name, or give a file'
    )
