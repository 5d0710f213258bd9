# SPDX-License-Identifier: Apache-2.0
"""Messages of one topic of a bag: their numbers are on disk, and read when asked for."""

from __future__ import annotations

from array import array
from collections import deque
from collections.abc import Callable, Collection, Iterator, Sequence
from struct import Struct
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.bags.on_disk import OnDisk
from blf_dsc_controller.bags.sources import BagError, BagMessage
from blf_dsc_controller.messages.codecs import (
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

# layouts that a message is compared with: more only where no two messages are alike
_RECENT = 100
_LAYOUTS = {JOINT_STATE: joint_state_layout, FLOAT64_MULTI_ARRAY: array_layout}
_UNREADABLE = -1  # instead of a layout
_HEAD = Struct('<4q')  # words before each message:
_RECEIVED, _SEQUENCE, _STAMP, _LAYOUT = range(4)  # the last is the size of texts
_WORD = 8  # bytes
_TIME = Struct('<iI')
_MOST_NAMES = 20_000  # and fields, of a topic
_MOST_PLACES = 500_000  # in all layouts of a topic
_MOST_TEXT = 1 << 24  # bytes of a message that is kept as it is
_TWINS = 1000  # messages back, among which those that were recorded twice are found
_MOST_PUBLISHERS = 10  # of a topic, one after the other or at once
_NAN = int(np.float64(np.nan).view(np.int64))
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
    """Values (N, n) of states, which are read when they are indexed; NaN where unknown."""

    def __init__(self, read: Callable[[Any], Floats]) -> None:
        """Take a function that reads the values at an index."""
        self._read = read

    def __getitem__(self, key: Any) -> Floats:
        return self._read(key)

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

        Their positions, velocities and efforts are the words `places` (layouts, 3, n) in
        a message of each layout of the topic, -1 if unknown.
        """
        self.names = tuple(names)
        self.size = number.size
        self.messages = messages
        self.number = number
        self._places = places

    @property
    def received(self) -> Stamps:
        """When each was received (N,) [ns]."""
        return self.messages.words(_RECEIVED, self.number)

    @property
    def sequence(self) -> Stamps:
        """Number given by the publisher (N,); 0 if unknown."""
        return self.messages.words(_SEQUENCE, self.number)

    @property
    def stamp(self) -> Stamps:
        """Stamps (N,) [ns]."""
        word = _STAMP if self.messages.is_stamped else _RECEIVED
        return self.messages.words(word, self.number)

    def field(self, k: int) -> Values:
        """Return positions (0), velocities (1) or efforts (2) as `Values` (N, n)."""

        def read(key: Any) -> Floats:
            rows, columns = key if isinstance(key, tuple) else (key, _ALL)
            return self.select(rows).read(k, columns)

        return Values(read)

    def read(self, field: int, columns: Any = _ALL) -> Floats:
        """Return some columns of a field (N, k), or one (N,); NaN where it is unknown."""
        layouts = self.messages.words(_LAYOUT, np.maximum(self.number, 0))
        places = self._places[:, field, columns][layouts]
        words = self.messages.words(places.T, self.number)
        return np.asarray(words.view(np.float64).T)

    def select(self, rows: Rows) -> JointStates:
        """Return the states of these rows; -1 is an unknown one."""
        chosen = self.number[rows]
        if not isinstance(rows, slice):
            chosen[rows < 0] = -1
        return JointStates(self.messages, self.names, self._places, chosen)

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


class _Kind(NamedTuple):
    """Messages of one layout, and the part of them that has all numbers."""

    layout: Layout
    part: slice  # bytes

    @classmethod
    def of(cls, layout: Layout) -> _Kind:
        """Return the kind of a layout."""
        words = layout.places.values()
        begin = ORIGIN + _WORD * min(words, default=0)
        return cls(layout, slice(begin, ORIGIN + _WORD * (max(words, default=-1) + 1)))

    def places_of(
        self, names: Sequence[str], required: Collection[str]
    ) -> NDArray[np.intp]:
        """Return `Layout.places_of`, in words from the head of a message on."""
        places = self.layout.places_of(names, required)
        first = (self.part.start - ORIGIN) // _WORD
        return np.where(places < 0, -1, places - first + _HEAD.size // _WORD)


class TopicMessages:
    """All messages of one topic: numbers of the known types, others as bytes.

    Attributes:
        name, type: of the topic.
        size: number of messages.
        is_stamped: whether stamps are those of the messages; else the times of reception.
    """

    def __init__(self, name: str, type_name: str) -> None:
        self.name = name
        self.type = type_name
        self.is_stamped = True
        self._store = OnDisk()
        self._begins = array('q')  # word at which each message begins
        # words and begins, as arrays
        self._read = np.zeros(0, np.int64), np.zeros(0, np.int64)
        self._kinds: list[_Kind] = []
        self._names: set[tuple[str, str]] = set()  # and fields
        self._places = 0
        self._last = _UNREADABLE  # layout of the last message
        self._unreadable: dict[int, MessageError] = {}
        # sequence number of each publisher, that of the last one last
        self._next: list[int] = []
        # of the last messages: sequence number and hash
        self._recent: deque[tuple[int, int]] = deque(maxlen=_TWINS)
        self._missed = self._before = 0

    @property
    def size(self) -> int:
        """Number of messages."""
        return len(self._begins)

    def add(self, message: BagMessage) -> None:
        """Add a message; raise BagError if one that is kept as it is has too many bytes."""
        raw = message.raw
        if message.sequence:
            self._count(message.sequence, hash(raw))
        stamp = _NAN
        if self.type in _LAYOUTS:
            last = self._last
            if last < 0 or not self._kinds[last].layout.fits(raw):
                last = self._last = self._layout_of(raw)
            content = raw[self._kinds[last].part] if last >= 0 else b''
            if last >= 0 and self.type == JOINT_STATE:
                seconds, nanoseconds = _TIME.unpack_from(raw, STAMP_OFFSET)
                stamp = seconds * NANOSECONDS + nanoseconds
        else:
            last = len(raw)
            if last > _MOST_TEXT:
                raise BagError(
                    f'a message of {self.name} has {last / 1e6:.0f} MB, more than '
                    f'{_MOST_TEXT / 1e6:.0f}: the bag is damaged or was not recorded from this '
                    'topic'
                )
            content = raw.ljust(-(-last // _WORD) * _WORD, b'\0')
        self._begins.append(self._store.size // _WORD)
        head = _HEAD.pack(message.received, message.sequence, stamp, last)
        self._store.append(head + content)

    def raw(self) -> Iterator[tuple[int, bytes]]:
        """Yield reception time [ns] and content of each message of another type."""
        words, begins = self._arrays()
        for begin in begins.tolist():
            received, _, _, size = words[begin : begin + 4].tolist()
            content = words[begin + 4 : begin + 4 - (-size // _WORD)]
            yield received, content.tobytes()[:size]

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
        for k in range(max(0, len(self._kinds) - _RECENT), len(self._kinds)):
            if self._kinds[k].layout.fits(raw):
                return k
        try:
            layout = _LAYOUTS[self.type](raw)
        except MessageError as error:
            self._unreadable[self.size] = error
            return _UNREADABLE
        self._places += len(layout.places)
        self._names.update(layout.places)
        if len(self._names) > _MOST_NAMES or self._places > _MOST_PLACES:
            raise BagError(
                f'{self.name} has {len(self._names)} names and fields in {len(self._kinds) + 1} '
                'lists: these are no states of one robot'
            )
        self._kinds.append(_Kind.of(layout))
        return len(self._kinds) - 1

    def _arrays(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return all words that were written, and those at which messages begin."""
        if self._read[1].size != self.size:
            self._read = self._store.array('<i8'), np.array(self._begins)
        return self._read

    def words(self, place: Any, number: NDArray[np.int32]) -> NDArray[np.int64]:
        """Return the words (..., N) at places in messages by number; NaN: unknown."""
        words, begins = self._arrays()
        is_known = (number >= 0) & (np.asarray(place) >= 0)
        at = np.where(is_known, begins[number] + place, 0)
        return np.where(is_known, words[at], _NAN)

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
        places = np.full((len(self._kinds), 3, len(names)), -1)
        for k, kind in enumerate(self._kinds):
            try:
                places[k] = kind.places_of(names, required)
            except MessageError as error:
                problems[k] = error
        layouts = self.words(_LAYOUT, np.arange(self.size, dtype=np.int32))
        is_read = ~np.isin(layouts, [*problems, _UNREADABLE])
        number = np.flatnonzero(is_read).astype(np.int32)
        foreign = [
            k
            for k, each in problems.items()
            if isinstance(each, MissingJointError) and each.is_foreign(names)
        ]
        is_bad = ~is_read & ~np.isin(layouts, foreign if number.size else [])
        errors = {
            k: self._unreadable.get(k) or problems[layouts[k]]
            for k in np.flatnonzero(is_bad).tolist()
        }
        if errors and not number.size:
            raise UnreadableMessageError(self.name, *min(errors.items()))
        return JointStates(self, names, places, number), errors

    def name_lists(self) -> list[tuple[str, ...]]:
        """Return the different lists of names; raise UnreadableMessageError if none."""
        if not self._kinds:
            raise UnreadableMessageError(self.name, *min(self._unreadable.items()))
        return list(dict.fromkeys(kind.layout.names for kind in self._kinds))

    def joint_names(self) -> tuple[str, ...]:
        """Return the longest list of names; raise UnreadableMessageError if empty."""
        names = max(self.name_lists(), key=len)
        if not names:
            unnamed = MessageError(
                'it names no joint, so its values cannot be assigned to joints'
            )
            raise UnreadableMessageError(self.name, 0, unnamed)
        return names
