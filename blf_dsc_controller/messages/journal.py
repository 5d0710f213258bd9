# SPDX-License-Identifier: Apache-2.0
"""`~/journal`: every event of the controller, as JSON in a std_msgs/String.

With the journal and the joint states, a replay repeats a run exactly: each event states
the number of joint-state messages it follows, and the stamp of the last of them.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from enum import Enum
from typing import Any, NamedTuple, TypeVar

from blf_dsc_controller import __version__
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.event_content import (
    FORMAT,
    check_change,
    check_event,
)
from blf_dsc_controller.messages.strings import decode_string, encode_string
from blf_dsc_controller.messages.topics import CHANGES, JOURNAL, TARGETS, Topic
from blf_dsc_controller.run import Contact, Oscillation, Stop

Finding = TypeVar('Finding', Contact, Oscillation)

OUTSIDE_BOUND = 'error past the bound'
"""Reason for a stop: the error left its bound."""


class EventType(str, Enum):
    """Type of an event; its content is in `event_content.SCHEMA`."""

    __str__ = str.__str__

    CONFIGURE = 'configure'
    ACTIVATE = 'activate'
    PREPARE = 'prepare'  # the approach is planned before the first state
    TAKEOVER = (
        'takeover'  # another node holds the arm, and the law will go on from there
    )
    START = 'start'  # the law receives its first state
    TRAJECTORY = 'trajectory'
    TARGET = 'target'  # of a stream
    BRAKE = 'brake'
    PARAMETERS = 'parameters'
    DRIVE_LOAD = 'drive load'  # the drives add the weight of a load from now on
    EXPECTED_LOAD = 'expected load'  # somebody says what the tip takes up
    TARE = 'tare'  # the external torque of the arm at rest is taken for zero
    CONTACT = 'contact'  # something touches the arm
    OSCILLATION = 'oscillation'  # the arm oscillates
    TORQUE_SENSORS = (
        'torque sensors'  # efforts are not those of sensors, or make the arm oscillate
    )
    STOP = 'stop'
    SILENCE = 'silence'  # of the joint states, in which the watchdog commanded
    DEACTIVATE = 'deactivate'
    RESET = 'reset'
    WITHDRAW = 'withdraw'  # nothing is commanded until a reset or activation
    RELEASE = 'release'


MOTIONS = frozenset((EventType.TRAJECTORY, EventType.TARGET))
"""Events that may come at a high rate: nodes publish them on `~/targets`."""


class EncodedContent(dict[str, Any]):
    """Content of an event with its JSON, which was made where there is time for it.

    The JSON of 2,000 points takes 9 ms, in which a loop of 1 kHz would miss nine
    states.
    """

    def __init__(self, content: Mapping[str, Any], text: str) -> None:
        super().__init__(content)
        self.text = text


def trajectory_content(
    joints: Sequence[str],
    points: Sequence[Mapping[str, Any]],
    begin: float | None,
    at: float,
) -> EncodedContent:
    """Return the content of a trajectory's event, encoded point by point.

    Between two points other threads may run.
    """
    content = {'joints': joints, 'points': points, 'begin': begin, 'at': at}
    texts = {name: json.dumps(content[name]) for name in ('joints', 'begin', 'at')}
    texts['points'] = f'[{", ".join(json.dumps(point) for point in points)}]'
    fields = ', '.join(f'"{name}": {texts[name]}' for name in content)
    return EncodedContent(content, f'{{{fields}}}')


class Event(NamedTuple):
    """One event of the controller."""

    number: int  # since the controller was configured
    type: EventType
    stamp: int  # of the last joint state before it [ns]; -1 before the first
    messages: int  # joint-state messages processed by then, readable or not
    commands: int  # torques commanded by then
    content: dict[str, Any]

    def encode(self) -> bytes:
        """Return the serialised std_msgs/String."""
        fields = self._asdict()
        content = fields.pop('content')
        is_encoded = isinstance(content, EncodedContent)
        text = content.text if is_encoded else json.dumps(content)
        return encode_string(f'{json.dumps(fields)[:-1]}, "content": {text}}}')


def found_in(
    events: Iterable[Event], event_type: EventType, kind: type[Finding]
) -> tuple[Finding, ...]:
    """Return the contacts or oscillations among events, which have their fields by name."""
    return tuple(
        kind(event.stamp, *(event.content[name] for name in kind._fields[1:]))
        for event in events
        if event.type is event_type
    )


def stops_in(events: Sequence[Event], first: int) -> Iterator[Stop]:
    """Yield the stops among events; an early one gets the first stamp [ns]."""
    for k, event in enumerate(events):
        if event.type is EventType.STOP:
            starts = (
                later.stamp for later in events[k:] if later.type is EventType.START
            )
            what = f'{event.content["reason"]}', event.content['text']
            yield Stop(max(event.stamp, first), *what, until=next(starts, None))


class Change(NamedTuple):
    """Parameters of the plant in force from a stamp on."""

    stamp: int  # ns
    parameters: Mapping[str, Any]
    configured: bool = False  # these are all of them, at the start

    def encode(self) -> bytes:
        """Return the serialised std_msgs/String of `~/changes`."""
        return encode_string(json.dumps(self._asdict()))


def decode_change(raw: bytes) -> Change:
    """Decode the change of a serialised message.

    Raises:
        BlfDscError: it holds no change.
    """
    given = _decoded(raw, check_change, f'{CHANGES.resolved} holds no change')
    return Change(**{name: given[name] for name in Change._fields if name in given})


def decode(raw: bytes) -> Event:
    """Decode the event of a serialised message.

    Raises:
        BlfDscError: it holds no event.
    """
    given = _decoded(raw, check_event, f'{JOURNAL.resolved} holds no event')
    known = {name: given[name] for name in Event._fields}
    known['type'] = EventType(given['type'])
    known['content'] = {**given['content']}
    return Event(**known)


def _decoded(raw: bytes, check: Callable[[object], None], problem: str) -> Any:
    """Return the checked JSON of a std_msgs/String, whoever sent it."""
    try:
        given = json.loads(decode_string(raw))
        check(given)
    except Exception as error:  # libraries raise nearly anything
        reason = f'a message of {problem}: {error}'
        raise BlfDscError(' '.join(reason.split())) from error
    return given


class Journal:
    """Queue of a controller's events until they are published.

    Attributes:
        stamp, messages, commands: as in `Event`, up to now.
        pending: events that have not been published yet.
    """

    def __init__(self) -> None:
        self.stamp = -1
        self.messages = 0
        self.commands = 0
        self.pending: deque[Event] = deque()
        self._number = 0

    def note(self, event: EventType, **content: Any) -> None:
        """Add an event that happens now."""
        if event is EventType.CONFIGURE:
            content['version'] = __version__
            content['format'] = FORMAT
        self.add(event, content)

    def add(self, event: EventType, content: dict[str, Any]) -> None:
        """Add an event that happens now, with its content."""
        noted = Event(
            self._number, event, self.stamp, self.messages, self.commands, content
        )
        self._number += 1
        self.pending.append(noted)

    def take(self) -> Iterator[tuple[Topic, bytes]]:
        """Yield each pending event with its topic, as a message; it is not pending any more."""
        while self.pending:
            event = self.pending.popleft()
            yield TARGETS if event.type in MOTIONS else JOURNAL, event.encode()
