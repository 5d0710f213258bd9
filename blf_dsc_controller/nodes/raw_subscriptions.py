# SPDX-License-Identifier: Apache-2.0
"""Subscriptions whose messages are taken many at a time, serialised.

An executor would call back once for each message. Here the messages of all topics are taken from
the middleware's queues at the owner's pace, which costs a third less, and each comes with what the
middleware knows of it: when it was sent, when it arrived, and its number, which reveals losses.
The subscriptions therefore belong to a node of their own that no executor spins.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from operator import attrgetter
from typing import NamedTuple

from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

from blf_dsc_controller.messages.topics import Quality
from blf_dsc_controller.nodes.endpoints import message_class, qos_profile
from blf_dsc_controller.nodes.rclpy_internals import take_messages

_BATCH = 1000  # messages taken of one topic before the next has its turn


class RawMessage(NamedTuple):
    """A serialised message with what the middleware knows of it."""

    handle: int
    raw: bytes
    received: int  # ns, system time
    published: int  # ns, system time of the publisher
    sequence: int  # number given by the publisher, 0 if not known


class RawSubscriptions:
    """Subscriptions to any number of topics, each with a queue of `depth`.

    They are those of a hidden `node` beside their owner.
    """

    def __init__(self, owner: Node, depth: int) -> None:
        self.node = Node(
            f'_{owner.get_name()}_subscriptions',
            context=owner.context,
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
        )
        self._depth = depth
        self._subscriptions: list[tuple[int, Subscription]] = []

    def subscribe(
        self, topic: str, type_name: str, offered: Sequence[Quality], handle: int
    ) -> None:
        """Subscribe to a topic; its messages carry `handle`. Raises as `message_class`."""
        subscription = self.node.create_subscription(
            message_class(type_name),
            topic,
            lambda _: None,  # rclpy wants a callback; the messages are taken, not delivered
            compatible_profile(offered, self._depth),
            raw=True,
        )
        self._subscriptions.append((handle, subscription))

    def take(self) -> list[RawMessage]:
        """Take the waiting messages, in the order in which they were received."""
        messages: list[RawMessage] = []
        for handle, subscription in self._subscriptions:
            for raw, info in take_messages(subscription, _BATCH):
                received = info['received_timestamp'] or time.time_ns()
                published = info['source_timestamp'] or received
                sequence = info['publication_sequence_number'] or 0
                messages.append(RawMessage(handle, raw, received, published, sequence))
        messages.sort(key=attrgetter('received'))
        return messages

    def close(self) -> None:
        """End all subscriptions."""
        self._subscriptions.clear()
        self.node.destroy_node()


def compatible_profile(offered: Sequence[Quality], depth: int) -> QoSProfile:
    """Strictest quality of service that is compatible with every one of the publishers."""
    reliable = all(quality.reliability == 'reliable' for quality in offered)
    latched = all(quality.durability == 'transient_local' for quality in offered)
    reliability = 'reliable' if reliable else 'best_effort'
    durability = 'transient_local' if latched else 'volatile'
    return qos_profile(Quality(depth, reliability, durability))


def quality_of(profile: QoSProfile) -> Quality:
    """Quality of a publisher as plain data; the ROS graph leaves out history and depth."""
    return Quality(
        depth=profile.depth,
        reliability=profile.reliability.name.lower(),
        durability=profile.durability.name.lower(),
        history=profile.history.name.lower(),
        deadline=profile.deadline.nanoseconds,
        lifespan=profile.lifespan.nanoseconds,
        liveliness=profile.liveliness.name.lower(),
        liveliness_lease_duration=profile.liveliness_lease_duration.nanoseconds,
    )
