# SPDX-License-Identifier: Apache-2.0
"""What each event of the journal holds, and the number of the journal's format.

Every event that is read is checked against this schema, whoever wrote it. A new event,
or a new field, gets its line in `SCHEMA`; where older versions would replay it wrongly,
`FORMAT` is raised.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

from blf_dsc_controller.errors import BlfDscError

FORMAT = 1
"""Number of this journal's format; it is in the first event.

0 is from before the first release.
"""

_LARGEST = 2**63 - 1  # of an integer
_SHOWN = 40  # characters of a wrong value


class Kind(NamedTuple):
    """A kind of value."""

    text: str  #: for messages, as "a number"
    accepts: Callable[[Any], bool]


def _is_whole(value: object) -> bool:
    """Return whether it is an integer of 64 bits; true and false are none."""
    is_integer = isinstance(value, int) and not isinstance(value, bool)
    return is_integer and -_LARGEST <= value <= _LARGEST  # type: ignore[operator]


def _is_number(value: object) -> bool:
    return _is_whole(value) or (isinstance(value, float) and math.isfinite(value))


def _is_scalar(value: object) -> bool:
    return isinstance(value, (bool, str, float)) or _is_whole(value)


def _is_parameter(value: object) -> bool:
    return _is_scalar(value) or _is_list(value, _is_scalar)


def _is_list(value: object, is_item: Callable[[Any], bool]) -> bool:
    return isinstance(value, (list, tuple)) and all(map(is_item, value))


def _is_mapping(value: object, is_item: Callable[[Any], bool]) -> bool:
    return (
        isinstance(value, Mapping)
        and all(isinstance(key, str) for key in value)
        and all(map(is_item, value.values()))
    )


TEXT = Kind('a text', lambda value: isinstance(value, str))
FLAG = Kind('true or false', lambda value: isinstance(value, bool))
COUNT = Kind('a count', lambda value: _is_whole(value) and value >= 0)
STAMP = Kind('a stamp in ns, or -1', lambda value: _is_whole(value) and value >= -1)
NUMBER = Kind('a finite number', _is_number)
NUMBER_OR_NULL = Kind(
    'a finite number or null', lambda value: value is None or _is_number(value)
)
NUMBERS = Kind('a list of finite numbers', lambda value: _is_list(value, _is_number))
NAMES = Kind('a list of texts', lambda value: _is_list(value, TEXT.accepts))
NAMES_BY_NAME = Kind('texts by name', lambda value: _is_mapping(value, TEXT.accepts))
CONTENT = Kind('fields by name', lambda value: isinstance(value, Mapping))
PARAMETERS = Kind('parameters by name', lambda value: _is_mapping(value, _is_parameter))

# Fields by name; one whose name ends with ? may be missing.
_POINT = {
    'time': NUMBER,
    'positions': NUMBERS,
    'velocities?': NUMBERS,
    'accelerations?': NUMBERS,
    'effort?': NUMBERS,
}


def _is_point(value: object) -> bool:
    return (
        isinstance(value, Mapping)
        and value.keys() <= {name.rstrip('?') for name in _POINT}
        and not [*_problems(value, _POINT)]
    )


POINTS = Kind(
    'a list of points of a trajectory', lambda value: _is_list(value, _is_point)
)

EVENT = {
    'number': COUNT,
    'type': TEXT,
    'stamp': STAMP,
    'messages': COUNT,
    'commands': COUNT,
    'content': CONTENT,
}
"""Fields of every event; see `Event`."""

SCHEMA: Mapping[str, Mapping[str, Kind]] = {
    'configure': {
        'parameters': PARAMETERS,  # all of them
        'format?': COUNT,  # of the journal; 0 without
        'version?': TEXT,  # of the package
        'topics?': NAMES_BY_NAME,  # used, by our name
        'law_digest?': TEXT,  # of the file of a law
    },
    'activate': {},
    'prepare': {'positions': NUMBERS},  # rad, of the arm at rest
    'takeover': {'torque': NUMBERS},  # N m, by which another node holds the arm
    'start': {'resumed': FLAG},
    'trajectory': {
        'joints': NAMES,
        'points': POINTS,
        'begin': NUMBER_OR_NULL,  # s since the start; null: at once
        'at': NUMBER,  # s since the start, followed from then on
    },
    'target': {
        'positions': NUMBERS,  # rad, in the order of `joints`
        'velocities': NUMBERS,  # rad/s; none: it comes to rest there
        'due': NUMBER,  # s since the start, when the reference should be there
        'until': NUMBER,  # s, when it brakes if nothing follows
        'held': FLAG,  # whether it then returns to the positions
        'at': NUMBER,  # s, followed from then on
    },
    'brake': {},
    'parameters': {'parameters': PARAMETERS},  # the changed ones
    'drive load': {  # of the tip, that the drives add from the next state on
        'mass': NUMBER,  # kg
        'centre': NUMBERS,  # m
    },
    'expected load': {  # what the tip takes up besides what it held at the start, as somebody says
        'mass': NUMBER,  # kg
        'centre': NUMBERS,  # m, in the frame of the tip
        'interval': NUMBER,  # s, in which it does
    },
    'tare': {},  # the external torque is zero where the arm rests now
    'contact': {
        'reaction': TEXT,
        'joint': TEXT,  # that shows it most
        'torque': NUMBER,  # N m, from outside, on this joint
        'interval': NUMBER,  # N m, up to which model and noise explain it
        'text': TEXT,
    },
    'oscillation': {
        'joint': TEXT,  # that shows it most
        'frequency': NUMBER,  # Hz
        'torque': NUMBER,  # N m, amplitude
        'text': TEXT,
    },
    'torque sensors': {
        'joint': TEXT,  # that shows it most
        'text': TEXT,
    },
    'stop': {'reason': TEXT, 'text': TEXT},
    'silence': {'torques': COUNT},  # by the watchdog, before the next message
    'deactivate': {},
    'reset': {},
    'withdraw': {'text': TEXT},  # nothing is commanded until a reset, and why
    'release': {'resting?': FLAG},  # under the last torque
}
"""Fields of the content of each type of event, those with ? optional.

