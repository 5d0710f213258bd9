# SPDX-License-Identifier: Apache-2.0
"""Recorded against replayed, bit for bit."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.bags.batch import decode_arrays, decode_joint_states
from blf_dsc_controller.bags.content import Content, TopicMessages
from blf_dsc_controller.messages.cdr import JointStateLayout
from blf_dsc_controller.messages.encoders import JOINT_STATE_FIELDS
from blf_dsc_controller.messages.topics import COMMANDS, LEARNING, MONITOR, Topic
from blf_dsc_controller.replay.expected import Columns
from blf_dsc_controller.replay.states import States
from blf_dsc_controller.run import Floats, Stamps

_NAMED = (LEARNING, MONITOR)


@dataclass(frozen=True)
class Difference:
    """The first number of a topic that is not the same."""

    topic: str
    field: str
    stamp: int  # ns
    time: float  # s since the first state
    recorded: float
    replayed: float

    def __str__(self) -> str:
        return (
            f'{self.time:.6f} s (stamp {self.stamp} ns), {self.topic}, {self.field}: '
            f'recorded {self.recorded!r}, replayed {self.replayed!r}'
        )


@dataclass(frozen=True)
class Comparison:
    """One topic.

    Attributes:
        topic: its name in the bag.
        values: numbers compared.
        difference: the first, None if all are equal.
        left_out: what was not compared, and why not; empty if nothing.
    """

    topic: str
    values: int
    difference: Difference | None
    left_out: str = ''


@dataclass(frozen=True)
class Commands:
    """Torques in the order in which they were commanded.

    Attributes:
        stamp: of the state that each answers (M,) [ns].
        torque: (M, n) [N m].
        of_law: which of them are the law's (M,). Those answer the states that the controller tells
            of; it tells of none while the law is not in command.
        known: how many there are before something that does not show in the states.
        doubt: what that is, in words; empty if there is no such thing.
        in_step: whether the plant waited for each command, so that every state was answered.
    """

    stamp: Stamps
    torque: Floats
    of_law: NDArray[np.bool_]
    known: int
    doubt: str = ''
    in_step: bool = True

    @property
    def sure(self) -> int:
        """How many there are before the first that is not the law's."""
        return int(np.argmin(np.append(self.of_law, values=False)))


def compare(
    content: Content,
    states: States,
    expectation: dict[Topic, Columns],
    gappy: Collection[str] = (),
    commands: Commands | None = None,
) -> Iterator[Comparison]:
    """Compare each topic of the controller that the bag holds.

    Args:
        content: of the bag.
        states: that were replayed.
        expectation: what the topics must hold.
        gappy: topics of which the recorder missed messages.
        commands: all torques; None if there are no others than the law's.

    Raises:
        UnreadableMessageError: a message cannot be decoded.
    """
    for topic, columns in expectation.items():
        recorded = content.topics.get(topic)
        if recorded is None:
            continue
        if topic is COMMANDS:
            torque = np.stack(list(columns.values()), axis=1)
            law_alone = Commands(
                states.stamp, torque, np.ones(len(torque), dtype=np.bool_), len(torque)
            )
            all_of_them = commands or law_alone
            is_gappy = recorded.name in gappy
            yield _compare_commands(recorded, all_of_them, columns, is_gappy=is_gappy)
        else:
            yield _compare_stamped(recorded, states, columns, named=topic in _NAMED)


def first(comparisons: Sequence[Comparison]) -> Difference | None:
    """Earliest difference of all topics."""
    found = [one.difference for one in comparisons if one.difference is not None]
    return min(found, key=lambda difference: difference.stamp, default=None)


