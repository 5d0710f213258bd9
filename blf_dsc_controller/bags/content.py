# SPDX-License-Identifier: Apache-2.0
"""Messages of a bag, with topics and joints matched by name to the package's."""

from __future__ import annotations

import heapq
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from blf_dsc_controller import __version__
from blf_dsc_controller.bags.sources import BagError, OpenBag, open_bag
from blf_dsc_controller.bags.topic_messages import TopicMessages
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import CONTROLLER, PLANT
from blf_dsc_controller.configuration.received import (
    with_law,
    without_files,
    without_law,
)
from blf_dsc_controller.configuration.schema import build, parameters, variant_of
from blf_dsc_controller.errors import BlfDscError, check_type
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.journal import (
    MOTIONS,
    Change,
    Event,
    EventType,
    decode,
    decode_change,
)
from blf_dsc_controller.messages.topics import Topic

_OF_INTEREST = (
    *(topic for topic in topics.TOPICS if topic is not topics.CLOCK),
    topics.CHANGES,
)
_MOST_JOURNAL = 1 << 26  # bytes
_HISTORY_OF_EVENTS = (
    topics.DIAGNOSTIC.depth
)  # messages kept by publishers of what is no stream


@dataclass(frozen=True)
class NameMap:
    """Other names in a bag: of topics, by the last part of ours, and of joints."""

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
        return cls(
            {leaf: '/' + name.lstrip('/') for leaf, name in by_leaf.items()}, joints
        )

    def joints_of(self, joints: Sequence[str]) -> tuple[str, ...]:
        """Return the names that these joints have in the bag.

        Raises:
            BlfDscError: a name is mapped that is neither a topic nor one of `joints`, or two of
                these would have one name.
        """
        for joint, theirs in self.joints.items():
            if joint not in joints:
                reason = f'{joint} is neither a topic nor one of the joints {", ".join(joints)}'
                raise _bad_entry(f'{joint}={theirs}', reason)
            if theirs in joints and theirs not in self.joints:
                reason = f'this would be {joint} and {theirs}: map {theirs}, too'
                raise _bad_entry(f'{joint}={theirs}', reason)
        return tuple(self.joints.get(joint, joint) for joint in joints)


NO_NAMES = NameMap()


