# SPDX-License-Identifier: Apache-2.0
"""The whole records of a damaged MCAP file, and the gaps between them.

Where a record does not make sense, the next chunk is searched for byte by byte: a chunk announces
its length three times over, so that hardly anything else looks like one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from mmap import mmap
from struct import Struct
from typing import TypeAlias

from blf_dsc_controller.bags.mcap_records import (
    ATTACHMENT,
    CHANNEL,
    CHUNK,
    COMPRESSIONS,
    HEAD,
    MAGIC,
    MESSAGE_INDEX,
    METADATA,
    SCHEMA,
    Fields,
    MalformedRecordError,
    attachment_of,
    channel_of,
    head,
    metadata_of,
    schema_of,
)

Data: TypeAlias = bytes | mmap

_TIMES_AND_SIZES = 28  # bytes from the start of a chunk's content to its compression
_LONGEST_NAME = 8  # of a compression
_CHUNK_BYTE = bytes([CHUNK])
_U32 = Struct('<I')
_U64 = Struct('<Q')


@dataclass(frozen=True)
class Record:
    """A record that is whole by its length."""

    at: int
    opcode: int
    content: bytes


@dataclass(frozen=True)
class Gap:
    """Bytes that make no sense; the last one of a file that was cut off."""

    at: int
    size: int
    reason: str


def scan(data: Data) -> Iterator[Record | Gap]:
    """Records and gaps of a file, in their order; they cover all of it but the magic bytes."""
    at = len(MAGIC)
    if data[:at] != MAGIC:
        at = 0
    while at < len(data) and not _is_end(data, at):
        try:
            opcode, end = _sound(data, at)
        except MalformedRecordError as error:
            end = _next_chunk(data, at + 1)
            yield Gap(at, end - at, str(error))
        else:
            yield Record(at, opcode, data[at + HEAD.size : end])
        at = end


def _is_end(data: Data, at: int) -> bool:
    return at == len(data) - len(MAGIC) and data[at:] == MAGIC


def _sound(data: Data, at: int) -> tuple[int, int]:
    """Opcode and end of the record at a place, whose content must fit its length.

    Where the content cannot tell, what follows must look like a record, too.
    """
    opcode, end = head(data, at)
    if opcode == CHUNK:
        if not _is_chunk(data, at):
            raise MalformedRecordError('the head of a chunk is damaged')
    elif not _check(opcode, data[at + HEAD.size : end]) and end + HEAD.size < len(data):
        head(data, end)
    return opcode, end


def _check(opcode: int, content: bytes) -> bool:
    """Whether the content tells that the length is right; MalformedRecordError if it is not."""
    fields = Fields(content)
    if opcode == SCHEMA:
        schema_of(content)
    elif opcode == CHANNEL:
        channel_of(content)
    elif opcode == MESSAGE_INDEX:
        fields.u16()
        fields.take(fields.u32())
    elif opcode == METADATA:
        metadata_of(content)
    elif opcode == ATTACHMENT:
        attachment_of(content)
    else:
        return False
    if opcode == MESSAGE_INDEX and not fields.is_over:
        raise MalformedRecordError('the record is too long')
    return True


def _is_chunk(data: Data, at: int) -> bool:
    """Whether the three lengths in the head of a chunk agree, and its compression is known."""
    names = at + HEAD.size + _TIMES_AND_SIZES
    if names + 4 > len(data):
        return False
    _, length = HEAD.unpack_from(data, at)
    (name_length,) = _U32.unpack_from(data, names)
    packed = names + 4 + name_length
    if name_length > _LONGEST_NAME or packed + 8 > len(data):
        return False
    (packed_length,) = _U64.unpack_from(data, packed)
    end = packed + 8 + packed_length
    return (
        data[names + 4 : packed] in COMPRESSIONS
        and end == at + HEAD.size + length
        and end <= len(data)
    )


def _next_chunk(data: Data, start: int) -> int:
    """Place of the next chunk, the end of the file if there is none."""
    at = data.find(_CHUNK_BYTE, start)
    while at >= 0:
        if _is_chunk(data, at):
            return at
        at = data.find(_CHUNK_BYTE, at + 1)
    return len(data)
