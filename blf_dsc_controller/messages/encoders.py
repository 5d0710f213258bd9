# SPDX-License-Identifier: Apache-2.0
"""Messages to bytes: a template is serialised once, then only its numbers are overwritten.

A node publishes these bytes and a bag stores them as they are, so that a message costs about a
microsecond and is the same in both.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from struct import Struct

import numpy as np
from numpy.typing import ArrayLike, NDArray

from blf_dsc_controller.messages.cdr import (
    NANOSECONDS,
    STAMP_OFFSET,
    ArrayLayout,
    Doubles,
    JointStateLayout,
)
from blf_dsc_controller.messages.topics import FLOAT64_MULTI_ARRAY, JOINT_STATE
from blf_dsc_controller.messages.types import typestore

JOINT_STATE_FIELDS = ('position', 'velocity', 'effort')
_STAMP = Struct('<iI')


class JointStateEncoder:
    """Encodes sensor_msgs/JointState with fixed names.

    Args:
        names: n names.
        fields: which of position, velocity, effort hold n values; the others stay empty.
        frame_id: of the header.
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
            _view(self._buffer, array) for array in JointStateLayout.parse(self._buffer).arrays
        )

    def encode(
        self,
        stamp_ns: int,
        position: ArrayLike = (),
        velocity: ArrayLike = (),
        effort: ArrayLike = (),
    ) -> bytes:
        """Return the serialised message.

        Args:
            stamp_ns: header stamp [ns].
            position: (n,) values, or () if the field is not among `fields`.
            velocity: (n,) likewise.
            effort: (n,) likewise.

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
        self._data = _view(self._buffer, ArrayLayout.parse(self._buffer).data)

    def encode(self, data: ArrayLike) -> bytes:
        """Return the serialised message of `data` (size,); ValueError for another length."""
        self._data[:] = data
        return bytes(self._buffer)


def encode_clock(stamp_ns: int) -> bytes:
    """Return a serialised rosgraph_msgs/Clock of the time `stamp_ns` [ns]."""
    return b'\x00\x01\x00\x00' + _STAMP.pack(*divmod(stamp_ns, NANOSECONDS))


def _view(buffer: bytearray, doubles: Doubles) -> NDArray[np.float64]:
    return np.frombuffer(buffer, '<f8', doubles.size, doubles.offset if doubles.size else 0)