@dataclass(frozen=True)
class Content:
    """Messages of the package's topics in a bag, and counts of every topic.

    `names` are those that differ.
    """

    path: Path
    names: NameMap
    topics: Mapping[topics.Topic, TopicMessages]
    message_counts: Mapping[str, int]

    @property
    def version(self) -> str:
        """Version of the package whose controller was recorded; empty if unknown."""
        of_events = (event.content.get('version', '') for _, event in self.events)
        return next(of_events, '')

    def joints_of(self, joints: Sequence[str]) -> tuple[str, ...]:
        """Return the names that these joints have in its states.

        Raises:
            BlfDscError: as for `NameMap.joints_of`, or a joint is mapped to a name that no
                state has.
        """
        found = self.names.joints_of(joints)
        named = set().union(*self.topics[topics.JOINT_STATES].name_lists())
        for joint, theirs in self.names.joints.items():
            if theirs not in named:
                reason = (
                    f'the joint states have no {theirs}, but {", ".join(sorted(named))}'
                )
                raise _bad_entry(f'{joint}={theirs}', reason)
        return found

    @property
    def losses(self) -> dict[str, str]:
        """Missing messages of the loop's streams, which have one publisher each."""
        streams = (
            each
            for topic, each in self.topics.items()
            if topic.offered.depth > _HISTORY_OF_EVENTS
        )
        return {each.name: each.lost for each in streams if each.lost}

    @cached_property
    def events(self) -> list[tuple[int, Event]]:
        """Events of the journal but motions, and when they were received [ns].

        Others' messages are skipped.
        """
        return list(self._events_on(topics.JOURNAL, are_motions=False))

    @property
    def motions(self) -> Iterator[tuple[int, Event]]:
        """Trajectories and targets likewise; as they may be many, read one by one."""
        begins = [at for at, event in self.events if event.type is EventType.CONFIGURE]

        def place(entry: tuple[int, Event]) -> tuple[int, int]:
            received, event = entry
            return bisect_right(begins, received), event.number

        found = (
            self._events_on(topic, are_motions=True)
            for topic in (topics.JOURNAL, topics.TARGETS)
        )
        return heapq.merge(*found, key=place)

    def _events_on(
        self, topic: Topic, *, are_motions: bool
    ) -> Iterator[tuple[int, Event]]:
        messages = self.topics.get(topic)
        size = 0
        for received, raw in messages.raw() if messages else ():
            try:
                event = decode(raw)
            except BlfDscError:
                continue
            if (event.type in MOTIONS) != are_motions:
                continue
            size += len(raw)
            if size > _MOST_JOURNAL and not are_motions:
                raise BagError(
                    f'{self.path}: {messages and messages.name} holds more than '
                    f'{_MOST_JOURNAL / 1e6:.0f} MB besides motions, which no controller '
                    'publishes there'
                )
            yield received, event

    @cached_property
    def changes(self) -> list[Change]:
        """Parameters of the plant: all of them first, then each change.

        Others' messages are skipped.
        """
        changes = self.topics.get(topics.CHANGES)
        found = []
        for _, raw in changes.raw() if changes else ():
            with suppress(BlfDscError):
                found.append(decode_change(raw))
        return found

    @property
    def configurations(self) -> dict[str, Mapping[str, Any]]:
        """First recorded parameters of each node of the loop, by node."""
        found: dict[str, Mapping[str, Any]] = {}
        for _, event in self.events:
            if event.type is EventType.CONFIGURE:
                found.setdefault(CONTROLLER, event.content['parameters'])
        for change in self.changes:
            if change.configured:
                found[PLANT] = change.parameters
        return found

    @property
    def unknown_parameters(self) -> list[str]:
        """Recorded parameters of the controller that this version does not have."""
        recorded = without_law(self.configurations.get(CONTROLLER, {}))
        known = {
            each.name for each in parameters(variant_of(ControllerConfig, recorded))
        }
        return [name for name in recorded if name not in known]

    def controller_config(self) -> ControllerConfig:
        """Return the configuration of the controller as first recorded.

        Left out are unknown parameters, and a law of a file, which is not run.

        Raises:
            BagError: the bag holds none, or names a file with the arm.
            ConfigurationError: this version of the package cannot run the configuration.
        """
        values, source = self._recorded()
        left_out = self.unknown_parameters
        given = {
            name: value
            for name, value in without_files(values).items()
            if name not in left_out
        }
        return build(ControllerConfig, given, source)

    def exact_config(self, law: str) -> ControllerConfig:
        """Return the configuration exactly as recorded, but with the law of this file.

        `law` is FILE@DIGEST, or empty for a law of the package.

        Raises:
            BagError: the bag holds none.
            BlfDscError: the recorded law is a file and `law` is none, or the other way round.
            ConfigurationError: this version of the package cannot run the configuration.
        """
        values, source = self._recorded()
        digests = (event.content.get('law_digest') for _, event in self.events)
        digest = next(filter(None, digests), '')
        try:
            given = with_law(values, law, digest)
        except BlfDscError as error:
            raise BagError(f'{self.path}: {error}') from error
        return build(ControllerConfig, given, source)

    def _recorded(self) -> tuple[Mapping[str, Any], str]:
        """Return the parameters of the controller, and where they are from."""
        values = self.configurations.get(CONTROLLER)
        if values is None:
            raise BagError(
                f'{self.path} does not hold the configuration of a controller: it was recorded by '
                'something else, or without the controller'
            )
        source = f'{self.path}, {topics.JOURNAL.resolved}'
        if self.version != __version__:
            source += f' by version {self.version or "unknown"}, not {__version__}'
        return values, source


