# SPDX-License-Identifier: Apache-2.0
"""Messages of one topic of a bag, decoded block by block while it is read.

Their numbers are in a temporary file, of which only what is asked for comes into
memory.
"""

from __future__ import annotations

import os
import tempfile
from collections import deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.bags.sources import BagError, BagMessage
from blf_dsc_controller.messages.codecs import (
    JOINT_STATE_FIELDS,
    NANOSECONDS,
    ORIGIN,
    STAMP_OFFSET,
    Layout,
    array_layout,
    joint_state_layout,
)
from blf_dsc_controller.messages.errors import MessageError, MissingJointError
from blf_dsc_controller.messages.topics import FLOAT64_MULTI_ARRAY, JOINT_STATE
from blf_dsc_controller.run import Floats, Stamps

_BLOCK = 512  # messages decoded at once, which then are in the cache
# layouts that a message is compared with: more only where no two messages are alike
_RECENT = 100
_LAYOUTS = {JOINT_STATE: joint_state_layout, FLOAT64_MULTI_ARRAY: array_layout}
_UNREADABLE = -1  # instead of a layout
# columns, the last with all others
_LAYOUT, _RECEIVED, _SEQUENCE, _STAMP, _VALUES = range(5)
_MOST_NAMES = 20_000  # and fields, of a topic
_MOST_PLACES = 500_000  # in all layouts of a topic
_MOST_TEXT = 1 << 24  # bytes of a message that is kept as it is
_TWINS = 1000  # messages back, among which those that were recorded twice are found
_MOST_PUBLISHERS = 10  # of a topic, one after the other or at once
_NAN = np.float64(np.nan).view(np.int64)
_TIME = np.dtype([('s', '<i4'), ('ns', '<u4')])
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


class Values:
    """Values (N, n) of states, which are read when they are indexed.

    Where they are unknown, they are NaN, or the difference of two others if these are
    given.
    """

    def __init__(
        self,
        states: JointStates,
        field: int,
        difference: tuple[Values, Values] | None = None,
    ) -> None:
        self._states = states
        self._field = field
        self._difference = difference

    def __getitem__(self, key: Any) -> Floats:
        rows, columns = key if isinstance(key, tuple) else (key, _ALL)
        states = self._states.select(rows)
        joints = np.arange(len(states.names))[columns]
        values = np.empty((joints.size, states.size))
        for row, j in zip(
            values, states.places[self._field, joints.ravel()].tolist(), strict=True
        ):
            row[:] = states.messages.column(j, states.number).view(float)
        values = values.T if joints.ndim else values[0]
        if self._difference is not None and np.isnan(values).any():
            first, second = (each[key] for each in self._difference)
            values = np.where(np.isnan(values), first - second, values)
        return values

    def __array__(self, dtype: Any = None, copy: Any = None) -> NDArray[Any]:
        """Return all of them."""
        return self[:].astype(dtype or np.float64, copy=False)


class JointStates:
    """N states of n joints, or N vectors of n named values."""

    def __init__(
        self,
        messages: TopicMessages,
        names: Sequence[str],
        places: NDArray[np.intp],
        number: NDArray[np.int32],
    ) -> None:
        """Take messages by their `number` (N,) in the topic; -1 is an unknown one.

        Their positions, velocities and efforts are in the columns `places` (3, n), -1
        if unknown.
        """
        self.names = tuple(names)
        self.size = number.size
        self.messages = messages
        self.places = places
        self.number = number

    @property
    def received(self) -> Stamps:
        """When each was received (N,) [ns]."""
        return self.messages.column(_RECEIVED, self.number)

    @property
    def sequence(self) -> Stamps:
        """Number given by the publisher (N,); 0 if unknown."""
        return self.messages.column(_SEQUENCE, self.number)

    @property
    def stamp(self) -> Stamps:
        """Stamps (N,) [ns]."""
        return self.messages.column(
            _STAMP if self.messages.is_stamped else _RECEIVED, self.number
        )

    def field(self, k: int) -> Any:
        """Return positions (0), velocities (1) or efforts (2) as `Values` (N, n)."""
        return Values(self, k)

    def select(self, rows: Rows) -> JointStates:
        """Return the states of these rows; -1 is an unknown one."""
        chosen = self.number[rows]
        if not isinstance(rows, slice):
            chosen[rows < 0] = -1
        return JointStates(self.messages, self.names, self.places, chosen)

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
        return self.select(
            np.maximum(np.searchsorted(self.stamp, stamp, side='right') - 1, 0)
        )


class _Block(NamedTuple):
    """Messages one after the other in the file, column by column."""

    offset: int  # bytes
    size: int  # messages
    rows: Mapping[int, int]  # where each column is that the block has


