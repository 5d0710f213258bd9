# SPDX-License-Identifier: Apache-2.0
"""Publishers and subscriptions of the package's topics, in serialised form."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from blf_dsc_controller.messages.topics import Quality, Topic


def message_class(type_name: str) -> Any:
    """Class of a message type such as `sensor_msgs/msg/JointState`.

    Raises:
        ImportError: its package is not installed.
        AttributeError: the package has no such type.
    """
    package, kind, name = type_name.split('/')
    return getattr(importlib.import_module(f'{package}.{kind}'), name)


def profile(quality: Quality) -> QoSProfile:
    """ROS's own form of a quality of service."""
    return QoSProfile(
        depth=quality.depth,
        reliability=ReliabilityPolicy[quality.reliability.upper()],
        durability=DurabilityPolicy[quality.durability.upper()],
    )


def publisher(node: Node, topic: Topic) -> Publisher:
    """Publisher of a topic that belongs to `node`; it takes serialised messages."""
    return node.create_publisher(
        message_class(topic.type),
        topic.name,
        profile(topic.offered),
        qos_overriding_options=_overridable(),
    )


def subscribe(node: Node, topic: Topic, callback: Callable[[bytes], None]) -> None:
    """Subscribe `node` to a topic of another node; the callback gets serialised messages."""
    node.create_subscription(
        message_class(topic.type),
        topic.relative,
        callback,
        profile(topic.requested),
        qos_overriding_options=_overridable(),
        raw=True,
    )


def are_observed(publishers: Mapping[Topic, Publisher], loop: Topic, observers: int) -> bool:
    """Whether each topic has its subscribers.

    Args:
        publishers: of the topics.
        loop: the one that the other side of the loop listens to as well.
        observers: subscribers that each must have beside it.
    """
    return all(
        publisher.get_subscription_count() >= observers + (topic is loop)
        for topic, publisher in publishers.items()
    )


def _overridable() -> QoSOverridingOptions:
    """Declare `qos_overrides.TOPIC.publisher.depth` and so on: history, depth, reliability."""
    return QoSOverridingOptions.with_default_policies()
