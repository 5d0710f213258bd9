# SPDX-License-Identifier: Apache-2.0
"""Arrays to serialised messages and back, in about a microsecond.

An encoder serialises a template once and then only overwrites its numbers; nodes publish these
bytes and bags store them as they are. A decoder finds the places of the values once and keeps them
for as long as the messages have the same names and lengths.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from operator import itemgetter
from struct import Struct, pack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from blf_dsc_controller.messages.cdr import (
    NANOSECONDS,
    ORIGIN,
    STAMP_OFFSET,
    Doubles,
    DuplicatedJointError,
    Layout,
    MissingJointError,
    ShortArrayError,
    array_layout,
    joint_state_layout,
)
from blf_dsc_controller.messages.topics import FLOAT64_MULTI_ARRAY, JOINT_STATE
from blf_dsc_controller.messages.types import typestore
from blf_dsc_controller.run import Floats, Stamps

JOINT_STATE_FIELDS = ('position', 'velocity', 'effort')
_STAMPS = {'<': Struct('<iI'), '>': Struct('>iI')}
_STAMP = _STAMPS['<']
_FEWEST = 8  # messages, below which one after the other is as fast

# A message is decoded in a buffer behind 12 bytes, so that its doubles lie on a grid of float64.
# The first value of the grid is the NaN of empty fields, the third the message's fifth byte.
_MARGIN = 12


class JointStateEncoder:
    """Encodes sensor_msgs/JointState with fixed names.

    `fields` of position, velocity, effort hold a value for each name; the others stay empty.
    """

    def __init__(
        self,
        names: Sequence[str],
        fields: Collection[str] = JOINT_STATE_FIELDS,
        frame_id: str = '',
    ) -> None:
        types = typestore().types
        stamp = types['builtin_interfaces/msg/Time'](sec=0, nanosec=0)
        header = types['std_msgs/msg/Header'](stamp=stamp, frame_id=frame_id)
        arrays = [np.zeros(len(names) * (field in fields)) for field in JOINT_STATE_FIELDS]
        message = types[JOINT_STATE](header, list(names), *arrays)
        self._buffer = bytearray(typestore().serialize_cdr(message, JOINT_STATE))
        self._position, self._velocity, self._effort = (
            _view(self._buffer, array) for array in joint_state_layout(self._buffer).arrays
        )

    def encode(
        self,
        stamp_ns: int,
        position: ArrayLike = (),
        velocity: ArrayLike = (),
        effort: ArrayLike = (),
    ) -> bytes:
        """Return the serialised message of a header stamp [ns] and n values for each of `fields`.

        Raises:
            ValueError: an array of another length.
        """
        _STAMP.pack_into(self._buffer, STAMP_OFFSET, *divmod(stamp_ns, NANOSECONDS))
        self._position[:] = position
        self._velocity[:] = velocity
        self._effort[:] = effort
        return bytes(self._buffer)


class Float64MultiArrayEncoder:
    """Encodes std_msgs/Float64MultiArray of a fixed size, without dimensions."""

    def __init__(self, size: int) -> None:
        types = typestore().types
        layout = types['std_msgs/msg/MultiArrayLayout'](dim=[], data_offset=0)
        message = types[FLOAT64_MULTI_ARRAY](layout=layout, data=np.zeros(size))
        self._buffer = bytearray(typestore().serialize_cdr(message, FLOAT64_MULTI_ARRAY))
        self._data = _view(self._buffer, array_layout(self._buffer).arrays[0])

    def encode(self, data: ArrayLike) -> bytes:
        """Return the serialised message of `data` (size,); ValueError for another length."""
        self._data[:] = data
        return bytes(self._buffer)


def encode_clock(stamp_ns: int) -> bytes:
    """Return a serialised rosgraph_msgs/Clock of the time `stamp_ns` [ns]."""
    return b'\x00\x01\x00\x00' + _STAMP.pack(*divmod(stamp_ns, NANOSECONDS))


def _view(buffer: bytearray, doubles: Doubles) -> NDArray[np.float64]:
    return np.frombuffer(buffer, '<f8', doubles.size, doubles.offset if doubles.size else 0)


class _Decoder:
    """Takes values off the places where they are in all messages of one layout."""

    def __init__(self, size: int) -> None:
        self.values = np.full(size, np.nan)
        self._length = -1  # of the messages whose layout is known

    def _learn(self, raw: bytes, layout: Layout, index: NDArray[np.intp], names_at: int) -> None:
        """Know the layout of a message from here on; `index` of the values in the grid."""
        sizes = [array.size_offset for array in layout.arrays]
        self._extents = [(0, 2), (names_at, sizes[0] + 4), *((at, at + 4) for at in sizes[1:])]
        self._parts = itemgetter(*(slice(*extent) for extent in self._extents))
        self._fixed = self._parts(raw)
        self._index = index
        self._order = layout.byte_order
        self._buffer = bytearray(_MARGIN + len(raw))
        self._grid = np.frombuffer(self._buffer, self._order + 'f8', len(self._buffer) // 8)
        self._grid[0] = np.nan
        self._length = len(raw)

    def _grid_of(self, raw: Sequence[bytes]) -> Floats | None:
        """Grid of each of N messages (N, :); None if one does not have the known layout."""
        count, row = len(raw), -(-(_MARGIN + self._length) // 8)
        if count < _FEWEST or set(map(len, raw)) != {self._length}:
            return None
        rest = 8 * row - _MARGIN - self._length
        margin = bytes(rest) + pack(self._order + 'd4x', np.nan)
        joined = margin.join([b'', *raw, b''])
        table = np.frombuffer(joined, np.uint8, count * 8 * row, rest).reshape(count, -1)
        for (start, end), fixed in zip(self._extents, self._fixed, strict=True):
            part = table[:, _MARGIN + start : _MARGIN + end]
            if (part != np.frombuffer(fixed, np.uint8)).any():
                return None
        return np.frombuffer(joined, self._order + 'f8', count * row, rest).reshape(count, -1)


class JointStateDecoder(_Decoder):
    """Decodes sensor_msgs/JointState into arrays in the order of the n `joints`, by name.

    Other joints in the message are ignored. A field that is not `required` and is empty in the
    message reads as NaN. Values are not checked: NaN passes through.

    Attributes:
        position, velocity, effort: (n,) of the last message.
        values: (3 n,) all of these in turn.
    """

    def __init__(
        self, joints: Sequence[str], required: Collection[str] = ('position', 'velocity')
    ) -> None:
        super().__init__(3 * len(joints))
        self._joints = tuple(joints)
        self._required = frozenset(required)
        self.position, self.velocity, self.effort = self.values.reshape(3, -1)

    def decode(self, raw: bytes) -> int:
        """Fill the arrays from a serialised message and return its stamp [ns].

        Raises:
            MessageError: not plain CDR, or `raw` ends too early.
            MissingJointError: one of `joints` is not named.
            DuplicatedJointError: one of `joints` is named twice.
            ShortArrayError: an array is not as long as the names.
        """
        if len(raw) != self._length or self._parts(raw) != self._fixed:
            layout = joint_state_layout(raw)
            self._learn(raw, layout, self._index_in(layout), STAMP_OFFSET + 8)
            self._stamp = _STAMPS[layout.byte_order]
        self._buffer[_MARGIN:] = raw
        self._grid.take(self._index, out=self.values, mode='clip')
        seconds, nanoseconds = self._stamp.unpack_from(raw, STAMP_OFFSET)
        return int(seconds * NANOSECONDS + nanoseconds)

    def decode_all(self, raw: Sequence[bytes]) -> tuple[Stamps, Floats] | None:
        """Stamps (N,) [ns] and values (N, 3 n); None if the layout of the last message changes."""
        grid = self._grid_of(raw)
        if grid is None:
            return None
        kinds = [('seconds', self._order + 'i4'), ('nanoseconds', self._order + 'u4')]
        stamp = np.ascontiguousarray(grid[:, 2]).view(kinds)
        nanoseconds = stamp['seconds'].astype(np.int64) * NANOSECONDS + stamp['nanoseconds']
        return nanoseconds, grid.take(self._index, axis=1).astype(np.float64)

    def _index_in(self, layout: Layout) -> NDArray[np.intp]:
        columns = np.array(columns_of(self._joints, layout.names), dtype=np.intp)
        index = np.zeros((3, columns.size), dtype=np.intp)
        for row, field, array in zip(index, JOINT_STATE_FIELDS, layout.arrays, strict=True):
            if array.size == 0 and field not in self._required:
                continue
            if array.size != len(layout.names):
                raise ShortArrayError(
                    f'`{field}` of the message holds {array.size} values for {len(layout.names)} '
                    'names: publish one value for each name'
                )
            row[:] = columns + _place(array)
        return index.reshape(-1)


class Float64MultiArrayDecoder(_Decoder):
    """Decodes std_msgs/Float64MultiArray of an expected size; dimensions are skipped.

    Attributes:
        values: (size,) of the last message of that size.
    """

    def decode(self, raw: bytes) -> int:
        """Return the number of values in the message; fill `values` if it is the expected one.

        Raises:
            MessageError: not plain CDR, or `raw` ends too early.
        """
        if len(raw) != self._length or self._parts(raw) != self._fixed:
            layout = array_layout(raw)
            (array,) = layout.arrays
            if array.size != self.values.size:
                return array.size
            self._learn(raw, layout, np.arange(array.size) + _place(array), ORIGIN)
        self._buffer[_MARGIN:] = raw
        self._grid.take(self._index, out=self.values, mode='clip')
        return self.values.size

    def decode_all(self, raw: Sequence[bytes]) -> Floats | None:
        """Values (N, size) of N messages; None if the layout of the last message changes."""
        grid = self._grid_of(raw)
        return None if grid is None else grid.take(self._index, axis=1).astype(np.float64)


def _place(array: Doubles) -> int:
    """Index of the first value in the grid."""
    return (_MARGIN + array.offset) // 8


def columns_of(joints: Sequence[str], names: tuple[str, ...]) -> list[int]:
    """Place of each joint among `names`.

    Raises:
        MissingJointError: a joint is not among them.
        DuplicatedJointError: a joint is there twice.
    """
    for joint in joints:
        if joint not in names:
            raise MissingJointError(joint, names)
        if names.count(joint) > 1:
            raise DuplicatedJointError(
                f'joint {joint!r} appears {names.count(joint)} times in the message '
                f'({", ".join(names)}): name each joint once'
            )
    return [names.index(joint) for joint in joints]