class TopicMessages:
    """All messages of one topic: the numbers of known types in a file, others as bytes.

    The file has blocks of messages, with a column for each name and field of its own
    messages.

    Attributes:
        name, type: of the topic.
        size: number of messages.
        is_stamped: whether stamps are those of the messages; else the times of reception.
    """

    def __init__(self, name: str, type_name: str) -> None:
        self.name = name
        self.type = type_name
        self.size = 0
        self.is_stamped = True
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - closed below
        self._blocks: list[_Block] = []
        # with the number of the layout
        self._waiting: list[tuple[int, BagMessage]] = []
        self._layouts: list[Layout] = []
        self._columns: dict[tuple[str, str], int] = {}  # by field and name
        self._last = _UNREADABLE  # layout of the last message
        self._unreadable: dict[int, MessageError] = {}
        self._places = 0
        # received [ns], offset, size [bytes]
        self._kept: list[tuple[int, int, int]] = []
        # sequence number of each publisher, that of the last one last
        self._next: list[int] = []
        # of the last messages: sequence number and hash
        self._recent: deque[tuple[int, int]] = deque(maxlen=_TWINS)
        self._missed = self._before = 0

    def __del__(self) -> None:
        if '_file' in vars(self):  # not if Ctrl-C came while it was opened
            with suppress(OSError):  # of a full disk, which has been told
                self._file.close()

    def add(self, message: BagMessage) -> None:
        """Add a message; none may be added once a column was read."""
        if message.sequence:
            self._count(message.sequence, hash(message.raw))
        if self.type not in _LAYOUTS:
            self._keep(message)
        else:
            if self._last < 0 or not self._layouts[self._last].fits(message.raw):
                self._last = self._layout_of(message.raw)
            self._waiting.append((self._last, message))
            if len(self._waiting) == _BLOCK:
                self._flush()
        self.size += 1

    def _keep(self, message: BagMessage) -> None:
        """Keep a message as it is."""
        size = len(message.raw)
        if size > _MOST_TEXT:
            raise BagError(
                f'a message of {self.name} has {size / 1e6:.0f} MB, more than '
                f'{_MOST_TEXT / 1e6:.0f}: the bag is damaged or was not recorded from this topic'
            )
        self._kept.append((message.received, self._file.tell(), size))
        self._file.write(message.raw)

    def raw(self) -> Iterator[tuple[int, bytes]]:
        """Yield reception time [ns] and content of each message of another type."""
        self._file.flush()
        for received, offset, size in self._kept:
            yield received, os.pread(self._file.fileno(), size, offset)

    def _count(self, sequence: int, content: int) -> None:
        """Count the messages that are missing before the one with this number.

        A twin of a message has its content, too, of which `content` is the hash.
        """
        is_next = bool(self._next) and self._next[-1] == sequence
        is_twin = not is_next and (sequence, content) in self._recent
        self._recent.append((sequence, content))
        if is_next:
            self._next[-1] += 1
        elif len(self._next) <= _MOST_PUBLISHERS and not is_twin:
            expected = max(
                (number for number in self._next if number <= sequence), default=0
            )
            if expected:
                self._next.remove(expected)
                self._missed += sequence - expected
            else:  # of another publisher
                self._before += sequence - 1
            self._next.append(sequence + 1)

    @property
    def lost(self) -> str:
        """How many messages are missing, as text, by their numbers; empty if none or unknown."""
        if len(self._next) > _MOST_PUBLISHERS or not self._missed + self._before:
            return ''
        earlier = (
            f', {self._before} sent before the recorder connected'
            if self._before
            else ''
        )
        return f'{self._missed} missed{earlier}'

    def _layout_of(self, raw: bytes) -> int:
        for k in range(max(0, len(self._layouts) - _RECENT), len(self._layouts)):
            if self._layouts[k].fits(raw):
                return k
        try:
            layout = _LAYOUTS[self.type](raw)
        except MessageError as error:
            self._unreadable[self.size] = error
            return _UNREADABLE
        self._places += len(layout.places)
        names = self._columns.keys() | layout.places.keys()
        if len(names) > _MOST_NAMES or self._places > _MOST_PLACES:
            raise BagError(
                f'{self.name} has {len(names)} names and fields in {len(self._layouts) + 1} lists: '
                'these are no states of one robot'
            )
        for key in layout.places:
            self._columns.setdefault(key, _VALUES + len(self._columns))
        self._layouts.append(layout)
        return len(self._layouts) - 1

    def _flush(self) -> None:
        """Decode the messages added last, and write their block."""
        waiting = self._waiting
        self._waiting = []
        if not waiting:
            return
        used = {k for k, _ in waiting} - {_UNREADABLE}
        rows = self._rows_of(used)
        block = np.full((len(rows), len(waiting)), _NAN)
        block[_LAYOUT] = [k for k, _ in waiting]
        block[_RECEIVED] = [message.received for _, message in waiting]
        block[_SEQUENCE] = [message.sequence for _, message in waiting]
        for k in used:
            raw = [message.raw for of, message in waiting if of == k]
            where = np.flatnonzero(block[_LAYOUT] == k)
            self._decode(self._layouts[k], b''.join(raw), block, rows, where)
        self._blocks.append(_Block(self._file.tell(), len(waiting), rows))
        self._file.write(block.tobytes())
        self._file.flush()

    def _rows_of(self, layouts: Collection[int]) -> Mapping[int, int]:
        """Return the row in a block of each column of these layouts."""
        columns = set(range(_VALUES))
        for k in layouts:
            columns.update(self._columns[key] for key in self._layouts[k].places)
        rows = {column: row for row, column in enumerate(sorted(columns))}
        if self._blocks and self._blocks[-1].rows == rows:
            return self._blocks[-1].rows
        return rows

    def _decode(
        self,
        layout: Layout,
        joined: bytes,
        block: NDArray[np.int64],
        rows: Mapping[int, int],
        where: NDArray[np.intp],
    ) -> None:
        """Decode the joined messages of one layout into places (k,) of a block."""
        if self.type == JOINT_STATE:
            strides = (layout.size,)
            stamp = np.ndarray(where.shape, _TIME, joined, STAMP_OFFSET, strides)
            seconds = stamp['s'].astype(np.int64)
            block[_STAMP, where] = seconds * NANOSECONDS + stamp['ns']
        shape = (where.size, (layout.size - ORIGIN) // 8)
        values = np.ndarray(shape, '<i8', joined, ORIGIN, (layout.size, 8))
        for key, place in layout.places.items():
            block[rows[self._columns[key]], where] = values[:, place]

    def column(self, j: int, number: NDArray[np.int32]) -> NDArray[np.int64]:
        """Return a column of messages by number, NaN where it is unknown."""
        self._flush()
        found = np.full(number.size, _NAN)
        known = number >= 0
        if j < 0 or not known.any():
            return found
        first = number[known].min() // _BLOCK
        last = number.max() // _BLOCK + 1
        values = np.full((last - first, _BLOCK), _NAN)
        for row, block in zip(values, self._blocks[first:last], strict=True):
            if j in block.rows:
                at = block.offset + 8 * block.size * block.rows[j]
                os.preadv(self._file.fileno(), [row[: block.size].data], at)
        found[known] = values.ravel()[number[known] - first * _BLOCK]
        return found

    def joint_states(
        self,
        names: Sequence[str],
        required: Collection[str] = ('position', 'velocity'),
    ) -> JointStates:
        """Return the states of these names, without messages that name none of them.

        The values of a std_msgs/Float64MultiArray are efforts; their names are their
        numbers.

        Raises:
            UnreadableMessageError: a message cannot be decoded.
        """
        states, errors = self.readable_states(names, required)
        if errors:
            raise UnreadableMessageError(self.name, *min(errors.items()))
        return states

    def readable_states(
        self, names: Sequence[str], required: Collection[str]
    ) -> tuple[JointStates, dict[int, MessageError]]:
        """Return the states of these names, and why others cannot be decoded, by their numbers.

        Messages that name none of them are in neither.

        Raises:
            UnreadableMessageError: there are messages, and none can be decoded.
        """
        problems: dict[int, MessageError] = {}
        for k, layout in enumerate(self._layouts):
            try:
                layout.places_of(names, required)
            except MessageError as error:
                problems[k] = error
        last = len(self._layouts)  # of what has no layout
        is_read = np.array([k not in problems for k in range(last)] + [False])
        is_bad = np.array(
            [not _is_foreign(problems.get(k), names) for k in range(last)] + [True]
        )
        layouts = self.column(_LAYOUT, np.arange(self.size, dtype=np.int32))
        number = np.flatnonzero(is_read[layouts]).astype(np.int32)
        bad = (
            np.flatnonzero((is_bad & ~is_read)[layouts])
            if number.size
            else range(self.size)
        )
        errors = {
            k: self._unreadable.get(k) or problems[layouts[k]] for k in map(int, bad)
        }
        if errors and not number.size:
            raise UnreadableMessageError(self.name, *min(errors.items()))
        places = [
            [self._columns.get((field, name), -1) for name in names]
            for field in JOINT_STATE_FIELDS
        ]
        states = JointStates(self, names, np.array(places, np.intp), number)
        return states, errors

    def name_lists(self) -> list[tuple[str, ...]]:
        """Return the different lists of names; raise UnreadableMessageError if none."""
        if not self._layouts:
            raise UnreadableMessageError(self.name, *min(self._unreadable.items()))
        return list(dict.fromkeys(layout.names for layout in self._layouts))

    def joint_names(self) -> tuple[str, ...]:
        """Return the longest list of names; raise UnreadableMessageError if empty."""
        names = max(self.name_lists(), key=len)
        if not names:
            unnamed = MessageError(
                'it names no joint, so its values cannot be assigned to joints'
            )
            raise UnreadableMessageError(self.name, 0, unnamed)
        return names


def _is_foreign(problem: MessageError | None, names: Collection[str]) -> bool:
    return isinstance(problem, MissingJointError) and problem.is_foreign(names)
