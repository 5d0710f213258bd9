# SPDX-License-Identifier: Apache-2.0
"""Messages of one topic of a bag, decoded block by block while it is read.

Their numbers are in a temporary file, of which only what is asked for comes into memory.
"""

from __future__ import annotations

import os
import tempfile
from bisect import bisect_right
from collections.abc import Sequence
from itertools import pairwise

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

_BLOCK = 512  # messages decoded at once, which then are in the cache
_NUMBER, _RECEIVED, _SEQUENCE, _STAMP, _VALUES = range(5)  # columns of a table
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


class _File:
    """Temporary file that several tables share, and that is removed with the last of them."""

    def __init__(self) -> None:
        self.stream = tempfile.TemporaryFile()  # noqa: SIM115 - closed below

    def __del__(self) -> None:
        self.stream.close()


class Table:
    """Append-only table of 64-bit numbers, with a block of each column in one piece of a file."""

    def __init__(self, file: _File) -> None:
        self._file = file
        self._begins = [0]  # row at which each block begins, and the end
        self._offsets: list[int] = []  # of each block [bytes]

    def __len__(self) -> int:
        return self._begins[-1]

    def append(self, columns: NDArray[np.int64]) -> None:
        """Append m rows, given as columns (width, m)."""
        stream = self._file.stream
        self._offsets.append(stream.seek(0, os.SEEK_END))
        self._begins.append(len(self) + columns.shape[1])
        stream.write(columns.tobytes())
        stream.flush()

    def read(self, column: int, rows: NDArray[np.int32]) -> NDArray[np.int64]:
        """Return some rows of a column, as an array of its own."""
        if not rows.size:
            return np.empty(0, np.int64)
        first = bisect_right(self._begins, rows.min()) - 1
        last = bisect_right(self._begins, rows.max())
        descriptor, parts = self._file.stream.fileno(), []
        edges = pairwise(self._begins[first : last + 1])
        for offset, (begin, end) in zip(self._offsets[first:last], edges, strict=True):
            size = 8 * (end - begin)
            raw = os.pread(descriptor, size, offset + size * column)
            parts.append(np.frombuffer(raw, np.int64))
        return np.concatenate(parts)[rows - self._begins[first]]


