# SPDX-License-Identifier: Apache-2.0
"""Conversion between arrays and serialised messages, in about a microsecond.

An encoder serialises a template once and then only overwrites its numbers; nodes publish these
bytes and bags store them as they are. A decoder locates the values once and keeps their positions
for as long as the messages have the same names and lengths.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Sequence
from operator import itemgetter
from struct import Struct

import numpy as np
from numpy.typing import ArrayLike, NDArray

from blf_dsc_controller.messages.cdr import (
    JOINT_STATE_FIELDS,
    NANOSECONDS,
    ORIGIN,
    STAMP_OFFSET,
    Doubles,
    Layout,
    array_layout,
    joint_state_layout,
    joint_state_places,
)
from blf_dsc_controller.messages.topics import FLOAT64_MULTI_ARRAY, JOINT_STATE
from blf_dsc_controller.messages.types import typestore
from blf_dsc_controller.run import Floats

_STAMPS = {'<': Struct('<iI'), '>': Struct('>iI')}
_STAMP = _STAMPS['<']


class JointStateEncoder:
    """Encoder of sensor_msgs/JointState with fixed names.

    Those of position, velocity, effort in `fields` hold a value for each name; others are empty.
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
            ValueError: an array has another length.
        """
        _STAMP.pack_into(self._buffer, STAMP_OFFSET, *divmod(stamp_ns, NANOSECONDS))
        self._position[:] = position
        self._velocity[:] = velocity
        self._effort[:] = effort
        return bytes(self._buffer)


class Float64MultiArrayEncoder:
    """Encoder of std_msgs/Float64MultiArray of a fixed size, without dimensions."""

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


def _view(buffer: bytearray, doubles: Doubles) -> Floats:
    return np.frombuffer(buffer, '<f8', doubles.size, doubles.offset if doubles.size else 0)


class Decoder(ABC):
    """Decoder of `values` (s,) at positions that are the same in all messages of one layout."""

    def __init__(self, size: int) -> None:
        self.values = np.full(size, np.nan)
        self._length = -1  # of the messages whose layout is known

    @abstractmethod
    def decode(self, raw: bytes) -> int:
        """Fill `values` and return the stamp or the size of a message."""

    def _is_known(self, raw: bytes) -> bool:
        return len(raw) == self._length and self._fixed_of(raw) == self._fixed

    def _learn(self, raw: bytes, layout: Layout, places: NDArray[np.intp]) -> None:
        """Store a layout.

        `places` (s,) are the values' indices in a grid of doubles from ORIGIN on, -1 for NaN.
        """
        self._length = len(raw)
        self._fixed_of = itemgetter(*layout.fixed_parts)
        self._fixed = self._fixed_of(raw)
        self._float = np.dtype(layout.byte_order + 'f8')
        self._count = (len(raw) - ORIGIN) // 8
        self._known = np.flatnonzero(places >= 0)
        self._places = places[self._known]
        self.values[:] = np.nan

    def _fill(self, raw: bytes) -> None:
        grid = np.frombuffer(raw, self._float, self._count, ORIGIN)
        self.values[self._known] = grid[self._places]


class JointStateDecoder(Decoder):
    """Decoder of sensor_msgs/JointState into arrays in the order of the n `joints`, by name.

    Other joints in the message are ignored. A field that is not `required` and is empty in the
    message reads as NaN. Values are not checked: NaN passes through.

    Attributes:
        position, velocity, effort: (n,) of the last message.
        values: (3 n,) all of these, concatenated.
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
            ShortArrayError: an array differs in length from the names.
        """
        if not self._is_known(raw):
            layout = joint_state_layout(raw)
            places = joint_state_places(layout, self._joints, self._required)
            self._learn(raw, layout, places.ravel())
            self._stamp = _STAMPS[layout.byte_order]
        self._fill(raw)
        seconds, nanoseconds = self._stamp.unpack_from(raw, STAMP_OFFSET)
        return int(seconds * NANOSECONDS + nanoseconds)


class Float64MultiArrayDecoder(Decoder):
    """Decoder of std_msgs/Float64MultiArray of an expected size; dimensions are skipped.

    Attributes:
        values: (size,) of the last message of that size.
    """

    def decode(self, raw: bytes) -> int:
        """Return the number of values in the message; fill `values` if it is the expected one.

        Raises:
            MessageError: not plain CDR, or `raw` ends too early.
        """
        if not self._is_known(raw):
            layout = array_layout(raw)
            (array,) = layout.arrays
            if array.size != self.values.size:
                return array.size
            self._learn(raw, layout, np.arange(array.size) + array.place)
        self._fill(raw)
        return self.values.size
