# SPDX-License-Identifier: Apache-2.0
"""Messages of one topic of a bag, decoded block by block while it is read.

Their numbers are in a temporary file, of which only what is asked for comes into memory.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
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
from blf_dsc_controller.run import Floats, Rows, Series, Stamps

_WAITING = 512  # messages decoded at once
_BLOCK = 4096  # rows that are written at once, each column in one piece
_NUMBER, _RECEIVED, _SEQUENCE, _STAMP, _VALUES = range(5)  # columns of a layout
ALL = slice(None)


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


class Columns:
    """Append-only table of `width` columns of 64-bit numbers."""

    def __init__(self, width: int) -> None:
        self.width = width
        self._pending = np.empty((width, _BLOCK), np.int64)
        self._blocks = self._filled = 0
        self._file: Any = None

    def __len__(self) -> int:
        return _BLOCK * self._blocks + self._filled

    def __del__(self) -> None:
        if self._file is not None:
            self._file.close()

    def append(self, rows: NDArray[np.int64]) -> None:
        """Append rows (m, width)."""
        while rows.shape[0]:
            taken = rows[: _BLOCK - self._filled]
            self._pending[:, self._filled : self._filled + taken.shape[0]] = taken.T
            self._filled += taken.shape[0]
            rows = rows[taken.shape[0] :]
            if self._filled == _BLOCK:
                if self._file is None:
                    self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115 - its owner's
                self._file.write(self._pending)
                self._blocks, self._filled = self._blocks + 1, 0

    def read(self, column: int, rows: NDArray[np.int32]) -> NDArray[np.int64]:
        """Return some rows of a column, as an array of its own."""
        if not rows.size:
            return np.empty(0, np.int64)
        first, last = (int(row) // _BLOCK for row in (rows.min(), rows.max()))
        found = np.empty((last + 1 - first, _BLOCK), np.int64)
        for number in range(first, min(last + 1, self._blocks)):
            offset = 8 * _BLOCK * (number * self.width + column)
            found[number - first] = np.frombuffer(
                os.pread(self._file.fileno(), 8 * _BLOCK, offset), np.int64
            )
        if last == self._blocks:
            found[-1] = self._pending[column]
        return np.asarray(found.ravel()[rows - first * _BLOCK])


class JointStates:
    """N states of n joints, or N vectors of n named values in `position`.

    Its arrays are read from a table when they are asked for.
    """

    def __init__(
        self,
        names: Sequence[str],
        table: Columns,
        places: NDArray[np.intp],
        rows: NDArray[np.int32] | None = None,
    ) -> None:
        """Take the values `places` (3, n) and some rows of a table; -1 is unknown."""
        self.names = tuple(names)
        self._table, self._places = table, places
        self._rows = np.arange(len(table), dtype=np.int32) if rows is None else rows
        self.size = self._rows.size

    def head(self, column: int) -> Stamps:
        """Return one of the first columns (N,): number, reception, sequence, stamp."""
        return self._table.read(column, self._rows)

    @property
    def number(self) -> Stamps:
        """Number of each among the messages of the topic (N,)."""
        return self.head(_NUMBER)

    @property
    def received(self) -> Stamps:
        """When each was received (N,) [ns]."""
        return self.head(_RECEIVED)

    @property
    def sequence(self) -> Stamps:
        """Number given by the publisher (N,); 0 if unknown."""
        return self.head(_SEQUENCE)

    @property
    def stamp(self) -> Stamps:
        """Stamps (N,) [ns]."""
        return self.head(_STAMP)

    def has(self, k: int) -> bool:
        """Return whether any of the positions (0), velocities (1) or efforts (2) is known."""
        return bool((self._places[k] >= 0).any())

    def field(self, k: int, rows: Rows = ALL, columns: Rows = ALL) -> Floats:
        """Return positions (0), velocities (1) or efforts (2), (m, n); NaN where unknown."""
        chosen, places = self._rows[rows], self._places[k][columns].tolist()
        values = np.full((len(places), chosen.size), np.nan)
        for row, place in zip(values, places, strict=True):
            if place >= 0:
                row[:] = self._table.read(_VALUES + place, np.maximum(chosen, 0)).view(np.float64)
        values[:, chosen < 0] = np.nan
        return np.asarray(values.T)

    def select(self, rows: Rows) -> JointStates:
        """Return the states of these rows; -1 is an unknown one."""
        chosen = self._rows[rows]
        if not isinstance(rows, slice):
            chosen[rows < 0] = -1
        return JointStates(self.names, self._table, self._places, chosen)

    def of(self, names: Sequence[str]) -> JointStates:
        """Return the states of some of the names."""
        columns = [self.names.index(name) for name in names]
        return JointStates(names, self._table, self._places[:, columns], self._rows)

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

    @classmethod
    def merged(cls, names: Sequence[str], parts: Sequence[JointStates]) -> JointStates:
        """Return the states of several tables in order of reception."""
        if len(parts) == 1:
            return parts[0]
        rows = [
            np.column_stack((
                *(part.head(column) for column in range(_VALUES)),
                *(part.field(k).view(np.int64) for k in range(3)),
            ))
            for part in parts
        ]  # fmt: skip
        together, n = np.concatenate(rows), len(names)
        table = Columns(_VALUES + 3 * n)
        table.append(together[np.argsort(together[:, _NUMBER])])
        return cls(names, table, np.arange(3 * n).reshape(3, n))


class StoredSeries(Series):
    """Series whose values are read from a bag's table when they are asked for."""

    _of: JointStates

    def __init__(self, states: JointStates) -> None:
        """Take the positions of states that are ordered by stamp."""
        for name, value in (('names', states.names), ('stamp', states.stamp), ('_of', states)):
            object.__setattr__(self, name, value)

    @property
    def values(self) -> Floats:
        """All values (m, number of names), read from the table."""
        return self.at(ALL)

    def at(self, rows: Rows, columns: Rows = ALL) -> Floats:
        """Return some rows and columns."""
        return self._of.field(0, rows, columns)


