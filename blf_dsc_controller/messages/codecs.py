# SPDX-License-Identifier: Apache-2.0
"""Definitions of messages, and those of the control loop to bytes and back, in a microsecond.

Plain CDR, version 1, little-endian, as ROS 2 sends it on all processors that it
supports: two bytes that say so, two unused, then the fields, each number aligned to its
own size, from the fifth byte on. Padding bytes, and bytes after the last field, may
hold anything. An encoder serialises a template once and then only overwrites its
numbers. A decoder finds the values once and keeps their places for as long as the
messages have the same names and lengths, which a kernel compares as it reads them.
Messages of all other types are left to the library rosbags.
"""

from __future__ import annotations

import functools
from collections.abc import Collection, Mapping, Sequence
from operator import itemgetter
from struct import Struct, unpack_from
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from blf_dsc_controller.compiled.jit import direct, kernel
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.errors import (
    DuplicatedJointError,
    MessageError,
    MissingJointError,
    ShortArrayError,
)
from blf_dsc_controller.messages.topics import (
    FLOAT64_MULTI_ARRAY,
    JOINT_STATE,
    WRENCH,
)
from blf_dsc_controller.run import Floats

NANOSECONDS = 1_000_000_000
"""Per second."""

ORIGIN = 4  # alignment is counted from here
STAMP_OFFSET = 4  # of a message that starts with a std_msgs/Header
JOINT_STATE_FIELDS = ('position', 'velocity', 'effort')
_LITTLE_ENDIAN = b'\x00\x01'
_STAMP = Struct('<iI')


class UnknownTypeError(BlfDscError):
    """A message type without a known definition."""

    def __init__(self, type_name: str) -> None:
        super().__init__(
            f'unknown message type {type_name!r}: its definition is needed to record it'
        )


class Definition(NamedTuple):
    """Definition of a message type, empty where it is unknown."""

    text: str  # with those of all nested types
    hash: str  # RIHS01_...
    encoding: str = 'ros2msg'


@functools.cache
def typestore() -> Typestore:
    """Return the types of Jazzy's common interfaces; further types can be registered there."""
    return get_typestore(Stores.ROS2_JAZZY)


def definition(type_name: str) -> Definition:
    """Return the definition of a message type; UnknownTypeError if it is not in the store."""
    if type_name not in typestore().fielddefs:
        raise UnknownTypeError(type_name)
    text, _md5 = typestore().generate_msgdef(type_name, ros_version=2)
    return Definition(text, typestore().hash_rihs01(type_name))


class Doubles(NamedTuple):
    """A sequence of float64: offset of its uint32 length, of its first value, and the length."""

    size_offset: int
    offset: int
    size: int


