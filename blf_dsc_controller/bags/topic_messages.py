# SPDX-License-Identifier: Apache-2.0
"""Messages of one topic of a bag, decoded block by block while it is read.

Their numbers are in a temporary file, of which only what is asked for comes into memory.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Collection, Mapping, Sequence
from itertools import count
from typing import NamedTuple

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
_RECEIVED, _SEQUENCE, _STAMP, _VALUES = range(4)  # columns, the last with all others
_NAN = np.float64(np.nan).view(np.int64)
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


class JointStates:
    """N states of n joints, or N vectors of n named values in `position`.

    Its arrays are read when they are asked for.

    Attributes:
        number: of each among the messages of the topic (N,); -1 is an unknown one.
    """

    def __init__(
        self,
        names: Sequence[str],
        messages: TopicMessages,
        number: NDArray[np.int32],
        columns: Mapping[Layout, NDArray[np.intp]],
    ) -> None:
        """Take where the values (3, n) are in the messages of each layout; -1 is unknown."""
        self.names, self.number, self.size = tuple(names), number, number.size
        self._messages, self._columns = messages, columns

    @property
    def received(self) -> Stamps:
        """When each was received (N,) [ns]."""
        return self._messages.column(_RECEIVED, self.number)

    @property
    def sequence(self) -> Stamps:
        """Number given by the publisher (N,); 0 if unknown."""
        return self._messages.column(_SEQUENCE, self.number)

    @property
    def stamp(self) -> Stamps:
        """Stamps (N,) [ns]."""
        return self._messages.column(_STAMP, self.number)

    def field(self, k: int, rows: Rows = ALL, columns: Rows = ALL) -> Floats:
        """Return positions (0), velocities (1) or efforts (2), (m, n); NaN where unknown."""
        number = self.number[rows]
        joints = np.arange(len(self.names))[columns].tolist()
        values = np.empty((len(joints), number.size))
        for row, j in zip(values, joints, strict=True):
            places = {layout: int(found[k, j]) for layout, found in self._columns.items()}
            row[:] = self._messages.column(places, number).view(np.float64)
        return np.asarray(values.T)

    def select(self, rows: Rows) -> JointStates:
        """Return the states of these rows; -1 is an unknown one."""
        number = self.number[rows]
        if not isinstance(rows, slice):
            number[rows < 0] = -1
        return JointStates(self.names, self._messages, number, self._columns)

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


class StoredSeries(Series):
    """Series whose values are read from a bag's file when they are asked for."""

    _of: JointStates

    def __init__(self, states: JointStates) -> None:
        """Take the positions of states that are ordered by stamp."""
        for name, value in (('names', states.names), ('stamp', states.stamp), ('_of', states)):
            object.__setattr__(self, name, value)

    @property
    def values(self) -> Floats:
        """All values (m, number of names)."""
        return self.at(ALL)

    def at(self, rows: Rows, columns: Rows = ALL) -> Floats:
        """Return some rows and columns."""
        return self._of.field(0, rows, columns)


class _Part(NamedTuple):
    """Messages of one layout in a block, stored column by column."""

    layout: Layout
    places: slice | NDArray[np.intp]  # in the block; a slice if it is the only part
    size: int
    offset: int  # bytes


