# SPDX-License-Identifier: Apache-2.0
"""Message types, qualities of service, publishers, subscriptions and timers.

`RawSubscriptions` are for messages that are taken in batches, serialised. An executor
would run a callback for each message. Here the messages of all topics are taken from
the middleware's queues at the owner's pace, which costs a third less, and each carries
the middleware's metadata: when it was sent and received, and its sequence number, which
reveals losses. The subscriptions therefore belong to a separate node that no executor
spins.
"""

from __future__ import annotations

import importlib
import re
import sysconfig
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

from ament_index_python.packages import get_package_share_directory
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from rosbags.interfaces import Nodetype
from rosbags.typesys import get_types_from_msg
from std_srvs.srv import Trigger

from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.codecs import UnknownTypeError, typestore
from blf_dsc_controller.messages.topics import Quality, Topic

_MESSAGE = re.compile(r'([a-z][a-z0-9_]*)/msg/([A-Z][A-Za-z0-9]*)')


def message_class(type_name: str) -> Any:
    """Return the class of a message type such as `sensor_msgs/msg/JointState`.

    Only ROS packages are imported, since the name may come from a bag or any DDS
    participant.

    Raises ImportError if there is no such package, AttributeError if it has no such
    type.
    """
    match = _MESSAGE.fullmatch(type_name)
    if match is None or not (_share(match[1]) / 'package.xml').is_file():
        raise ImportError(f'{type_name} is not a message of an installed ROS package')
    return getattr(importlib.import_module(f'{match[1]}.msg'), match[2])


def _share(package: str) -> Path:
    """Return the folder of a package's data files, which need not exist."""
    try:
        return Path(get_package_share_directory(package))
    except (LookupError, OSError):  # a pip install sets no AMENT_PREFIX_PATH
        return Path(sysconfig.get_path('data'), 'share', package)


def register_definition(type_name: str) -> None:
    """Register a type and its nested types from their installed .msg files.

    Raises UnknownTypeError if there is no such file.
    """
    if type_name in typestore().fielddefs:
        return
    match = _MESSAGE.fullmatch(type_name)
    if match is None:
        raise UnknownTypeError(type_name)
    try:
        text = (_share(match[1]) / 'msg' / f'{match[2]}.msg').read_text(
            encoding='utf-8'
        )
    except OSError:
        raise UnknownTypeError(type_name) from None
    found = get_types_from_msg(text, type_name)
    for nested in _nested(found[type_name][1]):
        register_definition(nested)
    typestore().register(found)


def _nested(fields: Iterable[tuple[str, Any]]) -> Iterator[str]:
    for _, (node, content) in fields:
        if node is Nodetype.NAME:
            yield content
        elif node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            yield from _nested([('', content[0])])


def qos_profile(quality: Quality) -> QoSProfile:
    """Return a quality of service as an rclpy profile."""
    return QoSProfile(
        depth=quality.depth,
        reliability=ReliabilityPolicy[quality.reliability.upper()],
        durability=DurabilityPolicy[quality.durability.upper()],
        deadline=Duration(nanoseconds=quality.deadline),
        liveliness=LivelinessPolicy[quality.liveliness.upper()],
        liveliness_lease_duration=Duration(
            nanoseconds=quality.liveliness_lease_duration
        ),
    )


_RARE_PERIOD = 0.05  # s, of a node that has nothing to do
_IDLE_AFTER = 0.1  # s without work


# Declares `qos_overrides.TOPIC.publisher.depth`, and likewise for history and
# reliability.
_overridable = QoSOverridingOptions.with_default_policies


def create_publisher(node: Node, topic: Topic) -> Publisher:
    """Create a publisher of one of the node's own topics, for serialised messages."""
    return node.create_publisher(
        message_class(topic.type),
        topic.name,
        qos_profile(topic.offered),
        qos_overriding_options=_overridable(),
    )


def create_subscription(
    node: Node, topic: Topic, callback: Callable[[bytes], None]
) -> None:
    """Subscribe to a topic of another node; the callback gets raw messages."""
    node.create_subscription(
        message_class(topic.type),
        topic.relative,
        callback,
        qos_profile(topic.requested),
        qos_overriding_options=_overridable(),
        raw=True,
    )


def create_steady_timer(
    node: Node, period: float, callback: Callable[[], None]
) -> Timer:
    """Create a timer [s] on the steady clock, which no simulated time pauses."""
    return node.create_timer(
        period, callback, clock=Clock(clock_type=ClockType.STEADY_TIME)
    )