class Layout:
    """What is the same in all messages of one sender: size, names, array sizes.

    Attributes:
        names: in the message; numbers as text if it has none.
        arrays: where its arrays are, by field.
        places: index of each value in a grid of doubles that starts at ORIGIN, by field
            and name.
        size: of the message [bytes].
        fixed: bytes that are no numbers.
    """

    def __init__(
        self,
        raw: bytes | bytearray,
        begin: int,
        names: tuple[str, ...],
        arrays: Mapping[str, Doubles],
    ) -> None:
        """Take a message of which the bytes from `begin` to its first values are not numbers."""
        self.names, self.arrays = names, arrays
        self.size = len(raw)
        self.places = {
            (field, name): (array.offset - ORIGIN) // 8 + i
            for field, array in arrays.items()
            if array.size == len(names)
            for i, name in enumerate(names)
        }
        first, *others = (array.size_offset for array in arrays.values())
        sizes = (slice(at, at + 4) for at in others)
        self.fixed = slice(2), slice(begin, first + 4), *sizes
        self._parts_of = itemgetter(*self.fixed)
        self._parts = self._parts_of(raw)

    def fits(self, raw: bytes) -> bool:
        """Return whether a message has this layout."""
        return len(raw) == self.size and self._parts_of(raw) == self._parts

    def places_of(
        self, joints: Sequence[str], required: Collection[str]
    ) -> NDArray[np.intp]:
        """Return the places of position, velocity and effort of n `joints` (3, n); -1: empty.

        Raises:
            MissingJointError, DuplicatedJointError: a joint is not named, or more than
                once.
            ShortArrayError: an array differs in length from the names, or is empty but
                `required`.
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
        for field, array in self.arrays.items():
            if array.size != len(self.names) and (array.size or field in required):
                raise ShortArrayError(
                    f'`{field}` of the message holds {array.size} values for {len(self.names)} '
                    'names: publish one value for each name'
                )
        fields = [
            [self.places.get((field, joint), -1) for joint in joints]
            for field in JOINT_STATE_FIELDS
        ]
        return np.array(fields, np.intp)


class _Cursor:
    """Cursor over the fields of one serialised message."""

    def __init__(self, raw: bytes | bytearray) -> None:
        self._raw, self._offset = raw, 0
        self._take(ORIGIN)
        encapsulation = bytes(raw[:2])
        if encapsulation != _LITTLE_ENDIAN:
            raise MessageError(
                f'message starts with the bytes {encapsulation.hex(" ")}, not with 00 01: it is '
                'not plain CDR, little-endian; publish it with a ROS 2 middleware in its default '
                'encoding'
            )

    def unsigned(self) -> int:
        self._align(4)
        return int(unpack_from('<I', self._raw, self._take(4))[0])

    def time(self) -> int:
        self._align(4)
        seconds, nanoseconds = _STAMP.unpack_from(self._raw, self._take(8))
        return int(seconds * NANOSECONDS + nanoseconds)

    def text(self) -> str:
        length = self.unsigned()
        start = self._take(length)
        return self._raw[start : start + length].rstrip(b'\0').decode(errors='replace')

    def texts(self) -> tuple[str, ...]:
        return tuple(self.text() for _ in range(self.unsigned()))

    def doubles(self) -> Doubles:
        size = self.unsigned()
        size_offset = self._offset - 4
        if size:
            self._align(8)
        return Doubles(size_offset, self._take(8 * size), size)

    def values(self) -> tuple[float, ...]:
        array = self.doubles()
        return unpack_from(f'<{array.size}d', self._raw, array.offset)

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


def joint_state_layout(raw: bytes | bytearray) -> Layout:
    """Find position, velocity and effort of a sensor_msgs/JointState.

    Raises:
        MessageError: `raw` is not plain CDR, or is cut off.
    """
    cursor = _Cursor(raw)
    cursor.time()
    cursor.text()
    names = cursor.texts()
    arrays = {field: cursor.doubles() for field in JOINT_STATE_FIELDS}
    return Layout(raw, STAMP_OFFSET + _STAMP.size, names, arrays)


def joint_state_stamp(raw: bytes) -> int:
    """Return the stamp of a message that starts with a header [ns]; MessageError as above."""
    return _Cursor(raw).time()


def array_layout(raw: bytes | bytearray) -> Layout:
    """Find the values of a std_msgs/Float64MultiArray, as efforts; errors as above."""
    cursor = _Cursor(raw)
    for _ in range(cursor.unsigned()):
        cursor.text()
        cursor.unsigned()
        cursor.unsigned()
    cursor.unsigned()
    values = cursor.doubles()
    return Layout(raw, ORIGIN, tuple(map(str, range(values.size))), {'effort': values})


class TrajectoryContent(NamedTuple):
    """Content of a trajectory_msgs/JointTrajectory."""

    stamp: int  # ns
    names: tuple[str, ...]
    # ns from the start, the four arrays
    points: tuple[tuple[int, list[tuple[float, ...]]], ...]


def joint_trajectory(raw: bytes) -> TrajectoryContent:
    """Read a trajectory_msgs/JointTrajectory; MessageError as above.

    Decoding by rclpy would block all other threads, for 10 ms with a thousand points,
    and rosbags rejects the bytes that rclpy may add at the end.
    """
    cursor = _Cursor(raw)
    stamp = cursor.time()
    cursor.text()
    names, points = cursor.texts(), []
    for _ in range(cursor.unsigned()):
        arrays = [cursor.values() for _ in range(4)]
        points.append((cursor.time(), arrays))
    return TrajectoryContent(stamp, names, tuple(points))


class JointStateEncoder:
    """Encoder of sensor_msgs/JointState with fixed names.

    Those of position, velocity, effort in `fields` hold a value for each name; others
    are empty.
    """

    def __init__(
        self, names: Sequence[str], fields: Collection[str] = JOINT_STATE_FIELDS
    ) -> None:
        types = typestore().types
        stamp = types['builtin_interfaces/msg/Time'](sec=0, nanosec=0)
        header = types['std_msgs/msg/Header'](stamp=stamp, frame_id='')
        arrays = [
            np.zeros(len(names) * (field in fields)) for field in JOINT_STATE_FIELDS
        ]
        message = types[JOINT_STATE](header, list(names), *arrays)
        self._buffer = bytearray(typestore().serialize_cdr(message, JOINT_STATE))
        self._position, self._velocity, self._effort = (
            _view(self._buffer, each)
            for each in joint_state_layout(self._buffer).arrays.values()
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
    """Encoder of std_msgs/Float64MultiArray of a fixed size.

    Without a `label` it has no dimensions; with one, its only dimension carries it.
    """

    def __init__(self, size: int, label: str = '') -> None:
        types = typestore().types
        dimension = types['std_msgs/msg/MultiArrayDimension'](label, size, size)
        dimensions = [dimension] if label else []
        layout = types['std_msgs/msg/MultiArrayLayout'](dim=dimensions, data_offset=0)
        message = types[FLOAT64_MULTI_ARRAY](layout=layout, data=np.zeros(size))
        self._buffer = bytearray(
            typestore().serialize_cdr(message, FLOAT64_MULTI_ARRAY)
        )
        doubles = array_layout(self._buffer).arrays['effort']
        self._data = _view(self._buffer, doubles)
        self._head = bytes(self._buffer[: doubles.offset])

    def encode(self, data: ArrayLike) -> bytes:
        """Return the serialised message of `data` (size,); ValueError for another length."""
        self._data[:] = data
        return bytes(self._buffer)

    def has_layout(self, raw: bytes) -> bool:
        """Whether a serialised message has the size and the label of this encoder."""
        return raw.startswith(self._head)


class WrenchEncoder:
    """Encoder of geometry_msgs/WrenchStamped in a fixed frame."""

    def __init__(self, frame: str) -> None:
        types = typestore().types
        stamp = types['builtin_interfaces/msg/Time'](sec=0, nanosec=0)
        vector = types['geometry_msgs/msg/Vector3'](x=0.0, y=0.0, z=0.0)
        message = types[WRENCH](
            types['std_msgs/msg/Header'](stamp=stamp, frame_id=frame),
            types['geometry_msgs/msg/Wrench'](force=vector, torque=vector),
        )
        self._buffer = bytearray(typestore().serialize_cdr(message, WRENCH))
        self._values = np.frombuffer(self._buffer, '<f8', 6, len(self._buffer) - 48)

    def encode(self, stamp_ns: int, wrench: ArrayLike) -> bytes:
        """Return the serialised message: header stamp [ns], force [N] and moment [N m] (6,)."""
        _STAMP.pack_into(self._buffer, STAMP_OFFSET, *divmod(stamp_ns, NANOSECONDS))
        self._values[:] = wrench
        return bytes(self._buffer)


def encode_clock(stamp_ns: int) -> bytes:
    """Return a serialised rosgraph_msgs/Clock of the time `stamp_ns` [ns]."""
    return b'\x00\x01\x00\x00' + _STAMP.pack(*divmod(stamp_ns, NANOSECONDS))


def _view(buffer: bytearray, doubles: Doubles) -> Floats:
    return np.frombuffer(
        buffer, '<f8', doubles.size, doubles.offset if doubles.size else 0
    )


_OTHER = -1  # ns: a message of this very time is read the long way each time


@kernel
def _read(
    message: bytes,
    expected: NDArray[np.uint8],
    places: NDArray[np.intp],
    values: NDArray[np.uint8],
) -> int:
    """Read the doubles that start at these bytes, unless -1, if a message is as `expected`.

    The rows of that are bytes, and 255 where they must agree. Returns the time [ns] at
    STAMP_OFFSET, of messages that have one there; _OTHER if it differs.
    """
    size = len(message)
    if size != expected.shape[1] or size < STAMP_OFFSET + 8:
        return _OTHER
    difference = 0
    for i in range(size):
        difference |= (message[i] ^ expected[0, i]) & expected[1, i]
    if difference != 0:
        return _OTHER
    for i in range(places.size):
        if places[i] >= 0:
            for k in range(8):
                values[8 * i + k] = message[places[i] + k]
    seconds = nanoseconds = 0
    for k in range(4):
        seconds |= int(message[STAMP_OFFSET + k]) << 8 * k
        nanoseconds |= int(message[STAMP_OFFSET + 4 + k]) << 8 * k
    if seconds >= 1 << 31:
        seconds -= 1 << 32
    return seconds * NANOSECONDS + nanoseconds


class _Decoder:
    """Decoder of `values` (s,) at places that are the same in all messages of one layout."""

    def __init__(self, size: int) -> None:
        self.values = np.full(size, np.nan)
        self._bytes = self.values.view(np.uint8)
        self._known = np.zeros((2, 0), np.uint8), np.full(size, -1), self._bytes
        self._read = direct(_read, b'', *self._known)

    def _learn(self, raw: bytes, layout: Layout, places: NDArray[np.intp]) -> None:
        """Store the layout of a message, and where its values are; -1 for NaN."""
        expected = np.zeros((2, len(raw)), np.uint8)
        for part in layout.fixed:
            expected[0, part] = np.frombuffer(raw[part], np.uint8)
            expected[1, part] = 255
        self._known = (
            expected,
            np.where(places < 0, -1, ORIGIN + 8 * places),
            self._bytes,
        )
        self.values[:] = np.nan
        self._read(raw, *self._known)


class JointStateDecoder(_Decoder):
    """Decoder of sensor_msgs/JointState into arrays in the order of the n `joints`, by name.

    Other joints in the message are ignored. A field that is not `required` and is empty
    in the message reads as NaN. Values are not checked: NaN passes through.

    Attributes:
        position, velocity, effort: (n,) of the last message.
        values: (3 n,) all of these, concatenated.
    """

    def __init__(
        self,
        joints: Sequence[str],
        required: Collection[str] = ('position', 'velocity'),
    ) -> None:
        super().__init__(3 * len(joints))
        self._joints = tuple(joints)
        self._required = frozenset(required)
        self.position, self.velocity, self.effort = self.values.reshape(3, -1)

    def decode(self, raw: bytes) -> int:
        """Fill the arrays from a serialised message and return its stamp [ns].

        Raises:
            MessageError: as `joint_state_layout` and `Layout.places_of`.
        """
        stamp: int = self._read(raw, *self._known)
        if stamp != _OTHER:
            return stamp
        layout = joint_state_layout(raw)
        self._learn(raw, layout, layout.places_of(self._joints, self._required).ravel())
        return joint_state_stamp(raw)


class Float64MultiArrayDecoder(_Decoder):
    """Decoder of std_msgs/Float64MultiArray of an expected size; dimensions are skipped.

    Attributes:
        values: (size,) of the last message of that size.
    """

    def decode(self, raw: bytes) -> int:
        """Return the number of values in the message; fill `values` if it is the expected one.

        Raises:
            MessageError: as `array_layout`.
        """
        if self._read(raw, *self._known) == _OTHER:
            layout = array_layout(raw)
            if len(layout.names) != self.values.size:
                return len(layout.names)
            self._learn(raw, layout, np.array([*layout.places.values()], np.intp))
        return self.values.size