class TopicMessages:
    """All messages of one topic: the numbers of known types in a file, others as bytes."""

    def __init__(self, name: str, type_name: str) -> None:
        self.name, self.type = name, type_name
        self.size = 0
        self.raw: list[bytes] = []  # of other types
        self.received: list[int] = []  # likewise [ns]
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - closed below
        self._layouts: list[Layout] = []
        self._blocks: list[list[_Part]] = []
        self._unreadable: dict[int, MessageError] = {}
        self._waiting: list[BagMessage] = []

    def __del__(self) -> None:
        self._file.close()

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
        """Decode the messages added last; no other may follow a block that is not full."""
        waiting, self._waiting = self._waiting, []
        places: dict[Layout, list[int]] = {}
        layout = None
        for k, message in enumerate(waiting):
            if layout is None or not layout.fits(message.raw):
                layout = self._layout_of(message.raw, self.size - len(waiting) + k)
            if layout is not None:
                places.setdefault(layout, []).append(k)
        self._blocks.append([])
        for each, found in places.items():
            size, offset = len(found), self._file.seek(0, os.SEEK_END)
            of_part = slice(size) if size == len(waiting) else np.array(found)
            self._blocks[-1].append(_Part(each, of_part, size, offset))
            self._file.write(self._decoded(each, [waiting[k] for k in found]).tobytes())
        self._file.flush()

    def _layout_of(self, raw: bytes, number: int) -> Layout | None:
        for layout in self._layouts:
            if layout.fits(raw):
                return layout
        try:
            layout = (joint_state_layout if self.type == JOINT_STATE else array_layout)(raw)
        except MessageError as error:
            self._unreadable[number] = error
            return None
        self._layouts.append(layout)
        return layout

    def _decoded(self, layout: Layout, messages: Sequence[BagMessage]) -> NDArray[np.int64]:
        """Decode messages of one layout: received, sequence, stamp, then all values."""
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

    def column(
        self, column: int | Mapping[Layout, int], number: NDArray[np.int32]
    ) -> NDArray[np.int64]:
        """Return a column of some messages, which may differ by layout; NaN where unknown."""
        unknown = number < 0
        known = number[~unknown] if unknown.any() else number
        first, last = (known.min() // _BLOCK, known.max() // _BLOCK + 1) if known.size else (0, 0)
        values = np.full((last - first) * _BLOCK + 1, _NAN)  # the last for those unknown
        for block, begin in zip(self._blocks[first:last], count(0, _BLOCK), strict=False):
            for part in block:
                j = column if isinstance(column, int) else column.get(part.layout, -1)
                if j >= 0:
                    size = 8 * part.size
                    raw = os.pread(self._file.fileno(), size, part.offset + size * j)
                    values[begin : begin + _BLOCK][part.places] = np.frombuffer(raw, np.int64)
        index = number - first * _BLOCK
        index[unknown] = -1
        return values[index]

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
        unreadable, columns, foreign = dict(self._unreadable), {}, dict[int, MessageError]()
        for layout in self._layouts:
            try:
                found = layout.columns(names, required)
            except MessageError as error:
                is_foreign = isinstance(error, MissingJointError) and error.is_foreign(names)
                others = dict.fromkeys(self._numbers([layout]).tolist(), error)
                (foreign if is_foreign else unreadable).update(others)
            else:
                columns[layout] = np.where(found < 0, -1, found + _VALUES)
        if not columns:
            unreadable = unreadable or foreign
        if unreadable and (errors is None or not columns):
            raise UnreadableMessageError(self.name, *min(unreadable.items()))
        if errors is not None:
            errors.update(unreadable)
        return JointStates(names, self, self._numbers(columns), columns)

    def _numbers(self, layouts: Collection[Layout]) -> NDArray[np.int32]:
        """Return the numbers of all messages of these layouts, in order."""
        parts = [
            np.arange(begin, begin + _BLOCK)[part.places]
            for block, begin in zip(self._blocks, count(0, _BLOCK), strict=False)
            for part in block
            if part.layout in layouts
        ]
        return np.sort(np.concatenate([np.empty(0, np.intp), *parts])).astype(np.int32)

    def arrays(self, columns: Sequence[int]) -> JointStates:
        """Return these values of each std_msgs/Float64MultiArray as efforts.

        Raises:
            UnreadableMessageError: a message cannot be decoded, or has other values.
        """
        layout = self.layout()
        size = layout.arrays[0].size
        if len(self._layouts) > 1 or self._unreadable or max(columns) >= size:
            error = MessageError(f'not every message holds the same {size} values')
            raise UnreadableMessageError(self.name, *min([*self._unreadable.items(), (0, error)]))
        places = np.full((3, len(columns)), -1)
        places[2] = np.array(columns) + _VALUES
        names = [f'{k}' for k in columns]
        return JointStates(names, self, self._numbers([layout]), {layout: places})

    def layout(self) -> Layout:
        """Return the layout of the first message; UnreadableMessageError if it has none."""
        if 0 in self._unreadable or not self._layouts:
            raise UnreadableMessageError(self.name, 0, self._unreadable[0])
        return self._layouts[0]

    def name_lists(self) -> list[tuple[str, ...]]:
        """Return the different lists of names; UnreadableMessageError as `layout`."""
        self.layout()
        return list(dict.fromkeys(layout.names for layout in self._layouts))

    def joint_names(self) -> tuple[str, ...]:
        """Return the longest list of names in a message; UnreadableMessageError if it is empty."""
        names = max(self.name_lists(), key=len)
        if not names:
            unnamed = MessageError('it names no joint, so its values cannot be assigned to joints')
            raise UnreadableMessageError(self.name, 0, unnamed)
        return names
