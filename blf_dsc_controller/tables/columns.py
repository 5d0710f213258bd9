# SPDX-License-Identifier: Apache-2.0
"""Which columns of a table are the time, positions and torques of the joints, and motors.

They are found from their names, or given: `time=t`, `q=pos_*`, `tau=6:12` (columns 6 to
11), `time=100Hz` if no column has the time.  A unit may follow in brackets, `time=t[ns]`;
otherwise it is that of the names.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import NamedTuple

from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.tables.units import factor_of, is_of_drive, split_unit

KINDS = ('time', 'q', 'tau', 'theta')
"""Columns, by the names of `--map`; positions theta of the motors are not needed."""

_WORDS = {
    kind: frozenset(words.split())
    for kind, words in {
        'time': 't time times timestamp stamp secs seconds',
        'q': 'q qpos pos position positions angle angles jointposition',
        'tau': 'tau torque torques effort efforts force trq jointtorque current currents',
        'theta': 'theta motor motors',
        'current': 'current currents',
        'rate': 'dot ddot vel qvel velocity speed acc acceleration',
        'unmeasured': 'd des desired target ref reference cmd command '
        'ext external error err offset',
    }.items()
}
_SECONDS = re.compile('sec(ond)?s?', re.IGNORECASE)
_NANOSECONDS = re.compile('n(ano)?sec(ond)?s?', re.IGNORECASE)
_SHOWN = 60  # names of columns in a message
_RATE = re.compile(r'(\d*\.?\d+|\d+\.)\s*Hz', re.IGNORECASE)
_RANGE = re.compile(r'(\d+):(\d+)')
_NUMBER = re.compile(r'\d+')


class Column(NamedTuple):
    """A column, and the factor of its unit, whose name is empty if it is not named."""

    name: str
    factor: float
    unit: str = ''


class Columns(NamedTuple):
    """Columns of a recording.

    The time is the sum of its columns, or that of rows at a rate.
    """

    time: list[Column]  # s
    rate: float  # Hz; 0: the time is in columns
    q: list[Column]  # rad, or m
    tau: list[Column]  # N m, or N
    theta: list[Column]  # rad, or m, of the motors; none if they are not known
    has_currents: bool  # by their names or units: currents or shares of a rated torque

    @property
    def text(self) -> str:
        """The columns, as they are reported."""
        positions = f'positions {self.q[0].name!r} to {self.q[-1].name!r}'
        text = f'{positions}, torques {self.tau[0].name!r} to {self.tau[-1].name!r}'
        if self.theta:
            motors = f'{self.theta[0].name!r} to {self.theta[-1].name!r}'
            text += f', positions of motors {motors}'
        return text


def choose_columns(
    path: Path,
    names: Sequence[str],
    given: Mapping[str, str],
    joints: Sequence[str],
) -> Columns:
    """Return the columns of the joints, which have these names in the table.

    `given` has what was chosen of KINDS.

    Raises:
        BlfDscError: they are not found, or their units are not known.
    """
    q, tau = (
        _of_joints(path, names, kind, given[kind], joints) for kind in ('q', 'tau')
    )
    if len(tau) != len(q):
        raise BlfDscError(
            f'{path} has {len(q)} positions ({", ".join(q)}) and {len(tau)} torques '
            f'({", ".join(tau)}): choose as many, as in --map tau=tau_*'
        )
    theta = _of_motors(path, names, given['theta'], joints, q)
    chosen = {'q': q, 'tau': tau, 'theta': theta}
    _check_meanings(path, names, chosen, joints)
    rate = _RATE.fullmatch(given['time'])
    if rate and not float(rate[1]):
        raise BlfDscError(
            f'--map time={given["time"]}: the rate of the rows must be above 0'
        )
    time = [] if rate else _time(path, names, given['time'])
    found = {
        kind: _with_factors(path, each, kind, given[kind])
        for kind, each in chosen.items()
    }
    words = set().union(*(_meaning(name, joints) for name in tau))
    return Columns(
        time=time,
        rate=float(rate[1]) if rate else 0.0,
        **found,
        has_currents=bool(words & _WORDS['current'])
        or any(is_of_drive(each.unit) for each in found['tau']),
    )


def _of_joints(
    path: Path, names: Sequence[str], kind: str, given: str, joints: Sequence[str]
) -> list[str]:
    """Return the columns of the positions or torques, in the order of the joints."""
    if given:
        found = _matching(names, given, kind)
    else:
        found = [name for name in names if _is_named(name, kind, joints)]
    if kind == 'q' and not given:
        of_links = [name for name in found if not _is_named(name, 'theta', joints)]
        found = of_links or found
    named = [_of_joint(found, joint) for joint in joints]
    if all(named):
        return [name for name in named if name]
    if found and len(found) <= len(joints):
        are_numbers = _RANGE.fullmatch(split_unit(given, kind).stem)
        return found if are_numbers else _by_number(found, kind)
    which = f'Its columns are {_listed(names)}'
    if len(found) > len(joints):
        which = f'These may be: {_listed(found)}'
    raise BlfDscError(
        f'{path}: which columns are {kind} of {", ".join(joints)} is not clear. {which}: choose '
        f'them, as in --map {kind}={kind}_* or --map {kind}=1:7 (columns 1 to 6, the first is 0)'
        f'{_elsewhere(path, names, joints, given or found)}'
    )


def _elsewhere(
    path: Path, names: Sequence[str], joints: Sequence[str], found: Sequence[str]
) -> str:
    """Return what to do if columns, of which none was found, are in another file."""
    if found or not any(_kind_of(name, joints) for name in names):
        return ''
    return (
        f'. If they are in another file, put both side by side: paste -d, {path} OTHER.csv > '
        'both.csv'
    )


def _of_motors(
    path: Path, names: Sequence[str], given: str, joints: Sequence[str], q: list[str]
) -> list[str]:
    """Return the columns of the motors' positions, besides those of the joints; none: unknown."""
    if given:
        theta = _of_joints(path, names, 'theta', given, joints)
    else:
        found = [
            name
            for name in names
            if name not in q
            and _is_named(name, 'theta', joints)
            and ('theta' in _meaning(name, joints) or _is_named(name, 'q', joints))
        ]
        theta = [name for joint in joints if (name := _of_joint(found, joint))]
        if len(theta) != len(q) and len(found) == len(q):
            theta = _by_number(found, 'q')
    if len(theta) == len(q):
        return theta
    if not given:
        return []
    raise BlfDscError(
        f'{path} has {len(q)} positions ({", ".join(q)}) and {len(theta)} of motors '
        f'({", ".join(theta)}): choose as many, as in --map theta=theta_*'
    )


