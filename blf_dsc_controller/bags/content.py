# SPDX-License-Identifier: Apache-2.0
"""The undecoded messages of a bag: one of our own, or any other that holds the same topics."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

from rosbags.rosbag2 import Reader

from blf_dsc_controller.bags.errors import MissingTopicError, UnreadableBagError
from blf_dsc_controller.bags.lookup import find
from blf_dsc_controller.bags.topics import (
    BOUND,
    COMMANDS,
    JOINT_STATES,
    LEARNING,
    MONITOR,
    REFERENCE,
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
    TRUTH,
    TIMING,
    MONITOR,
)


@dataclass
class Recorded:
    """All messages of one topic, undecoded."""

    name: str
    received: list[int] = field(default_factory=list)  # ns
    raw: list[bytes] = field(default_factory=list)


@dataclass(frozen=True)
class Content:
    """The topics of this package that a bag holds, and how many messages of every topic."""

    topics: Mapping[Topic, Recorded]
    message_counts: Mapping[str, int]


def read_content(path: Path, namespace: str = '') -> Content:
    """Read the messages of every topic that this package knows.

    Args:
        path: folder of the bag, or one of its storage files.
        namespace: of the robot to look at, if the bag holds several.

    Raises:
        UnreadableBagError: there is no bag, or it is damaged.
        MissingTopicError: it holds no joint states.
        AmbiguousTopicError: it holds the topics of several robots.
    """
    try:
        reader = Reader(path)
        reader.open()
    except Exception as error:  # a damaged file makes the library raise nearly anything
        raise UnreadableBagError(path, _reason(path, error)) from error
    with closing(reader):
        held = [(one.topic, one.msgtype) for one in reader.connections]
        counts = {one.topic: one.msgcount for one in reader.connections}
        names = {topic: find(topic, held, namespace) for topic in _OF_INTEREST}
        if not counts.get(names[JOINT_STATES] or ''):
            raise MissingTopicError(JOINT_STATES.name, JOINT_STATES.type, held)
        topics = {topic: Recorded(name) for topic, name in names.items() if name is not None}
        by_name = {one.name: one for one in topics.values()}
        chosen = [one for one in reader.connections if one.topic in by_name]
        try:
            for connection, received, raw in reader.messages(chosen):
                recorded = by_name[connection.topic]
                recorded.received.append(received)
                recorded.raw.append(raw)
        except Exception as error:
            raise UnreadableBagError(path, _reason(path, error)) from error
    return Content({topic: one for topic, one in topics.items() if one.raw}, counts)


def _reason(path: Path, error: Exception) -> str:
    if not path.exists():
        return 'there is no such folder'
    if path.is_dir() and not (path / 'metadata.yaml').exists():
        return 'the folder has no metadata.yaml; was the recording ended before it was complete?'
    return f'{error or type(error).__name__}'
