# SPDX-License-Identifier: Apache-2.0
"""Positions of the values in a serialised message.

Plain CDR, version 1, as ROS 2 sends it: two bytes for the byte order, two unused, then the fields,
each number aligned to its own size, from the fifth byte on. Padding bytes, and bytes after the
last field, may hold anything.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from struct import unpack_from
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.errors import BlfDscError

NANOSECONDS = 1_000_000_000
"""Per second."""

ORIGIN = 4  # alignment is counted from here
STAMP_OFFSET = 4  # of a message that starts with a std_msgs/Header
JOINT_STATE_FIELDS = ('position', 'velocity', 'effort')
_BYTE_ORDERS = {b'\x00\x00': '>', b'\x00\x01': '<'}


class MessageError(BlfDscError):
    """A serialised message that cannot be used."""


class MissingJointError(MessageError):
    """An expected joint is not among the names of the message."""

    def __init__(self, joint: str, names: tuple[str, ...]) -> None:
        self.joint = joint
        self.names = names
        self.fact = (
            f'joint {joint!r} is not in the message, which names {", ".join(names) or "none"}'
        )
        super().__init__(
            f'{self.fact}: set the parameter `joints` to names from this list, or publish the joint'
        )

    def is_foreign(self, joints: Collection[str]) -> bool:
        """Return whether the message is for other joints only: drivers may share a topic."""
        return bool(self.names) and not set(joints) & set(self.names)


class DuplicatedJointError(MessageError):
    """An expected joint is named more than once."""


class ShortArrayError(MessageError):
    """An array of the message does not hold one value for each name."""


class Doubles(NamedTuple):
    """A sequence of float64: offset of its uint32 length, of its first value, and the length."""

    size_offset: int
    offset: int
    size: int

    @property
    def place(self) -> int:
        """Index of the first value in a grid of doubles that starts at ORIGIN."""
        return (self.offset - ORIGIN) // 8


class Layout(NamedTuple):
    """Byte order of a message, names in it, and positions of its arrays."""

    byte_order: str
    begin: int  # offset of what follows the stamp
    names: tuple[str, ...]
    arrays: tuple[Doubles, ...]

    @property
    def fixed_parts(self) -> tuple[slice, ...]:
        """Bytes that are the same in all messages of this layout: byte order, names, sizes."""
        first, *others = (array.size_offset for array in self.arrays)
        return slice(2), slice(self.begin, first + 4), *(slice(at, at + 4) for at in others)

    def columns_of(self, joints: Sequence[str]) -> list[int]:
        """Return the index of each joint among the names.

        Raises:
            MissingJointError: a joint is not among them.
            DuplicatedJointError: a joint appears more than once.
        """
        for joint in joints:
            count = self.names.count(joint)
            if count == 0:
                raise MissingJointError(joint, self.names)
            if count > 1:
                raise DuplicatedJointError(
                    f'joint {joint!r} appears {count} times in the message '
                    f'({", ".join(self.names)}): name each joint once'
                )
        return [self.names.index(joint) for joint in joints]


def joint_state_layout(raw: bytes | bytearray) -> Layout:
    """Find position, velocity and effort of a sensor_msgs/JointState.

    Raises:
        MessageError: `raw` is not plain CDR, or is cut off.
    """
    cursor = _Cursor(raw)
    cursor.unsigned()
    cursor.unsigned()
    cursor.text()
    names = tuple(cursor.text() for _ in range(cursor.unsigned()))
    return Layout(
        cursor.byte_order, STAMP_OFFSET + 8, names, tuple(cursor.doubles() for _ in range(3))
    )


def joint_state_stamp(raw: bytes) -> int:
    """Return the stamp of a message that starts with a header [ns]; MessageError as above."""
    return _Cursor(raw).time()


def array_layout(raw: bytes | bytearray) -> Layout:
    """Find the values of a std_msgs/Float64MultiArray after its dimensions; errors as above."""
    cursor = _Cursor(raw)
    for _ in range(cursor.unsigned()):
        cursor.text()
        cursor.unsigned()
        cursor.unsigned()
    cursor.unsigned()
    return Layout(cursor.byte_order, ORIGIN, (), (cursor.doubles(),))


def joint_state_places(
    layout: Layout, joints: Sequence[str], required: Collection[str]
) -> NDArray[np.intp]:
    """Return where position, velocity and effort of n `joints` are, (3, n) in a grid of doubles.

    A field that is not `required` and is empty has -1.

    Raises:
        MissingJointError, DuplicatedJointError: as in `columns_of`.
        ShortArrayError: an array differs in length from the names.
    """
    columns = np.array(layout.columns_of(joints), dtype=np.intp)
    places = np.full((3, columns.size), -1)
    for row, field, array in zip(places, JOINT_STATE_FIELDS, layout.arrays, strict=True):
        if array.size == 0 and field not in required:
            continue
        if array.size != len(layout.names):
            raise ShortArrayError(
                f'`{field}` of the message holds {array.size} values for {len(layout.names)} '
                'names: publish one value for each name'
            )
        row[:] = columns + array.place
    return places


class TrajectoryContent(NamedTuple):
    """Content of a trajectory_msgs/JointTrajectory."""

    stamp: int  # ns
    names: tuple[str, ...]
    points: tuple[tuple[int, list[tuple[float, ...]]], ...]  # ns from the start, the four arrays


def joint_trajectory(raw: bytes) -> TrajectoryContent:
    """Read a trajectory_msgs/JointTrajectory; MessageError as above.

    Decoding by rclpy would block all other threads, for 10 ms with a thousand points.
    """
    cursor = _Cursor(raw)
    stamp = cursor.time()
    cursor.text()
    names = tuple(cursor.text() for _ in range(cursor.unsigned()))
    points = []
    for _ in range(cursor.unsigned()):
        arrays = [cursor.values() for _ in range(4)]
        points.append((cursor.time(), arrays))
    return TrajectoryContent(stamp, names, tuple(points))


class _Cursor:
    """Cursor over the fields of one serialised message."""

    def __init__(self, raw: bytes | bytearray) -> None:
        self._raw = raw
        self._offset = 0
        self._take(ORIGIN)
        encapsulation = bytes(raw[:2])
        if encapsulation not in _BYTE_ORDERS:
            raise MessageError(
                f'message starts with the bytes {encapsulation.hex(" ")}, not with 00 00 or 00 01: '
                'it is not plain CDR; publish it with a ROS 2 middleware in its default encoding'
            )
        self.byte_order = _BYTE_ORDERS[encapsulation]

    def unsigned(self) -> int:
        self._align(4)
        return int(unpack_from(self.byte_order + 'I', self._raw, self._take(4))[0])

    def time(self) -> int:
        self._align(4)
        seconds, nanoseconds = unpack_from(self.byte_order + 'iI', self._raw, self._take(8))
        return int(seconds * NANOSECONDS + nanoseconds)

    def text(self) -> str:
        length = self.unsigned()
        start = self._take(length)
        return self._raw[start : start + length].rstrip(b'\0').decode(errors='replace')

    def doubles(self) -> Doubles:
        size = self.unsigned()
        size_offset = self._offset - 4
        if size:
            self._align(8)
        return Doubles(size_offset, self._take(8 * size), size)

    def values(self) -> tuple[float, ...]:
        array = self.doubles()
        return unpack_from(f'{self.byte_order}{array.size}d', self._raw, array.offset)

    def _align(self, size: int) -> None:
        self._offset += -(self._offset - ORIGIN) % size

    def _take(self, size: int) -> int:
        start = self._offset
        self._offset += size
        if self._offset > len(self._raw):
            raise MessageError(
                f'message of {len(self._raw)} bytes is cut off: '
                f'its contents need at least {self._offset} bytes'
            )
        return start
