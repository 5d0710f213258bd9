# SPDX-License-Identifier: Apache-2.0
"""The records of an MCAP file as bytes: where each begins and ends, and what the few we need hold.

Every record is an opcode (uint8), the length of its content (uint64) and the content, in
little-endian order. Nothing here trusts a length: what does not fit raises MalformedRecordError.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from mmap import mmap
from struct import Struct
from typing import NamedTuple, TypeAlias

import lz4.frame
import zstandard

MAGIC = b'\x89MCAP0\r\n'
HEAD = Struct('<BQ')

FOOTER = 0x02
SCHEMA = 0x03
CHANNEL = 0x04
MESSAGE = 0x05
CHUNK = 0x06
MESSAGE_INDEX = 0x07
ATTACHMENT = 0x09
STATISTICS = 0x0B
METADATA = 0x0C
DATA_END = 0x0F
OPCODES = range(0x01, 0x10)

COMPRESSIONS = (b'', b'zstd', b'lz4')

_U16 = Struct('<H')
_U32 = Struct('<I')
_U64 = Struct('<Q')
_CHUNK = Struct('<QQQI')
MESSAGE_HEAD = Struct('<BQHIQQ')

Buffer: TypeAlias = 'bytes | memoryview'


class MalformedRecordError(ValueError):
    """A record whose content does not fit its length; never leaves the reading of a file."""


class Message(NamedTuple):
    """One message."""

    channel: int
    sequence: int
    log_time: int  # ns
    publish_time: int  # ns
    raw: bytes


class Schema(NamedTuple):
    """Definition of a message type."""

    id: int
    name: str
    encoding: str
    text: str


class Channel(NamedTuple):
    """One topic of a file."""

    id: int
    schema: int
    topic: str
    encoding: str
    metadata: dict[str, str]


class Attachment(NamedTuple):
    """A text beside the messages."""

    log_time: int  # ns
    name: str
    media_type: str
    text: str


@dataclass(frozen=True)
class Chunk:
    """A compressed piece of the file that holds schemas, channels and messages; times [ns]."""

    start: int
    end: int
    size: int
    crc: int
    compression: bytes
    packed: Buffer

    def unpack(self) -> bytes:
        """Records within, uncompressed.

        Raises:
            MalformedRecordError: they are not what was written.
        """
        try:
            if self.compression == b'zstd':
                records = zstandard.decompress(self.packed, self.size)
            elif self.compression == b'lz4':
                records = lz4.frame.decompress(self.packed)
            else:
                records = bytes(self.packed)
        except (zstandard.ZstdError, RuntimeError, ValueError, MemoryError) as error:
            raise MalformedRecordError(f'cannot be decompressed: {error}') from error
        if len(records) != self.size:
            raise MalformedRecordError(f'{len(records)} bytes where {self.size} were written')
        if self.crc and zlib.crc32(records) != self.crc:
            raise MalformedRecordError('the checksum differs')
        return records


class Fields:
    """Steps over the fields of a record's content."""

    def __init__(self, content: Buffer) -> None:
        self._content = content
        self.offset = 0

    def u16(self) -> int:
        """Read a uint16."""
        return self._number(_U16)

    def u32(self) -> int:
        """Read a uint32."""
        return self._number(_U32)

    def u64(self) -> int:
        """Read a uint64."""
        return self._number(_U64)

    def take(self, size: int) -> Buffer:
        """Read some bytes."""
        start = self.offset
        self.offset += size
        if self.offset > len(self._content):
            raise MalformedRecordError('the record is too short')
        return self._content[start : self.offset]

    def text(self) -> str:
        """Read a string."""
        return bytes(self.take(self.u32())).decode(errors='replace')

    def mapping(self) -> dict[str, str]:
        """Read a map of strings."""
        fields = Fields(self.take(self.u32()))
        found = {}
        while not fields.is_over:
            key = fields.text()
            found[key] = fields.text()
        return found

    @property
    def is_over(self) -> bool:
        """Whether all of the content has been read."""
        return self.offset == len(self._content)

    def _number(self, kind: Struct) -> int:
        return int(kind.unpack(self.take(kind.size))[0])


def head(data: Buffer | mmap, at: int) -> tuple[int, int]:
    """Opcode and end of the record at a place.

    Raises:
        MalformedRecordError: there is none, or it is cut off.
    """
    if at + HEAD.size > len(data):
        raise MalformedRecordError('cut off')
    opcode, length = HEAD.unpack_from(data, at)
    end = at + HEAD.size + length
    if end > len(data):
        raise MalformedRecordError('cut off')
    if opcode not in OPCODES:
        raise MalformedRecordError(f'there is no record of kind {opcode}')
    return int(opcode), int(end)


def chunk_of(content: Buffer) -> Chunk:
    """Read the head of a chunk."""
    fields = Fields(content)
    start, end, size, crc = _CHUNK.unpack(fields.take(_CHUNK.size))
    compression = bytes(fields.take(fields.u32()))
    packed = fields.take(fields.u64())
    if compression not in COMPRESSIONS or not fields.is_over:
        raise MalformedRecordError('not a chunk')
    return Chunk(start, end, size, crc, compression, packed)


def schema_of(content: Buffer) -> Schema:
    """Read a schema."""
    fields = Fields(content)
    return Schema(fields.u16(), fields.text(), fields.text(), fields.text())


def channel_of(content: Buffer) -> Channel:
    """Read a channel."""
    fields = Fields(content)
    return Channel(fields.u16(), fields.u16(), fields.text(), fields.text(), fields.mapping())


def records_in(data: Buffer) -> Iterator[tuple[int, Buffer]]:
    """Opcode and content of each record of an unpacked chunk; messages come as a whole record.

    Raises:
        MalformedRecordError: what follows is not a record.
    """
    at = 0
    while at < len(data):
        opcode, end = head(data, at)
        yield opcode, data[at:end] if opcode == MESSAGE else data[at + HEAD.size : end]
        at = end


def message_of(record: Buffer) -> Message:
    """Read a message from its whole record."""
    if len(record) < MESSAGE_HEAD.size:
        raise MalformedRecordError('the message is too short')
    _, _, channel, sequence, log_time, publish_time = MESSAGE_HEAD.unpack_from(record)
    return Message(channel, sequence, log_time, publish_time, bytes(record[MESSAGE_HEAD.size :]))


def metadata_of(content: Buffer) -> tuple[str, dict[str, str]]:
    """Read name and entries of a metadata record."""
    fields = Fields(content)
    name, entries = fields.text(), fields.mapping()
    _must_be_over(fields)
    return name, entries


def attachment_of(content: Buffer) -> Attachment:
    """Read an attachment."""
    fields = Fields(content)
    log_time = fields.u64()
    fields.u64()
    name, media_type = fields.text(), fields.text()
    text = bytes(fields.take(fields.u64())).decode(errors='replace')
    end = fields.offset
    crc = fields.u32()
    _must_be_over(fields)
    if crc and zlib.crc32(content[:end]) != crc:
        raise MalformedRecordError('the checksum differs')
    return Attachment(log_time, name, media_type, text)


def _must_be_over(fields: Fields) -> None:
    if not fields.is_over:
        raise MalformedRecordError('the record is too long')