def _check_meanings(
    path: Path,
    names: Sequence[str],
    chosen: Mapping[str, Sequence[str]],
    joints: Sequence[str],
) -> None:
    """Raise BlfDscError if a column is chosen twice, or positions as torques, or vice versa."""
    kinds: dict[str, str] = {}
    for kind, columns in chosen.items():
        by_name = [name for name in names if _is_named(name, kind, joints)]
        for name in columns:
            other = kinds.setdefault(name, kind)
            if kind != 'theta' and by_name and name not in by_name:
                other = _kind_of(name, joints) or other
            if other != kind:
                pattern = pattern_of(names, by_name) if by_name else f'{kind}_*'
                raise BlfDscError(
                    f'{path}: {name!r} was chosen as {kind}, but is {other}: choose others, as in '
                    f"--map '{kind}={pattern}'"
                )


def _kind_of(name: str, joints: Sequence[str]) -> str:
    """Return whether a column is q or tau by its name; empty if it has no such name."""
    return next((kind for kind in ('q', 'tau') if _is_named(name, kind, joints)), '')


def _is_named(name: str, kind: str, joints: Sequence[str]) -> bool:
    """Return whether a column is q, tau or theta by its name."""
    words = _meaning(split_unit(name, kind).stem, joints)
    return bool(_WORDS[kind] & words) and not words & _WORDS['rate']


def pattern_of(names: Sequence[str], columns: Sequence[str]) -> str:
    """Return what chooses exactly these columns: a pattern or numbers."""
    first = names.index(columns[0])
    for found in (
        f'{beginning(columns)}*',
        f'*{beginning([name[::-1] for name in columns])[::-1]}',
        f'{first}:{first + len(columns)}',
    ):
        if set(_matching(names, found, 'q')) == set(columns):
            return found
    return '...'


def beginning(names: Sequence[str]) -> str:
    """Return the letters with which all names begin."""
    first, last = min(names), max(names)
    differs = (k for k in range(len(first)) if first[k] != last[k : k + 1])
    return first[: next(differs, len(first))]