class JointStates:
    """N states of n joints, or N vectors of n named values in `position`.

    Its arrays are read from a table when they are asked for.
    """

    def __init__(
        self,
        names: Sequence[str],
        table: Table,
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
        together = np.hstack([
            np.vstack((
                *(part.head(column) for column in range(_VALUES)),
                *(part.field(k).T.view(np.int64) for k in range(3)),
            ))
            for part in parts
        ])  # fmt: skip
        table = Table(_File())
        table.append(together[:, np.argsort(together[_NUMBER])])
        return cls(names, table, np.arange(3 * len(names)).reshape(3, -1))


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


class TopicMessages:
    """All messages of one topic: a table for each layout of known types, the others as bytes."""

    def __init__(self, name: str, type_name: str) -> None:
        self.name, self.type = name, type_name
        self.size = 0
        self.raw: list[bytes] = []  # of other types
        self.received: list[int] = []  # likewise [ns]
        self._file = _File()
        self._tables: dict[Layout, Table] = {}
        self._unreadable: dict[int, MessageError] = {}
        self._waiting: list[BagMessage] = []

    def add(self, message: BagMessage) -> None:
        """Add a message."""
        self.size += 1
        if self.type not in (JOINT_STATE, FLOAT64_MULTI_ARRAY):
            self.raw.append(message.raw)
            self.received.append(message.received)
        else:
            self._waiting.append(message)
            if len(self._waiting) == _BLOCK:
                self.decode()

    def decode(self) -> None:
        """Decode the messages added last."""
        batches: dict[Layout, list[int]] = {}
        waiting, self._waiting = self._waiting, []
        first, layout = self.size - len(waiting), None
        for k, message in enumerate(waiting):
            if layout is None or not layout.fits(message.raw):
                layout = self._layout_of(message.raw, first + k)
                batch = [] if layout is None else batches.setdefault(layout, [])
            batch.append(k)
        for each, batch in batches.items():
            columns = self._columns(each, [waiting[k] for k in batch])
            columns[_NUMBER] = first + np.array(batch)
            self._tables[each].append(columns)

    def _layout_of(self, raw: bytes, number: int) -> Layout | None:
        for layout in self._tables:
            if layout.fits(raw):
                return layout
        try:
            layout = (joint_state_layout if self.type == JOINT_STATE else array_layout)(raw)
        except MessageError as error:
            self._unreadable[number] = error
            return None
        self._tables[layout] = Table(self._file)
        return layout

    def _columns(self, layout: Layout, messages: Sequence[BagMessage]) -> NDArray[np.int64]:
        """Decode messages of one layout: number, received, sequence, stamp, then all values."""
        count, size, double = len(messages), layout.size, layout.double
        columns = np.zeros((_VALUES + layout.places.size, count), np.int64)
        columns[_RECEIVED] = [each.received for each in messages]
        columns[_SEQUENCE] = [each.sequence for each in messages]
        joined = b''.join([each.raw for each in messages])
        if self.type == JOINT_STATE:
            kind = np.dtype([('s', 'i4'), ('ns', 'u4')]).newbyteorder(double.byteorder)
            stamp = np.ndarray(count, kind, joined, STAMP_OFFSET, (size,))
            columns[_STAMP] = stamp['s'].astype(np.int64) * NANOSECONDS + stamp['ns']
        grid = np.ndarray((count, (size - ORIGIN) // 8), double, joined, ORIGIN, (size, 8))
        columns[_VALUES:] = grid[:, layout.places].astype(np.float64).view(np.int64).T
        return columns

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
        for layout, table in self._tables.items():
            try:
                places = layout.columns(names, required)
            except MessageError as error:
                if isinstance(error, MissingJointError) and error.is_foreign(names):
                    foreign = foreign or error
                else:
                    numbers = JointStates((), table, np.empty((3, 0), np.intp)).number
                    unreadable.update(dict.fromkeys(numbers.tolist(), error))
            else:
                parts.append(JointStates(names, table, places))
        if not parts and foreign is not None and not unreadable:
            unreadable[0] = foreign
        if unreadable and (errors is None or not parts):
            raise UnreadableMessageError(self.name, *min(unreadable.items()))
        if errors is not None:
            errors.update(unreadable)
        return JointStates.merged(names, parts)

    def arrays(self, columns: Sequence[int]) -> JointStates:
        """Return these values of each std_msgs/Float64MultiArray as efforts.

        Raises:
            UnreadableMessageError: a message cannot be decoded, or has other values.
        """
        size = self.layout().arrays[0].size
        if len(self._tables) > 1 or self._unreadable or max(columns) >= size:
            error = MessageError(f'not every message holds the same {size} values')
            raise UnreadableMessageError(self.name, *min([*self._unreadable.items(), (0, error)]))
        places = np.full((3, len(columns)), -1)
        places[2] = columns
        (table,) = self._tables.values()
        return JointStates([f'{k}' for k in columns], table, places)

    def layout(self) -> Layout:
        """Return the layout of the first message; UnreadableMessageError if it has none."""
        if 0 in self._unreadable or not self._tables:
            raise UnreadableMessageError(self.name, 0, self._unreadable[0])
        return next(iter(self._tables))

    def name_lists(self) -> list[tuple[str, ...]]:
        """Return the different lists of names; UnreadableMessageError as `layout`."""
        self.layout()
        return list(dict.fromkeys(layout.names for layout in self._tables))

    def joint_names(self) -> tuple[str, ...]:
        """Return the longest list of names in a message; UnreadableMessageError if it is empty."""
        names = max(self.name_lists(), key=len)
        if not names:
            unnamed = MessageError('it names no joint, so its values cannot be assigned to joints')
            raise UnreadableMessageError(self.name, 0, unnamed)
        return names
