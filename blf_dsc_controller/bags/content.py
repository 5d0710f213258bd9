# SPDX-License-Identifier: Apache-2.0
"""The undecoded messages of a bag: one of our own, or any other that holds the same topics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from blf_dsc_controller.bags.errors import EmptyBagError, MissingTopicError
from blf_dsc_controller.bags.name_map import NO_NAMES, NameMap
from blf_dsc_controller.bags.sources import open_bag
from blf_dsc_controller.bags.topic_lookup import find
from blf_dsc_controller.messages.topics import (
    ACCEPTED_TRAJECTORY,
    BOUND,
    COMMANDS,
    JOINT_STATE,
    JOINT_STATES,
    LEARNING,
    MONITOR,
    PARAMETER_EVENTS,
    REFERENCE,
    STATE,
    TIMING,
    TRACKING_ERROR,
    TRUTH,
    Topic,
)

_OF_INTEREST = (
    JOINT_STATES,
    COMMANDS,
    REFERENCE,
    TRACKING_ERROR,
    LEARNING,
    BOUND,
    MONITOR,
    PARAMETER_EVENTS,
    STATE,
    ACCEPTED_TRAJECTORY,
    TRUTH,
    TIMING,
)


@dataclass
class Recorded:
    """All messages of one topic, undecoded."""

    name: str
    type: str = ''
    received: list[int] = field(default_factory=list)  # ns
    raw: list[bytes] = field(default_factory=list)

    def sort(self) -> None:
        """Put the messages into the order in which they were received."""
        times = np.array(self.received, dtype=np.int64)
        if (times[1:] < times[:-1]).any():
            order = np.argsort(times, kind='stable').tolist()
            self.received = [self.received[k] for k in order]
            self.raw = [self.raw[k] for k in order]


@dataclass(frozen=True)
class Content:
    """The topics of this package that a bag holds, and how many messages of every topic."""

    topics: Mapping[Topic, Recorded]
    message_counts: Mapping[str, int]


def read_content(path: Path, namespace: str = '', names: NameMap = NO_NAMES) -> Content:
    """Read the messages of every topic that this package knows.

    Args:
        path: folder of the bag, one of its storage files, or a ROS 1 `.bag`.
        namespace: of the robot to look at, if the bag holds several.
        names: of topics that are called otherwise in the bag.

    Raises:
        UnreadableBagError: there is no bag, or it is damaged.
        MissingTopicError: it holds no joint states, or not a topic of `names`.
        EmptyBagError: it holds no message of the joint states.
        AmbiguousTopicError: it holds the topics of several robots.
    """
    with open_bag(path) as bag:
        found = {topic: _find(topic, bag.held, namespace, names) for topic in _OF_INTEREST}
        states = found[JOINT_STATES]
        if not bag.held:
            raise EmptyBagError(path)
        if states is None:
            raise MissingTopicError(JOINT_STATES.name, JOINT_STATES.type, bag.held)
        topics = {topic: Recorded(name) for topic, name in found.items() if name is not None}
        types = dict(bag.held)
        for topic, recorded in topics.items():
            recorded.type = types[recorded.name] if topic is COMMANDS else topic.type
        by_name = {one.name: one for one in topics.values()}
        for name, received, raw in bag.messages(by_name):
            recorded = by_name[name]
            recorded.received.append(received)
            recorded.raw.append(raw)
        counts = bag.counts
    if not topics[JOINT_STATES].raw:
        raise EmptyBagError(path, states)
    for recorded in topics.values():
        recorded.sort()
    return Content({topic: one for topic, one in topics.items() if one.raw}, counts)


def _find(topic: Topic, held: list[tuple[str, str]], namespace: str, names: NameMap) -> str | None:
    name = names.topics.get(topic.leaf)
    if name is None:
        return find(topic, held, namespace)
    types = (topic.type, JOINT_STATE) if topic is COMMANDS else (topic.type,)
    if not any((name, type_) in held for type_ in types):
        raise MissingTopicError(name, ' or '.join(types), held)
    return name