class _Group:
    """Messages of a layout, in a table: number, received, sequence, stamp, then all values."""

    def __init__(self, layout: Layout, *, is_stamped: bool) -> None:
        self.layout, self._is_stamped = layout, is_stamped
        self.table = Columns(_VALUES + layout.places.size)

    def add(self, first: int, messages: Sequence[BagMessage]) -> None:
        """Decode messages of this layout with the numbers from `first` on."""
        count, size, double = len(messages), self.layout.size, self.layout.double
        rows = np.zeros((count, self.table.width), np.int64)
        rows[:, _NUMBER] = first + np.arange(count)
        rows[:, _RECEIVED] = [each.received for each in messages]
        rows[:, _SEQUENCE] = [each.sequence for each in messages]
        joined = b''.join([each.raw for each in messages])
        if self._is_stamped:
            kind = np.dtype([('s', 'i4'), ('ns', 'u4')]).newbyteorder(double.byteorder)
            stamp = np.ndarray(count, kind, joined, STAMP_OFFSET, (size,))
            rows[:, _STAMP] = stamp['s'].astype(np.int64) * NANOSECONDS + stamp['ns']
        grid = np.ndarray((count, (size - ORIGIN) // 8), double, joined, ORIGIN, (size, 8))
        rows[:, _VALUES:] = grid[:, self.layout.places].astype(np.float64).view(np.int64)
        self.table.append(rows)


class TopicMessages:
    """All messages of one topic: tables of those of known types, or the others as bytes."""

    def __init__(self, name: str, type_name: str) -> None:
        self.name, self.type = name, type_name
        self.size = 0
        self.raw: list[bytes] = []  # of other types
        self.received: list[int] = []  # likewise [ns]
        self._find = {JOINT_STATE: joint_state_layout, FLOAT64_MULTI_ARRAY: array_layout}.get(
            type_name
        )
        self._groups: list[_Group] = []
        self._unreadable: dict[int, MessageError] = {}
        self._waiting: list[BagMessage] = []

    def add(self, message: BagMessage) -> None:
        """Add a message."""
        self.size += 1
        if self._find is None:
            self.raw.append(message.raw)
            self.received.append(message.received)
        else:
            self._waiting.append(message)
            if len(self._waiting) == _WAITING:
                self.decode()

    def decode(self) -> None:
        """Decode the messages added last."""
        waiting, self._waiting = self._waiting, []
        begin, first = 0, self.size - len(waiting)
        while begin < len(waiting):
            end = begin + 1
            group = self._group_of(waiting[begin].raw, first + begin)
            if group is not None:
                while end < len(waiting) and group.layout.fits(waiting[end].raw):
                    end += 1
                group.add(first + begin, waiting[begin:end])
            begin = end

    def _group_of(self, raw: bytes, number: int) -> _Group | None:
        for group in self._groups:
            if group.layout.fits(raw):
                return group
        try:
            layout: Any = self._find and self._find(raw)
        except MessageError as error:
            self._unreadable[number] = error
            return None
        self._groups.append(_Group(layout, is_stamped=self.type == JOINT_STATE))
        return self._groups[-1]

    def joint_states(
        self,
        names: Sequence[str],
        required: Sequence[str] = ('position', 'velocity'),
        errors: dict[int, MessageError] | None = None,
    ) -> JointStates:
        """Return sensor_msgs/JointState of these names, without those that name none of them.

        Messages that cannot be decoded are added to `errors` by number.

        Raises:
            UnreadableMessageError: a message cannot be decoded and `errors` is None, or none can.
        """
        unreadable, parts, foreign = dict(self._unreadable), [], None
        for group in self._groups:
            try:
                places = group.layout.columns(names, required)
            except MessageError as error:
                if isinstance(error, MissingJointError) and error.is_foreign(names):
                    foreign = foreign or error
                else:
                    numbers = JointStates((), group.table, np.empty((3, 0), np.intp)).number
                    unreadable.update(dict.fromkeys(numbers.tolist(), error))
            else:
                parts.append(JointStates(names, group.table, places))
        if not parts and foreign is not None and not unreadable:
            unreadable[0] = foreign
        if unreadable and (errors is None or not parts):
            raise UnreadableMessageError(self.name, *min(unreadable.items()))
        if errors is not None:
            errors.update(unreadable)
        return JointStates.merged(names, parts)

    def vectors(self) -> JointStates:
        """Return named values, sent as positions; UnreadableMessageError as above."""
        return self.joint_states(self.joint_names(), ('position',))

    def arrays(self, columns: Sequence[int]) -> JointStates:
        """Return these values of each std_msgs/Float64MultiArray as efforts.

        Raises:
            UnreadableMessageError: a message cannot be decoded, or has other values.
        """
        self.layout()
        size = self._groups[0].layout.arrays[0].size
        if len(self._groups) > 1 or self._unreadable or max(columns) >= size:
            error = MessageError(f'not every message holds the same {size} values')
            raise UnreadableMessageError(self.name, *min([*self._unreadable.items(), (0, error)]))
        places = np.full((3, len(columns)), -1)
        places[2] = columns
        names = [f'{k}' for k in columns]
        return JointStates(names, self._groups[0].table, places)

    def layout(self) -> Layout:
        """Return the layout of the first message; UnreadableMessageError if it has none."""
        if 0 in self._unreadable or not self._groups:
            raise UnreadableMessageError(self.name, 0, self._unreadable[0])
        return self._groups[0].layout

    def name_lists(self) -> list[tuple[str, ...]]:
        """Return the different lists of names; UnreadableMessageError as `layout`."""
        self.layout()
        return list(dict.fromkeys(group.layout.names for group in self._groups))

    def joint_names(self) -> tuple[str, ...]:
        """Return the longest list of names in a message; UnreadableMessageError if it is empty."""
        names = max(self.name_lists(), key=len)
        if not names:
            unnamed = MessageError('it names no joint, so its values cannot be assigned to joints')
            raise UnreadableMessageError(self.name, 0, unnamed)
        return names
