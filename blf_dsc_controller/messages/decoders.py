# SPDX-License-Identifier: Apache-2.0
"""Bytes to arrays, joints matched by name.

The places of the values are found once and kept for as long as the messages have the same names
and lengths: a comparison of bytes instead of a parse.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from struct import Struct

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.messages.cdr import (
    NANOSECONDS,
    ORIGIN,
    STAMP_OFFSET,
    ArrayLayout,
    JointStateLayout,
)
from blf_dsc_controller.messages.encoders import JOINT_STATE_FIELDS
from blf_dsc_controller.messages.errors import (
    DuplicatedJointError,
    MissingJointError,
    ShortArrayError,
)

_STAMPS = {'<': Struct('<iI'), '>': Struct('>iI')}
_NAMES_START = STAMP_OFFSET + 8
_NO_DIMENSIONS = Struct('<3I')
_USUAL_START = 20


class JointStateDecoder:
    """Decodes sensor_msgs/JointState into arrays in the order of `joints`.

    Other joints in the message are ignored. A field that is not required and is empty in the
    message reads as NaN. Values are not checked: NaN passes through.

    Args:
        joints: names of the n joints to read.
        required: fields that must hold a value for each name of the message.

    Attributes:
        position: (n,) of the last message.
        velocity: (n,) of the last message.
        effort: (n,) of the last message.
        values: (3 n,) all of these in turn.
    """

    def __init__(
        self, joints: Sequence[str], required: Collection[str] = ('position', 'velocity')
    ) -> None:
        self._joints = tuple(joints)
        self._required = frozenset(required)
        self.values = np.full(3 * len(self._joints), np.nan)
        self.position, self.velocity, self.effort = self.values.reshape(3, -1)
        self._length = -1

    def decode(self, raw: bytes) -> int:
        """Fill the arrays from a serialised message and return its stamp [ns].

        Raises:
            MessageError: not plain CDR, or `raw` ends too early.
            MissingJointError: one of `joints` is not named.
            DuplicatedJointError: one of `joints` is named twice.
            ShortArrayError: an array is not as long as the names.
        """
        if not (
            len(raw) == self._length
            and raw[:2] == self._encapsulation
            and raw[_NAMES_START : self._names_end] == self._names
            and raw[self._velocity_at : self._velocity_at + 4] == self._velocity_size
            and raw[self._effort_at : self._effort_at + 4] == self._effort_size
        ):
            self._parse(raw)
        self._buffer[12:] = raw
        self._grid.take(self._index, out=self.values, mode='clip')
        seconds, nanoseconds = self._stamp.unpack_from(raw, STAMP_OFFSET)
        return int(seconds * NANOSECONDS + nanoseconds)

    def _parse(self, raw: bytes) -> None:
        layout = JointStateLayout.parse(raw)
        position, velocity, effort = layout.arrays
        # The message lies in the buffer such that its doubles stand on the float64 grid, of which
        # the first value is the NaN of the empty fields and the third the message's fifth byte.
        self._index = self._grid_index(layout)
        self._buffer = bytearray(12 + len(raw))
        self._grid = np.frombuffer(self._buffer, layout.byte_order + 'f8', len(self._buffer) // 8)
        self._grid[0] = np.nan
        self._stamp = _STAMPS[layout.byte_order]
        self._encapsulation = raw[:2]
        self._names_end = position.size_offset + 4
        self._names = raw[_NAMES_START : self._names_end]
        self._velocity_at = velocity.size_offset
        self._velocity_size = raw[self._velocity_at : self._velocity_at + 4]
        self._effort_at = effort.size_offset
        self._effort_size = raw[self._effort_at : self._effort_at + 4]
        self._length = len(raw)

    def _grid_index(self, layout: JointStateLayout) -> NDArray[np.intp]:
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
            row[:] = columns + 2 + (array.offset - ORIGIN) // 8
        return index.reshape(-1)


class Float64MultiArrayDecoder:
    """Decodes std_msgs/Float64MultiArray of an expected size; dimensions are skipped.

    Attributes:
        data: (size,) values of the last message of that size.
    """

    def __init__(self, size: int) -> None:
        self.data = np.full(size, np.nan)
        self._usual_end = _USUAL_START + 8 * size
        self._usual_head = _NO_DIMENSIONS.pack(0, 0, size)

    def decode(self, raw: bytes) -> int:
        """Return the number of values in the message; fill `data` if it is the expected one.

        Raises:
            MessageError: not plain CDR, or `raw` ends too early.
        """
        if raw[4:16] == self._usual_head and raw[:2] == b'\0\1' and len(raw) >= self._usual_end:
            self.data[:] = np.frombuffer(raw, '<f8', self.data.size, _USUAL_START)
            return self.data.size
        order, (_, offset, size) = ArrayLayout.parse(raw)
        if size == self.data.size:
            self.data[:] = np.frombuffer(raw, order + 'f8', size, offset if size else 0)
        return size


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
