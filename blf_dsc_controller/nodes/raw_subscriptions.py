# SPDX-License-Identifier: Apache-2.0
"""Subscriptions whose messages are fetched many at a time, undecoded.

An executor would call back once for each message. Here the messages of all topics are taken from
the middleware's queues at the owner's pace, which costs a third less, and each comes with what the
middleware knows of it: when it was sent, when it arrived, and its number, by which a loss shows.
The subscriptions therefore belong to a node of their own that no executor spins.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from blf_dsc_controller.messages.topics import Quality
from blf_dsc_controller.nodes.endpoints import message_class

_BATCH = 1000  # messages taken of one topic before the next has its turn


class Arrival(NamedTuple):
    """One message; the order of arrivals is that of `received`."""

    received: int  # ns, system time
    published: int  # ns, system time of the publisher
    sequence: int  # number given by the publisher, 0 if not known
    handle: int
    raw: bytes


@dataclass
class _Source:
    subscription: Any
    type: type
    handle: int


class Intake:
    """The messages of a growing set of topics.

    Args:
        context: of the node that records.
        name: of the hidden node that subscribes.
        depth: messages that may wait for each topic.

    Attributes:
        node: the hidden node.
    """

    def __init__(self, context: Context, name: str, depth: int) -> None:
        self.node = Node(
            name,
            context=context,
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
        )
        self._depth = depth
        self._sources: list[_Source] = []

    def subscribe(
        self, topic: str, type_name: str, offered: Sequence[Quality], handle: int
    ) -> None:
        """Subscribe to a topic, whose arrivals carry `handle` from then on.

        Raises:
            ImportError: the package of the type is not installed.
            AttributeError: the package has no such type.
        """
        class_ = message_class(type_name)
        profile = requested(offered, self._depth)
        subscription = self.node.create_subscription(class_, topic, _unused, profile, raw=True)
        self._sources.append(_Source(subscription, class_, handle))

    def take(self) -> list[Arrival]:
        """Fetch the messages that wait, in the order in which they were received."""
        arrivals: list[Arrival] = []
        for source in self._sources:
            take_one = source.subscription.handle.take_message
            for _ in range(_BATCH):
                taken = take_one(source.type, True)  # noqa: FBT003 - rclpy's, positional: raw
                if taken is None:
                    break
                arrivals.append(_arrival(source.handle, *taken))
        arrivals.sort(key=_by_time)
        return arrivals

    def close(self) -> None:
        """End all subscriptions."""
        self._sources.clear()
        self.node.destroy_node()


def requested(offered: Sequence[Quality], depth: int) -> QoSProfile:
    """Quality that every one of the publishers can serve, the strictest of these."""
    reliable = all(quality.reliability == 'reliable' for quality in offered)
    latched = all(quality.durability == 'transient_local' for quality in offered)
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def quality_of(profile: QoSProfile) -> Quality:
    """Quality of a publisher as plain data; the graph does not tell history and depth."""
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


def _arrival(handle: int, raw: bytes, told: dict[str, int | None]) -> Arrival:
    received = told['received_timestamp'] or time.time_ns()
    return Arrival(
        received,
        told['source_timestamp'] or received,
        told['publication_sequence_number'] or 0,
        handle,
        raw,
    )


def _by_time(arrival: Arrival) -> int:
    return arrival.received


def _unused(_: bytes) -> None:
    """Stand in for the callback that rclpy asks for: the messages are taken, not delivered."""
