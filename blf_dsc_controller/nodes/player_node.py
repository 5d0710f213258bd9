# SPDX-License-Identifier: Apache-2.0
"""The node `rosbag2_player`: publishes a bag's messages where no `ros2 bag play` is at hand."""

from __future__ import annotations

import time
from collections.abc import Collection
from typing import Any

from rclpy.exceptions import NameValidationException
from rclpy.node import Node
from rclpy.publisher import Publisher

from blf_dsc_controller.bags.sources import BagError, OpenBag
from blf_dsc_controller.messages.topics import HISTORY, STREAM
from blf_dsc_controller.nodes.endpoints import message_class, qos_profile


class PlayerNode(Node):
    """Publishes the topics of an open bag, latched where they were.

    Empty `topics` selects all. Messages are read as they are played: a bag may exceed the memory.

    Raises:
        BagError: the bag is empty, or has no such topic.
    """

    def __init__(self, bag: OpenBag, topics: Collection[str] = (), **options: Any) -> None:
        super().__init__('rosbag2_player', start_parameter_services=False, **options)
        if not any(bag.counts.values()):
            raise BagError('the bag is empty: it holds no message')
        wanted = {'/' + name.lstrip('/') for name in topics} or {*bag.counts}
        if missing := sorted(wanted - {*bag.counts}):
            listing = ', '.join(bag.counts)
            raise BagError(f'the bag has no topic {", ".join(missing)}; it holds {listing}')
        self._bag = bag
        self.outputs: dict[str, Publisher] = {}
        for name, type_ in bag.held.items():
            if name in wanted:
                self._add(name, type_)

    def play(self, rate: float) -> None:
        """Publish all messages at `rate` seconds of the bag a second; 0: as fast as possible."""
        first, begin = self._bag.times[0], time.monotonic()
        for message in self._bag.messages({*self.outputs}):
            due = begin + (message.received - first) * 1e-9 / rate if rate else 0.0
            time.sleep(max(0.0, due - time.monotonic()))
            self.outputs[message.topic].publish(message.raw)

    def _add(self, name: str, type_: str) -> None:
        try:
            profile = qos_profile(HISTORY if name in self._bag.latched else STREAM)
            self.outputs[name] = self.create_publisher(message_class(type_), name, profile)
        except (ImportError, AttributeError):
            self.get_logger().warning(f'{name} is not played: {type_} is not installed here')
        except NameValidationException:
            self.get_logger().warning(f'{name} is not played: it is not the name of a topic')