def create_trigger(node: Node, name: str, act: Callable[[], str]) -> None:
    """Offer a service that calls `act` and answers what it returns; BlfDscError: it has failed."""

    def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            response.message = act()
            response.success = True
        except BlfDscError as error:
            response.message = str(error)
        return response

    node.create_service(Trigger, name, answer)


class PollingTimer:
    """Calls `poll` periodically while it finds work, and rarely otherwise.

    An idle node would otherwise take several percent of a core. `poll` returns whether
    it found work. In between a second timer polls: it goes on for ever, since one that
    is reset by its own callback would multiply under load.
    """

    def __init__(self, node: Node, period: float, poll: Callable[[], bool]) -> None:
        self._poll = poll
        self._worked = time.monotonic()
        self._timer = create_steady_timer(node, period, self._poll_often)
        create_steady_timer(node, _RARE_PERIOD, self._poll_rarely)

    @property
    def period(self) -> float:
        """Period while there is work [s]."""
        return float(self._timer.timer_period_ns * 1e-9)

    @period.setter
    def period(self, value: float) -> None:
        self._timer.timer_period_ns = round(1e9 * value)

    def _poll_often(self) -> None:
        now = time.monotonic()
        if self._poll():
            self._worked = now
        elif now > self._worked + _IDLE_AFTER:
            self._timer.cancel()

    def _poll_rarely(self) -> None:
        if self._timer.is_canceled() and self._poll():
            self._worked = time.monotonic()
            self._timer.reset()


def is_listener(node_name: str) -> bool:
    """Whether a node that subscribes to torques applies none, by its name.

    Such are recorders, and what takes its messages by `RawSubscriptions`.
    """
    return 'record' in node_name or node_name.endswith(_SUBSCRIPTIONS)


def subscriptions_of(owner: str) -> str:
    """Return the name of the hidden node with the `RawSubscriptions` of a node of this name."""
    return f'_{owner}{_SUBSCRIPTIONS}'


_SUBSCRIPTIONS = '_subscriptions'
_BATCH = 1000  # messages taken from one topic before the next one's turn


class RawMessage(NamedTuple):
    """A serialised message with the middleware's metadata."""

    handle: Any  # of the subscription
    raw: bytes
    received: int  # ns, system time
    published: int  # ns, system time of the publisher
    sequence: int  # assigned by the publisher, 0 if unknown


class RawSubscriptions:
    """Subscriptions to any number of topics.

    They belong to `node`, a hidden node separate from their owner.
    """

    def __init__(self, owner: Node) -> None:
        self.node = Node(
            subscriptions_of(owner.get_name()),
            context=owner.context,
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
        )
        self._owner = owner
        self._subscriptions: list[tuple[Any, Subscription]] = []

    def follow(self, topic: Topic, quality: Quality) -> None:
        """Subscribe to a topic of the owner's namespace, the handle of its messages."""
        self.subscribe(
            self._owner.resolve_topic_name(topic.relative), topic.type, quality, topic
        )

    def subscribe(
        self, topic: str, type_name: str, quality: Quality, handle: Any
    ) -> None:
        """Subscribe to a topic with a handle. Raises what `message_class` raises."""
        subscription = self.node.create_subscription(
            message_class(type_name),
            topic,
            # rclpy requires a callback; the messages are taken, not delivered
            lambda _: None,
            qos_profile(quality),
            raw=True,
        )
        self._subscriptions.append((handle, subscription))

    def take(self) -> list[RawMessage]:
        """Take the waiting messages, in the order in which they were received."""
        messages: list[RawMessage] = []
        for handle, subscription in self._subscriptions:
            take = subscription.handle.take_message
            type_ = subscription.msg_type
            for _ in range(_BATCH):
                taken = take(type_, True)  # noqa: FBT003 - serialised; positional in rclpy
                if taken is None:
                    break
                # times and number are None if the middleware knows none
                raw, info = taken
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


def compatible(offered: Sequence[Quality], depth: int) -> Quality:
    """Return the strictest quality of service compatible with all publishers."""
    reliable = all(quality.reliability == 'reliable' for quality in offered)
    latched = all(quality.durability == 'transient_local' for quality in offered)
    reliability = 'reliable' if reliable else 'best_effort'
    durability = 'transient_local' if latched else 'volatile'
    return Quality(depth, reliability, durability)


def quality_of(profile: QoSProfile) -> Quality:
    """Return a publisher's quality of service, without history and depth."""
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