def _of_joint(columns: Sequence[str], joint: str) -> str | None:
    """Return the column of a joint, which has its name; None if there is not exactly one."""
    own = [
        name
        for name in columns
        if re.search(rf'(?<![^\W_]){re.escape(joint)}(?![^\W_])', name)
    ]
    own = own or [name for name in columns if joint in name]
    return own[0] if len(own) == 1 else None


def _by_number(columns: Sequence[str], kind: str) -> list[str]:
    """Return columns in the order of their numbers, if these are all that differs."""
    stems = [split_unit(name, kind).stem for name in columns]
    numbers = [_NUMBER.findall(stem) for stem in stems]
    if len({_NUMBER.sub('', stem) for stem in stems}) > 1 or not all(numbers):
        return list(columns)
    keys = [tuple(map(int, each)) for each in numbers]
    return [columns[k] for k in sorted(range(len(keys)), key=keys.__getitem__)]


def _matching(names: Sequence[str], given: str, kind: str) -> list[str]:
    """Return the columns by their name, a range of numbers, or a pattern of names."""
    for wanted in (given, split_unit(given, kind).stem):
        if wanted in names:
            return [wanted]
        numbers = _RANGE.fullmatch(wanted)
        if numbers:
            return list(names[int(numbers[1]) : int(numbers[2])])
        found = [name for name in names if fnmatchcase(name, wanted)]
        if found:
            return found
    return []


def _meaning(column: str, joints: Sequence[str]) -> set[str]:
    """Return the words of a column's name besides a joint's; none if it is not measured."""
    for joint in sorted(joints, key=len, reverse=True):
        column = column.replace(joint, ' ')
    spaced = re.sub('([a-z])([A-Z])', r'\1 \2', column)
    words = set(re.findall('[a-z]+', spaced.lower()))
    return set() if words & _WORDS['unmeasured'] else words


def _time(path: Path, names: Sequence[str], given: str) -> list[Column]:
    """Return the columns whose sum is the time: by their names, of several, the stamps."""
    if given:
        found = _matching(names, given, 'time')
    else:
        named = [name for name in names if is_time(name)]
        stamps = [name for name in named if 'stamp' in name.lower()]
        found = stamps if len(named) > 1 and stamps else named
    pair = _seconds_and_nanoseconds(found)
    if pair:
        return pair
    if len(found) != 1:
        raise BlfDscError(
            f'{path}: which column is the time is not clear. Its columns are '
            f'{_listed(names)}: choose it and its unit, as in --map time=t or --map time=t[ns], '
            'or give the rate of the rows, as in --map time=100Hz'
        )
    return _with_factors(path, found, 'time', given)


def is_time(name: str) -> bool:
    """Return whether a column is the time, or a part of it, by its name."""
    words = _meaning(name, ())
    is_time = _WORDS['time'] & words or any(map(_SECONDS.fullmatch, words))
    is_rest = any(map(_NANOSECONDS.fullmatch, words))
    return bool(is_time or is_rest) and not _WORDS['q'] & words


def _seconds_and_nanoseconds(columns: Sequence[str]) -> list[Column]:
    """Return a column of seconds and one of nanoseconds that are one time; else none."""
    rest = [name for name in columns if _NANOSECONDS.search(name)]
    seconds = [name for name in columns if name not in rest and _SECONDS.search(name)]
    if len(seconds) != 1 or len(rest) != 1:
        return []
    if _SECONDS.sub('', seconds[0]) != _NANOSECONDS.sub('', rest[0]):
        return []
    return [Column(seconds[0], 1.0), Column(rest[0], 1e-9)]


def _with_factors(
    path: Path, names: Sequence[str], kind: str, given: str
) -> list[Column]:
    """Return columns with their units: the one given, or those of their names."""
    common = split_unit(given, kind).unit if given not in names else ''
    units = [common or split_unit(name, kind).unit for name in names]
    factors = [factor_of(path, unit, kind) for unit in units]
    return list(map(Column, names, factors, units))


def _listed(names: Sequence[str]) -> str:
    """Return the names, not all of very many."""
    shown = ', '.join(names[:_SHOWN])
    more = len(names) - _SHOWN
    return shown if more <= 0 else f'{shown} and {more} more'