def read_content(
    path: str | Path, namespace: str = '', names: NameMap = NO_NAMES
) -> Content:
    """Read the messages of our topics from a folder, storage file or ROS 1 `.bag`.

    Raises:
        BagError: there is no bag, it is damaged, it lacks the joint states or a topic of `names`,
            or it holds the topics of several robots.
    """
    check_type('path', path, (str, Path), 'give the folder of a bag')
    path = Path(path)
    with open_bag(path) as bag:
        if not any(bag.counts.values()):
            raise BagError(f'{path} is empty: it holds no message')
        names = _recorded_names(bag, namespace, names)
        found = {
            topic: _find(topic, bag.held, namespace, names) for topic in _OF_INTEREST
        }
        states = found[topics.JOINT_STATES]
        if states is None:
            wanted = topics.JOINT_STATES.name
            if namespace:
                wanted = f'/{namespace.strip("/")}/{wanted}'
            raise _missing_topic(wanted, topics.JOINT_STATES.type, bag.held)
        if not bag.counts[states]:
            raise BagError(f'{path} is empty: it holds no message of {states}')
        motors = topics.MOTOR_STATES
        found[motors] = (
            _find(motors, bag.held, namespace, names)
            if motors.leaf in names.topics
            else _beside(states, motors, bag.held)
        )
        messages = {
            name: TopicMessages(name, bag.held[name])
            for name in found.values()
            if name is not None and bag.counts[name]
        }
        for message in bag.messages(messages):
            messages[message.topic].add(message)
    kept = {topic: messages[name] for topic, name in found.items() if name in messages}
    return Content(path, names, kept, bag.counts)


def _beside(name: str, topic: Topic, held: Mapping[str, str]) -> str | None:
    """Return the name of a topic in the namespace of another, None if it is missing."""
    found = f'{name.rpartition("/")[0]}/{topic.leaf}'
    return found if found != name and held.get(found) == topic.type else None


def _recorded_names(bag: OpenBag, namespace: str, names: NameMap) -> NameMap:
    """Add the topics that the controller was connected to.

    The joint states of some drivers also come at a lower rate, as those of an FR3 do.
    """
    journal = _find(topics.JOURNAL, bag.held, namespace, names)
    recorded: dict[str, str] = {}
    with suppress(BlfDscError, StopIteration):
        if journal is not None:
            recorded = decode(next(bag.messages([journal])).raw).content.get(
                'topics', {}
            )
    own = {leaf: name for leaf, name in recorded.items() if name in bag.held}
    return NameMap({**own, **names.topics}, names.joints)


def _find(
    topic: topics.Topic, held: Mapping[str, str], namespace: str, names: NameMap
) -> str | None:
    """Return the name of a topic in a bag, None if it is missing.

    Type and full name must match; unless the name is absolute, it may also follow any
    namespace, or match in its last part only.
    """
    name = names.topics.get(topic.leaf)
    if name is not None:
        types = (
            (topic.type, topics.JOINT_STATE)
            if topic is topics.COMMANDS
            else (topic.type,)
        )
        if held.get(name) not in types:
            raise _missing_topic(name, ' or '.join(types), held)
        return name
    if topic.name.startswith('/'):
        return topic.name if held.get(topic.name) == topic.type else None
    prefix = f'/{namespace.strip("/")}/' if namespace.strip('/') else '/'
    candidates = [
        name
        for name, type_ in held.items()
        if type_ == topic.type and name.startswith(prefix)
    ]
    for ending in (topic.resolved, f'/{topic.leaf}'):
        fitting = sorted(name for name in candidates if name.endswith(ending))
        exact = [name for name in fitting if name == prefix + ending[1:]]
        if len(fitting) > 1 and not exact:
            raise BagError(
                f'the bag has {len(fitting)} topics that could be {topic.relative!r}: '
                f'{", ".join(fitting)}; select the robot by its namespace, such as '
                f'--namespace {fitting[0].removesuffix(ending)}'
            )
        if fitting:
            return (exact or fitting)[0]
    return None


def _missing_topic(wanted: str, type_name: str, held: Mapping[str, str]) -> BagError:
    listing = ''.join(
        f'\n  {name} ({type_ or "of unknown type"})' for name, type_ in held.items()
    )
    named = 'called' if wanted.startswith('/') else 'whose name ends in'
    return BagError(
        f'the bag has no topic {named} {wanted!r} of type {type_name}; it holds:{listing}'
    )


def _bad_entry(entry: str, reason: str) -> BlfDscError:
    return BlfDscError(
        f'--map {entry}: {reason}; expected OURS=THEIRS with a topic, as in '
        'joint_states=/arm/states, or a joint, as in joint1=shoulder'
    )