def _compare_commands(
    recorded: TopicMessages, commands: Commands, fields: Collection[str], *, is_gappy: bool
) -> Comparison:
    """Commands have no stamp: the k-th is the k-th."""
    count, sure = len(recorded.raw), commands.sure
    if count < sure or is_gappy:
        reason = f'{count} commands for {sure} answered states, and they have no stamp'
        return Comparison(recorded.name, 0, None, reason)
    values = decode_arrays(recorded, len(fields))
    if values is None:
        return Comparison(recorded.name, 0, None, f'they are not {len(fields)} values each')
    compared = min(count, commands.known)
    left_out = _left_out(values, commands)
    if not commands.in_step:
        alike = _alike(values[sure:compared], commands.torque[sure:compared]).all(axis=1)
        if not alike.all():
            compared = sure + int(np.argmin(alike))
            left_out = (
                f'{count - compared} torques from one on that does not match after a stop or '
                'deactivation: in real time a state may have been missed there, or the watch on '
                'the steady clock have spoken'
            )
    columns = dict(zip(fields, commands.torque[:compared].T, strict=True))
    moments = States(commands.stamp[:compared], commands.torque[:compared])
    return _compare(
        recorded.name, moments, np.arange(compared), columns, values[:compared], left_out
    )


def _left_out(values: Floats, commands: Commands) -> str:
    """What of the commands cannot be compared, and why not, in words.

    The last command of a node that ends in order is zero, and answers no state.
    """
    rest = values[commands.known :]
    if commands.doubt:
        return f'{len(rest)} torques, because {commands.doubt}' if len(rest) else ''
    if len(rest) > 1 or rest.any():
        return f'{len(rest)} torques more than are due to the states'
    return ''


def _compare_stamped(
    recorded: TopicMessages, states: States, columns: Columns, *, named: bool
) -> Comparison:
    names = JointStateLayout.parse(recorded.raw[0]).names
    stamp, values = decode_joint_states(recorded, names, ())
    rows, known = _rows(stamp, states)
    fields = dict(zip(names, values[:, 0].T, strict=True)) if named else _fields(names, values)
    shared = {field: column for field, column in columns.items() if field in fields}
    absent = [field for field in (*columns, *fields) if (field in columns) != (field in fields)]
    left_out = ', '.join(absent)
    told = [fields[field][known] for field in shared]
    table = np.stack(told, axis=1) if told else np.empty((rows.size, 0))
    return _compare(recorded.name, states, rows, shared, table, left_out)


def _rows(stamp: Stamps, states: States) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Sample that each message is of, and which messages are of one."""
    if not states.stamp.size:
        return np.empty(0, dtype=np.intp), np.zeros(stamp.size, dtype=np.bool_)
    rows = np.minimum(np.searchsorted(states.stamp, stamp), states.stamp.size - 1)
    known = states.stamp[rows] == stamp
    return rows[known], known


def _fields(names: Sequence[str], values: Floats) -> dict[str, Floats]:
    """Columns of the fields that are not empty."""
    return {
        f'{field} of {joint}': values[:, f, j]
        for f, field in enumerate(JOINT_STATE_FIELDS)
        for j, joint in enumerate(names)
        if not np.isnan(values[:, f, j]).all()
    }


def _compare(
    topic: str,
    states: States,
    rows: NDArray[np.intp],
    columns: Columns,
    recorded: Floats,
    left_out: str = '',
) -> Comparison:
    replayed = (
        np.stack([column[rows] for column in columns.values()], axis=1)
        if columns
        else (np.empty(recorded.shape))
    )
    unlike = ~_alike(recorded, replayed)
    difference = None
    if unlike.any():
        k, j = np.argwhere(unlike)[0]
        difference = Difference(
            topic,
            list(columns)[j],
            int(states.stamp[rows[k]]),
            float(states.time[rows[k]]),
            float(recorded[k, j]),
            float(replayed[k, j]),
        )
    return Comparison(topic, recorded.size, difference, left_out)


def _alike(recorded: Floats, replayed: Floats) -> NDArray[np.bool_]:
    """Where the bits are the same, or both no number."""
    equal = np.ascontiguousarray(recorded).view(np.int64) == replayed.view(np.int64)
    return np.asarray(equal | (np.isnan(recorded) & np.isnan(replayed)))
