# SPDX-License-Identifier: Apache-2.0
"""Messages of a bag, with its topics and joints matched by name to those of the package."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from blf_dsc_controller import __version__
from blf_dsc_controller.bags.sources import MESSAGES, VERSION, BagError, OpenBag, open_bag
from blf_dsc_controller.bags.topic_messages import TopicMessages
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import typestore
from blf_dsc_controller.messages.journal import Event, EventType, decode

_OF_INTEREST = (*(topic for topic in topics.TOPICS if topic is not topics.CLOCK), topics.CHANGES)
_KEPT = frozenset(topic.leaf for topic in topics.TOPICS if topic.offered.depth > 1)


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
        sides: tuple[dict[str, str], dict[str, str]] = {}, {}
        for entry in entries:
            ours, _, theirs = (side.strip() for side in entry.partition('='))
            side = sides[ours not in {topic.leaf for topic in topics.TOPICS}]
            if not ours or not theirs:
                raise _bad_entry(entry, 'one side is missing')
            if ours in side or theirs in side.values():
                raise _bad_entry(entry, 'a name is given twice')
            side[ours] = theirs
        by_leaf, joints = sides
        return cls({leaf: '/' + name.lstrip('/') for leaf, name in by_leaf.items()}, joints)

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
    """Messages of the package's topics in a bag, and the number of messages of every topic.

    `facts` are what a recorder of this package noted: its version, and losses by topic.
    """

    path: Path
    topics: Mapping[topics.Topic, TopicMessages]
    message_counts: Mapping[str, int]
    facts: Mapping[str, str]

    @property
    def version(self) -> str:
        """Version of this package that recorded the bag, empty for another recorder."""
        return self.facts.get(VERSION, '')

    @property
    def losses(self) -> dict[str, str]:
        """Recorder's notes on the messages it missed, by topic; not of latched single messages."""
        found = {
            name.removeprefix(MESSAGES): text.partition(', ')[2]
            for name, text in self.facts.items()
            if name.startswith(MESSAGES) and name.rsplit('/', 1)[-1] in _KEPT
        }
        return {topic: lost for topic, lost in found.items() if lost not in ('', '0 missed')}

    @cached_property
    def events(self) -> list[tuple[int, Event]]:
        """Events of the journal and when they were received [ns]; others' messages are skipped."""
        journal = self.topics.get(topics.JOURNAL)
        found = []
        for received, raw in zip(journal.received, journal.raw, strict=True) if journal else ():
            with suppress(BlfDscError):
                found.append((received, decode(raw)))
        return found

    @cached_property
    def changes(self) -> list[dict[str, Any]]:
        """What the plant said of its parameters: all of them first, then each change."""
        changes = self.topics.get(topics.CHANGES)
        found = []
        for raw in changes.raw if changes else ():
            with suppress(Exception):  # of another node
                message: Any = typestore().deserialize_cdr(raw, topics.CHANGES.type)
                found.append({'stamp': 0, 'parameters': {}, **json.loads(message.data)})
        return found

    @property
    def configurations(self) -> dict[str, dict[str, Any]]:
        """First recorded parameters of each node of the loop, by node."""
        found: dict[str, dict[str, Any]] = {}
        for _, event in self.events:
            if event.type is EventType.CONFIGURE:
                found.setdefault(topics.CONTROLLER, event.content['parameters'])
        for change in self.changes:
            if change.get('configured'):
                found[topics.PLANT] = change['parameters']
        return found

    def controller_config(self) -> ControllerConfig:
        """Return the configuration of the controller as first recorded.

        Raises:
            BagError: the bag holds none.
            ConfigurationError: this version of the package cannot run the configuration.
        """
        values = self.configurations.get(topics.CONTROLLER)
        if values is None:
            raise BagError(
                f'{self.path} does not hold the configuration of a controller: it was recorded by '
                'something else, or without the controller'
            )
        source = f'{self.path}, {topics.JOURNAL.resolved}'
        if self.version != __version__:
            source += f' by version {self.version or "unknown"}, not {__version__}'
        return build(ControllerConfig, values, source)


def read_content(path: Path, namespace: str = '', names: NameMap = NO_NAMES) -> Content:
    """Read the messages of the package's topics from a folder, a storage file or a ROS 1 `.bag`.

    Raises:
        BagError: there is no bag, it is damaged, it lacks the joint states or a topic of `names`,
            or it holds the topics of several robots.
    """
    with open_bag(path) as bag:
        if not bag.held or not any(bag.counts.values()):
            raise BagError(f'{path} is empty: it holds no message')
        names = _recorded_names(bag, namespace, names)
        found = {topic: _find(topic, bag.held, namespace, names) for topic in _OF_INTEREST}
        if found[topics.JOINT_STATES] is None:
            raise _missing_topic(topics.JOINT_STATES.name, topics.JOINT_STATES.type, bag.held)
        types = dict(bag.held)
        kept = {
            topic: TopicMessages(name, types[name] if topic is topics.COMMANDS else topic.type)
            for topic, name in found.items()
            if name is not None
        }
        adds = {messages.name: messages.add for messages in kept.values()}
        for message in bag.messages(adds):
            adds[message.topic](message)
    for messages in kept.values():
        messages.decode()
    if not kept[topics.JOINT_STATES].size:
        raise BagError(f'{path} is empty: it holds no message of {found[topics.JOINT_STATES]}')
    held = {topic: messages for topic, messages in kept.items() if messages.size}
    return Content(path, held, bag.counts, bag.facts)


def _recorded_names(bag: OpenBag, namespace: str, names: NameMap) -> NameMap:
    """Add the topics that the controller was connected to, where several have the same last part.

    So it is with a driver whose joint states also come at a lower rate, as those of an FR3 do.
    """
    journal = _find(topics.JOURNAL, bag.held, namespace, names)
    held = {name for name, _ in bag.held}
    if journal is None or sum(name.endswith(f'/{topics.JOINT_STATES.leaf}') for name in held) < 2:
        return names
    recorded: dict[str, str] = {}
    with suppress(BlfDscError, StopIteration):
        recorded = decode(next(bag.messages([journal])).raw).content.get('topics', {})
    own = {leaf: name for leaf, name in recorded.items() if name in held}
    return NameMap({**own, **names.topics}, names.joints)


def _find(
    topic: topics.Topic, held: list[tuple[str, str]], namespace: str, names: NameMap
) -> str | None:
    """Return the name of a topic in a bag, None if it is missing.

    Type and full name must match; unless the name is absolute, it may also follow any namespace,
    or match in its last part only.
    """
    name = names.topics.get(topic.leaf)
    if name is not None:
        types = (topic.type, topics.JOINT_STATE) if topic is topics.COMMANDS else (topic.type,)
        if not any((name, type_) in held for type_ in types):
            raise _missing_topic(name, ' or '.join(types), held)
        return name
    if topic.name.startswith('/'):
        return topic.name if (topic.name, topic.type) in held else None
    prefix = f'/{namespace.strip("/")}/' if namespace.strip('/') else '/'
    candidates = [name for name, type_ in held if type_ == topic.type and name.startswith(prefix)]
    for ending in (topic.resolved, f'/{topic.leaf}'):
        fitting = sorted(name for name in candidates if name.endswith(ending))
        exact = [name for name in fitting if name == prefix + ending[1:]]
        if len(fitting) > 1 and not exact:
            raise BagError(
                f'the bag has {len(fitting)} topics that could be {topic.relative!r}: '
                f'{", ".join(fitting)}; select the robot by its namespace'
            )
        if fitting:
            return (exact or fitting)[0]
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
