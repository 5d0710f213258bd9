# SPDX-License-Identifier: Apache-2.0
"""The node `rosbag2_player`: publishes a bag's messages without `ros2 bag play`."""

from __future__ import annotations

import time
from typing import Any

from rclpy.exceptions import NameValidationException
from rclpy.node import Node
from rclpy.publisher import Publisher

from blf_dsc_controller.bags.sources import OpenBag
from blf_dsc_controller.messages.topics import HISTORY, STREAM
from blf_dsc_controller.nodes.endpoints import message_class, qos_profile


class PlayerNode(Node):
    """Publishes an open bag while it is read, latched where it was."""

    def __init__(self, bag: OpenBag, **options: Any) -> None:
        super().__init__('rosbag2_player', start_parameter_services=False, **options)
        self._bag = bag
        self.outputs: dict[str, Publisher] = {}
        for name, type_ in bag.held.items():
            try:
                profile = qos_profile(HISTORY if name in bag.latched else STREAM)
                self.outputs[name] = self.create_publisher(
                    message_class(type_), name, profile
                )
            except (ImportError, AttributeError):
                self.get_logger().warning(
                    f'{name} is not played: {type_} is not installed here'
                )
            except NameValidationException:
                self.get_logger().warning(
                    f'{name} is not played: it is not the name of a topic'
                )

    def play(self) -> None:
        """Publish all messages, each at its time after the first."""
        begin = time.monotonic() - self._bag.times[0] * 1e-9
        for message in self._bag.messages({*self.outputs}):
            time.sleep(max(0.0, begin + message.received * 1e-9 - time.monotonic()))
            self.outputs[message.topic].publish(message.raw)
