# SPDX-License-Identifier: Apache-2.0
"""Messages of one topic of a bag, decoded block by block while it is read.

Their numbers are in a temporary file, of which only what is asked for comes into memory.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.bags.sources import BagError, BagMessage
from blf_dsc_controller.messages.codecs import (
    NANOSECONDS,
    ORIGIN,
    STAMP_OFFSET,
    Layout,
    MessageError,
    MissingJointError,
    array_layout,
    joint_state_layout,
)
from blf_dsc_controller.messages.topics import FLOAT64_MULTI_ARRAY, JOINT_STATE
from blf_dsc_controller.run import Floats, Stamps

_BLOCK = 512  # messages decoded at once, which then are in the cache
_RECENT = 100  # layouts that a message is compared with: more only where no two messages are alike
_NUMBER, _RECEIVED, _SEQUENCE, _STAMP, _VALUES = range(5)  # columns, the last with all others
_MOST_PUBLISHERS = 10  # of a topic, one after the other or at once
_NAN = np.float64(np.nan).view(np.int64)
_ALL = slice(None)
Rows = slice | NDArray[np.intp]


class UnreadableMessageError(BagError):
    """A message of a bag that cannot be decoded."""

    def __init__(self, topic: str, index: int, error: MessageError) -> None:
        reason = str(error)
        if isinstance(error, MissingJointError):
            reason = (
                f'{error.fact}: the bag is from another robot, or its joints have other names: '
                f'--map {error.joint}=ITS_NAME'
            )
        super().__init__(f'message {index + 1} of {topic} cannot be read: {reason}')


class _File:
    """A temporary file, which lasts as long as what refers to it."""

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - closed below

    def __del__(self) -> None:
        self._file.close()

    def append(self, content: bytes) -> int:
        """Write at the end and return the offset."""
        offset = self._file.seek(0, os.SEEK_END)
        self._file.write(content)
        self._file.flush()
        return offset

    def read_into(self, array: NDArray[np.int64], offset: int) -> None:
        """Fill an array from an offset on."""
        os.preadv(self._file.fileno(), [array.data], offset)


class _Store:
    """Messages of one layout in the file of their topic: blocks of them, each column by column."""

    def __init__(self, layout: Layout, file: _File, *, has_stamp: bool) -> None:
        self.layout, self.size = layout, 0
        self._has_stamp = has_stamp
        self._waiting: list[tuple[int, BagMessage]] = []
        self._file = file
        self._blocks: list[tuple[int, int]] = []  # offset [bytes], messages

    def add(self, number: int, message: BagMessage) -> None:
        """Add a message with its number among those of the topic."""
        self.size += 1
        self._waiting.append((number, message))
        if len(self._waiting) == _BLOCK:
            self.flush()

    def flush(self) -> None:
        """Decode the messages added last; no other may follow a block that is not full."""
        waiting, self._waiting = self._waiting, []
        if not waiting:
            return
        count, size = len(waiting), self.layout.size
        columns = np.zeros((_VALUES + self.layout.places.size, count), np.int64)
        columns[_NUMBER] = [number for number, _ in waiting]
        columns[_RECEIVED] = [message.received for _, message in waiting]
        columns[_SEQUENCE] = [message.sequence for _, message in waiting]
        joined = b''.join([message.raw for _, message in waiting])
        if self._has_stamp:
            kind = np.dtype([('s', '<i4'), ('ns', '<u4')])
            stamp = np.ndarray(count, kind, joined, STAMP_OFFSET, (size,))
            columns[_STAMP] = stamp['s'].astype(np.int64) * NANOSECONDS + stamp['ns']
        grid = np.ndarray((count, (size - ORIGIN) // 8), '<i8', joined, ORIGIN, (size, 8))
        columns[_VALUES:] = grid[:, self.layout.places].T
        self._blocks.append((self._file.append(columns.tobytes()), count))

    def column(self, j: int, rows: NDArray[np.int32]) -> NDArray[np.int64]:
        """Return a column of some of these messages."""
        if not rows.size:
            return np.empty(0, np.int64)
        first, last = rows.min() // _BLOCK, rows.max() // _BLOCK + 1
        values = np.empty((last - first, _BLOCK), np.int64)
        for block, (offset, count) in zip(values, self._blocks[first:last], strict=True):
            self._file.read_into(block[:count], offset + 8 * count * j)
        found: NDArray[np.int64] = values.ravel()[rows - first * _BLOCK]
        return found


class Values:
    """Values (N, n) of states, read when they are indexed: by rows, or by rows and columns.

    Where they are unknown, they are NaN, or the difference of two others if these are given.
    """

    def __init__(
        self, states: JointStates, field: int, difference: tuple[Values, Values] | None = None
    ) -> None:
        self._states, self._field, self._difference = states, field, difference

    def __getitem__(self, key: Any) -> Floats:
        rows, columns = key if isinstance(key, tuple) else (key, _ALL)
        states = self._states.select(rows)
        joints = np.arange(len(states.names))[columns]
        values = np.empty((joints.size, states.size))
        for row, j in zip(values, joints.ravel().tolist(), strict=True):
            row[:] = states.column([places[self._field, j] for _, places in states.parts]).view(
                float
            )
        values = values.T if joints.ndim else values[0]
        if self._difference is not None and np.isnan(values).any():
            first, second = (each[key] for each in self._difference)
            values = np.where(np.isnan(values), first - second, values)
        return values

    def __array__(self, dtype: Any = None, copy: Any = None) -> NDArray[Any]:
        """Return all of them."""
        return self[:].astype(dtype or np.float64, copy=False)


class JointStates:
    """N states of n joints, or N vectors of n named values in `position`."""

    def __init__(
        self,
        names: Sequence[str],
        parts: Sequence[tuple[_Store, NDArray[np.intp]]],
        rows: NDArray[np.int32],
    ) -> None:
        """Take rows (N,) of the messages of several layouts, one after another; -1 is unknown.

        With each layout comes where its values (3, n) are; -1 is unknown.
        """
        self.names, self.size = tuple(names), rows.size
        self.parts, self._rows = parts, rows

    @property
    def number(self) -> NDArray[np.int64]:
        """Number of each among the messages of the topic (N,)."""
        return self.column([_NUMBER] * len(self.parts))

    @property
    def received(self) -> Stamps:
        """When each was received (N,) [ns]."""
        return self.column([_RECEIVED] * len(self.parts))

    @property
    def sequence(self) -> Stamps:
        """Number given by the publisher (N,); 0 if unknown."""
        return self.column([_SEQUENCE] * len(self.parts))

    @property
    def stamp(self) -> Stamps:
        """Stamps (N,) [ns]."""
        return self.column([_STAMP] * len(self.parts))

    def field(self, k: int) -> Any:
        """Return positions (0), velocities (1) or efforts (2) as `Values` (N, n)."""
        return Values(self, k)

    def column(self, places: Sequence[int]) -> NDArray[np.int64]:
        """Return a column (N,), which is at this place of each layout; NaN where unknown."""
        values, begin = np.full(self.size, _NAN), 0
        for (store, _), j in zip(self.parts, places, strict=True):
            inside = (self._rows >= begin) & (self._rows < begin + store.size)
            if j >= 0:
                values[inside] = store.column(j, self._rows[inside] - begin)
            begin += store.size
        return values

    def select(self, rows: Rows) -> JointStates:
        """Return the states of these rows; -1 is an unknown one."""
        chosen = self._rows[rows]
        if not isinstance(rows, slice):
            chosen[rows < 0] = -1
        return JointStates(self.names, self.parts, chosen)

    def by_stamp(self) -> JointStates:
        """Return the states ordered by stamp, one per stamp."""
        stamp = self.stamp
        if (stamp[1:] > stamp[:-1]).all():
            return self
        return self.select(np.unique(stamp, return_index=True)[1])

    def at_stamps(self, stamp: Stamps) -> JointStates:
        """Return the states with exactly these stamps; ours increase."""
        own = self.stamp
        index = np.minimum(np.searchsorted(own, stamp), own.size - 1)
        index[own[index] != stamp] = -1
        return self.select(index)

    def held(self, stamp: Stamps) -> JointStates:
        """Return the last states at or before these stamps, else the first."""
        return self.select(np.maximum(np.searchsorted(self.stamp, stamp, side='right') - 1, 0))


class TopicMessages:
    """All messages of one topic: the numbers of known types in a file, others as bytes."""

    def __init__(self, name: str, type_name: str) -> None:
        self.name, self.type = name, type_name
        self.size = 0
        self.raw: list[bytes] = []  # of other types
        self.received: list[int] = []  # likewise [ns]
        self._file = _File()
        self._stores: list[_Store] = []
        self._last: _Store | None = None  # that of the last message
        self._unreadable: dict[int, MessageError] = {}
        self._next: list[int] = []  # sequence number of each publisher, that of the last one last
        self._missed = self._before = 0

    def add(self, message: BagMessage) -> None:
        """Add a message."""
        if message.sequence:
            self._count(message.sequence)
        if self.type not in (JOINT_STATE, FLOAT64_MULTI_ARRAY):
            self.raw.append(message.raw)
            self.received.append(message.received)
        else:
            if self._last is None or not self._last.layout.fits(message.raw):
                self._last = self._store_of(message.raw)
            if self._last is not None:
                self._last.add(self.size, message)
        self.size += 1

    def _count(self, sequence: int) -> None:
        """Count the messages that are missing before the one with this number."""
        if self._next and self._next[-1] == sequence:
            self._next[-1] += 1
        elif len(self._next) <= _MOST_PUBLISHERS:
            expected = max((number for number in self._next if number <= sequence), default=0)
            if expected:
                self._next.remove(expected)
                self._missed += sequence - expected
            else:  # of another publisher
                self._before += sequence - 1
            self._next.append(sequence + 1)

    @property
    def lost(self) -> str:
        """How many messages are missing, by their numbers; empty if none, or if unknown."""
        if len(self._next) > _MOST_PUBLISHERS or not self._missed + self._before:
            return ''
        earlier = f', {self._before} sent before the recorder connected' if self._before else ''
        return f'{self._missed} missed{earlier}'

    def _store_of(self, raw: bytes) -> _Store | None:
        for store in self._stores[-_RECENT:]:
            if store.layout.fits(raw):
                return store
        is_state = self.type == JOINT_STATE
        try:
            layout = (joint_state_layout if is_state else array_layout)(raw)
        except MessageError as error:
            self._unreadable[self.size] = error
            return None
        self._stores.append(_Store(layout, self._file, has_stamp=is_state))
        return self._stores[-1]

    def joint_states(
        self,
        names: Sequence[str],
        required: Collection[str] = ('position', 'velocity'),
        errors: dict[int, MessageError] | None = None,
    ) -> JointStates:
        """Return sensor_msgs/JointState of these names, without those that name none of them.

        Messages that cannot be decoded are added to `errors` by number.

        Raises:
            UnreadableMessageError: a message cannot be decoded and `errors` is None, or none can.
        """
        unreadable, foreign = dict(self._unreadable), dict[int, MessageError]()
        parts = []
        for store in self._stores:
            store.flush()
            try:
                found = store.layout.columns(names, required)
            except MessageError as error:
                is_foreign = isinstance(error, MissingJointError) and error.is_foreign(names)
                numbers = store.column(_NUMBER, np.arange(store.size, dtype=np.int32)).tolist()
                (foreign if is_foreign else unreadable).update(dict.fromkeys(numbers, error))
            else:
                parts.append((store, np.where(found < 0, -1, found + _VALUES)))
        if not parts:
            unreadable = unreadable or foreign
        if unreadable and (errors is None or not parts):
            raise UnreadableMessageError(self.name, *min(unreadable.items()))
        if errors is not None:
            errors.update(unreadable)
        return _together(names, parts)

    def arrays(self, columns: Sequence[int]) -> JointStates:
        """Return these values of each std_msgs/Float64MultiArray as efforts.

        Raises:
            UnreadableMessageError: a message cannot be decoded, or has other values.
        """
        size = self.layout().arrays[0].size
        self._stores[0].flush()
        if len(self._stores) > 1 or self._unreadable or max(columns) >= size:
            error = MessageError(f'not every message holds the same {size} values')
            raise UnreadableMessageError(self.name, *min([*self._unreadable.items(), (0, error)]))
        places = np.full((3, len(columns)), -1)
        places[2] = np.array(columns) + _VALUES
        return _together([f'{k}' for k in columns], [(self._stores[0], places)])

    def layout(self) -> Layout:
        """Return the layout of the first message; UnreadableMessageError if it has none."""
        if 0 in self._unreadable or not self._stores:
            raise UnreadableMessageError(self.name, 0, self._unreadable[0])
        return self._stores[0].layout

    def name_lists(self) -> list[tuple[str, ...]]:
        """Return the different lists of names; UnreadableMessageError as `layout`."""
        self.layout()
        return list(dict.fromkeys(store.layout.names for store in self._stores))

    def joint_names(self) -> tuple[str, ...]:
        """Return the longest list of names in a message; UnreadableMessageError if it is empty."""
        names = max(self.name_lists(), key=len)
        if not names:
            unnamed = MessageError('it names no joint, so its values cannot be assigned to joints')
            raise UnreadableMessageError(self.name, 0, unnamed)
        return names


def _together(
    names: Sequence[str], parts: Sequence[tuple[_Store, NDArray[np.intp]]]
) -> JointStates:
    """Return all messages of some layouts in order."""
    rows = np.arange(sum(store.size for store, _ in parts), dtype=np.int32)
    states = JointStates(names, parts, rows)
    return states if len(parts) == 1 else states.select(np.argsort(states.number, kind='stable'))