Others that a later version adds are ignored.
"""


CHANGE = {
    'stamp': STAMP,
    'parameters': PARAMETERS,
    'configured?': FLAG,
}
"""Fields of a change of the plant's parameters; see `journal.Change`."""


def check_change(given: object) -> None:
    """Check the fields of a change of the plant's parameters.

    Raises:
        BlfDscError: a field is missing or of another kind.
    """
    _check(_fields_of(given), CHANGE)


def check_event(given: object) -> None:
    """Check the fields of an event and its content.

    Raises:
        BlfDscError: its type is unknown, or a field is missing or of another kind.
    """
    event = _fields_of(given)
    _check(event, EVENT)
    fields = SCHEMA.get(event['type'])
    if fields is None:
        raise BlfDscError(
            f'the type {event["type"][:_SHOWN]!r} is none of {", ".join(SCHEMA)}: it may be of a '
            'later version'
        )
    _check(event['content'], fields)


def _fields_of(given: object) -> Mapping[str, Any]:
    if not isinstance(given, Mapping):
        raise BlfDscError('it is no object with fields by name')
    return given


def _check(given: Mapping[str, Any], fields: Mapping[str, Kind]) -> None:
    problem = next(_problems(given, fields), '')
    if problem:
        raise BlfDscError(problem)


def _problems(given: Mapping[str, Any], fields: Mapping[str, Kind]) -> Iterator[str]:
    for field, kind in fields.items():
        name = field.rstrip('?')
        if name not in given:
            if name == field:
                yield f'`{name}` is missing, expected {kind.text}'
        elif not kind.accepts(given[name]):
            yield f'`{name}` is {str(given[name])[:_SHOWN]!r}, expected {kind.text}'
