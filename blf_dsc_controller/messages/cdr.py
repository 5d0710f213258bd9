# SPDX-License-Identifier: Apache-2.0
"""Where the values stand in a serialised message.

Plain CDR, version 1, as ROS 2 sends it: two bytes that tell the byte order, two unused, then the
fields in turn, each number aligned to its own size counted from the fifth byte. Padding bytes may
hold anything, and so may bytes after the last field.
"""

from __future__ import annotations

from dataclasses import dataclass
from struct import unpack_from
from typing import NamedTuple

from blf_dsc_controller.messages.errors import MessageEncodingError, TruncatedMessageError

ORIGIN = 4  # alignment is counted from here
STAMP_OFFSET = 4  # of a message that starts with a std_msgs/Header
BYTE_ORDERS = {b'\x00\x00': '>', b'\x00\x01': '<'}


class Doubles(NamedTuple):
    """A sequence of float64: place of its uint32 length, of its first value, and the length."""

    size_offset: int
    offset: int
    size: int


class Cursor:
    """Steps over the fields of one serialised message."""

    def __init__(self, raw: bytes) -> None:
        if len(raw) < ORIGIN:
            raise TruncatedMessageError(ORIGIN, len(raw))
        if raw[:2] not in BYTE_ORDERS:
            raise MessageEncodingError(raw[:2])
        self.byte_order = BYTE_ORDERS[raw[:2]]
        self.offset = ORIGIN
        self._raw = raw

    def unsigned(self) -> int:
        """Read a uint32."""
        self._align(4)
        start = self._take(4)
        return int(unpack_from(self.byte_order + 'I', self._raw, start)[0])

    def text(self) -> str:
        """Read a string."""
        length = self.unsigned()
        start = self._take(length)
        return self._raw[start : start + length].rstrip(b'\0').decode(errors='replace')

    def doubles(self) -> Doubles:
        """Step over a sequence of float64."""
        count = self.unsigned()
        size_offset = self.offset - 4
        if count == 0:
            return Doubles(size_offset, self.offset, 0)
        self._align(8)
        return Doubles(size_offset, self._take(8 * count), count)

    def _align(self, size: int) -> None:
        self.offset += -(self.offset - ORIGIN) % size

    def _take(self, size: int) -> int:
        start = self.offset
        self.offset += size
        if self.offset > len(self._raw):
            raise TruncatedMessageError(self.offset, len(self._raw))
        return start


@dataclass(frozen=True)
class JointStateLayout:
    """Names of a sensor_msgs/JointState and the places of its arrays."""

    byte_order: str
    frame_id: str
    names: tuple[str, ...]
    names_end: int
    position: Doubles
    velocity: Doubles
    effort: Doubles

    @classmethod
    def parse(cls, raw: bytes) -> JointStateLayout:
        """Find them in `raw`.

        Raises:
            MessageEncodingError: not plain CDR.
            TruncatedMessageError: `raw` ends too early.
        """
        cursor = Cursor(raw)
        cursor.unsigned()
        cursor.unsigned()
        frame_id = cursor.text()
        names = tuple(cursor.text() for _ in range(cursor.unsigned()))
        names_end = cursor.offset
        return cls(
            cursor.byte_order,
            frame_id,
            names,
            names_end,
            cursor.doubles(),
            cursor.doubles(),
            cursor.doubles(),
        )


@dataclass(frozen=True)
class ArrayLayout:
    """Place of the values of a std_msgs/Float64MultiArray."""

    byte_order: str
    data: Doubles

    @classmethod
    def parse(cls, raw: bytes) -> ArrayLayout:
        """Find it in `raw`; the dimensions are stepped over.

        Raises:
            MessageEncodingError: not plain CDR.
            TruncatedMessageError: `raw` ends too early.
        """
        cursor = Cursor(raw)
        for _ in range(cursor.unsigned()):
            cursor.text()
            cursor.unsigned()
            cursor.unsigned()
        cursor.unsigned()
        return cls(cursor.byte_order, cursor.doubles())
