# SPDX-License-Identifier: Apache-2.0
"""Subscriptions whose messages are taken in batches, serialised.

An executor would run a callback for each message. Here the messages of all topics are taken from
the middleware's queues at the owner's pace, which costs a third less, and each carries the
middleware's metadata: when it was sent and received, and its sequence number, which reveals losses.
The subscriptions therefore belong to a separate node that no executor spins.
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

_BATCH = 1000  # messages taken from one topic before the next one's turn


class RawMessage(NamedTuple):
    """A serialised message with the middleware's metadata."""

    handle: int
    raw: bytes
    received: int  # ns, system time
    published: int  # ns, system time of the publisher
    sequence: int  # assigned by the publisher, 0 if unknown


class RawSubscriptions:
    """Subscriptions to any number of topics, each with a queue of `depth`.

    They belong to `node`, a hidden node separate from their owner.
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
        """Subscribe to a topic; its messages carry `handle`. Raises what `message_class` raises."""
        subscription = self.node.create_subscription(
            message_class(type_name),
            topic,
            lambda _: None,  # rclpy requires a callback; the messages are taken, not delivered
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
    """Return the strictest quality of service that is compatible with all publishers."""
    reliable = all(quality.reliability == 'reliable' for quality in offered)
    latched = all(quality.durability == 'transient_local' for quality in offered)
    reliability = 'reliable' if reliable else 'best_effort'
    durability = 'transient_local' if latched else 'volatile'
    return qos_profile(Quality(depth, reliability, durability))


def quality_of(profile: QoSProfile) -> Quality:
    """Return a publisher's quality of service; the ROS graph omits history and depth."""
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
