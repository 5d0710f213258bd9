# SPDX-License-Identifier: Apache-2.0
"""Messages of a bag, with its topics and joints matched by name to those of the package."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from blf_dsc_controller.bags.packed_messages import PackedMessages
from blf_dsc_controller.bags.sources import BagError, open_bag
from blf_dsc_controller.bags.topic_messages import TopicMessages
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.topics import (
    CLOCK,
    COMMANDS,
    JOINT_STATE,
    JOINT_STATES,
    TOPICS,
    Topic,
)

_OF_INTEREST = tuple(one for one in TOPICS if one is not CLOCK)


@dataclass(frozen=True)
class NameMap:
    """Names that differ in a bag: topics by the last part of our name, joints by our name."""

    topics: Mapping[str, str] = field(default_factory=dict)
    joints: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def parse(cls, entries: Iterable[str]) -> NameMap:
        """Parse entries such as `commands=/arm/torque` and `joint1=shoulder`.

        Raises:
            BlfDscError: an entry lacks a side, or one side appears twice.
        """
        leaves = [topic.leaf for topic in TOPICS]
        topics: dict[str, str] = {}
        joints: dict[str, str] = {}
        for entry in entries:
            ours, _, theirs = (side.strip() for side in entry.partition('='))
            if not ours or not theirs:
                raise _bad_entry(entry, 'one side is missing')
            side = topics if ours in leaves else joints
            if ours in side or theirs in side.values():
                raise _bad_entry(entry, 'a name is given twice')
            side[ours] = theirs
        return cls({leaf: '/' + name.lstrip('/') for leaf, name in topics.items()}, joints)

    def joints_of(self, joints: Sequence[str]) -> tuple[str, ...]:
        """Return the names that these joints have in the bag.

        Raises:
            BlfDscError: a name is mapped that is neither a topic nor one of `joints`.
        """
        for joint, theirs in self.joints.items():
            if joint not in joints:
                reason = f'{joint} is neither a topic nor one of the joints {", ".join(joints)}'
                raise _bad_entry(f'{joint}={theirs}', reason)
        return tuple(self.joints.get(joint, joint) for joint in joints)


NO_NAMES = NameMap()


@dataclass(frozen=True)
class Content:
    """Messages of the package's topics in a bag, and the number of messages of every topic."""

    path: Path
    topics: Mapping[Topic, TopicMessages]
    message_counts: Mapping[str, int]

    def before(self, until: int) -> Content:
        """Return the content received before a time [ns], with the counts of the whole bag."""
        topics = {}
        for topic, one in self.topics.items():
            count = bisect_left(one.received, until)
            topics[topic] = replace(one, received=one.received[:count], raw=one.raw[:count])
        return replace(self, topics=topics)

    def of_joints(self, joints: Sequence[str]) -> Content:
        """Return the content without joint states that name only other joints, such as a gripper's.

        Raises:
            BagError: all joint states have the same stamp.
        """
        states = self.topics[JOINT_STATES].of_joints(joints)
        return replace(self, topics={**self.topics, JOINT_STATES: states})


def read_content(path: Path, namespace: str = '', names: NameMap = NO_NAMES) -> Content:
    """Read the messages of the package's topics from a folder, a storage file or a ROS 1 `.bag`.

    Raises:
        BagError: there is no bag, it is damaged, it lacks the joint states or a topic of `names`,
            or it holds the topics of several robots.
    """
    with open_bag(path) as bag:
        found = {topic: _find(topic, bag.held, namespace, names) for topic in _OF_INTEREST}
        if not bag.held:
            raise BagError(f'{path} is empty: it holds no message')
        if found[JOINT_STATES] is None:
            raise _missing_topic(JOINT_STATES.name, JOINT_STATES.type, bag.held)
        types = dict(bag.held)
        topics = {
            topic: TopicMessages(name, types[name] if topic is COMMANDS else topic.type)
            for topic, name in found.items()
            if name is not None
        }
        lists = {one.name: (one.received.append, one.raw.append) for one in topics.values()}
        for name, received, raw in bag.messages(lists):
            append_received, append_raw = lists[name]
            append_received(received)
            append_raw(raw)
        counts = bag.counts
    if not topics[JOINT_STATES].raw:
        raise BagError(f'{path} is empty: it holds no message of {found[JOINT_STATES]}')
    for messages in topics.values():
        times = np.array(messages.received, dtype=np.int64)
        if (times[1:] < times[:-1]).any():
            order = np.argsort(times, kind='stable').tolist()
            messages.received = [messages.received[k] for k in order]
            messages.raw = PackedMessages(messages.raw[k] for k in order)
    return Content(path, {topic: one for topic, one in topics.items() if one.raw}, counts)


def _find(topic: Topic, held: list[tuple[str, str]], namespace: str, names: NameMap) -> str | None:
    """Return the name of a topic in a bag, None if it is missing.

    Type and full name must match; unless the name is absolute, it may also follow any namespace,
    or match in its last part only.
    """
    name = names.topics.get(topic.leaf)
    if name is not None:
        types = (topic.type, JOINT_STATE) if topic is COMMANDS else (topic.type,)
        if not any((name, type_) in held for type_ in types):
            raise _missing_topic(name, ' or '.join(types), held)
        return name
    if topic.name.startswith('/'):
        return topic.name if (topic.name, topic.type) in held else None
    prefix = f'/{namespace.strip("/")}/' if namespace.strip('/') else '/'
    candidates = [name for name, type_ in held if type_ == topic.type and name.startswith(prefix)]
    for ending in (topic.resolved, f'/{topic.leaf}'):
        if prefix + ending[1:] in candidates:
            return prefix + ending[1:]
        fitting = sorted(name for name in candidates if name.endswith(ending))
        if len(fitting) > 1:
            raise BagError(
                f'the bag has {len(fitting)} topics that could be {topic.relative!r}: '
                f'{", ".join(fitting)}; select the robot by its namespace'
            )
        if fitting:
            return fitting[0]
    return None


def _missing_topic(wanted: str, type_name: str, held: Iterable[tuple[str, str]]) -> BagError:
    listing = ''.join(f'\n  {name} ({type_ or "of unknown type"})' for name, type_ in held)
    named = 'called' if wanted.startswith('/') else 'whose name ends in'
    return BagError(
        f'the bag has no topic {named} {wanted!r} of type {type_name}; it holds:{listing}'
    )


def _bad_entry(entry: str, reason: str) -> BlfDscError:
    return BlfDscError(
        f'--map {entry}: {reason}; expected OURS=THEIRS with a topic, as in '
        'joint_states=/arm/states, or a joint, as in joint1=shoulder'
    )
