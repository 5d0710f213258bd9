# SPDX-License-Identifier: Apache-2.0
"""MCAP files, read from begin to end: nothing in them is lost without an error.

The mcap library parses the records and checks each chunk's checksum. What no checksum covers, such
as a chunk whose opcode has flipped, shows in the counts of the statistics at the end of the file.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Collection, Iterator
from contextvars import ContextVar
from io import BytesIO
from pathlib import Path
from struct import Struct
from typing import Any, TypeAlias

from lz4.frame import get_frame_info
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, Message, Metadata, Schema, Statistics
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from zstandard import frame_content_size

from blf_dsc_controller.errors import BlfDscError

StoredMessage: TypeAlias = tuple[int, int, int, int, bytes]
"""Channel number, sequence number, log time [ns], publish time [ns], content."""

MAX_UNPACKED: ContextVar[float] = ContextVar('MAX_UNPACKED', default=1e9)
"""Bytes that a bag may unpack to; set by `--max-unpacked`, in GB."""

_EXPECTED = 100  # multiple of the size of its files that any bag may unpack to
_LARGEST_CHUNK = 1 << 29  # bytes, unpacked
_MAGIC = b'\x89MCAP0\r\n'
_HEAD = Struct('<BQ')  # opcode and content length, at the start of each record
_MESSAGE = Struct('<HIQQ')
_FOOTER = Struct('<BQQQI')


class DamageError(ValueError):
    """A damaged file."""


class Allowance:
    """What a bag may still unpack to: a few kilobytes can unpack to gigabytes."""

    def __init__(self, path: Path) -> None:
        """Take the bag's folder or file."""
        self._path = path
        files = path.iterdir() if path.is_dir() else [path]
        packed = sum(file.stat().st_size for file in files)
        self._limit = self._left = max(int(MAX_UNPACKED.get()), _EXPECTED * packed)

    def take(self, size: int) -> None:
        """Count unpacked bytes; BlfDscError if there are too many."""
        self._left -= size
        if self._left < 0:
            raise BlfDscError(
                f'{self._path} unpacks to more than {self._limit / 1e9:.3g} GB, which is '
                'unusual for a recording: if you trust it, raise --max-unpacked'
            )


class McapFile:
    """One file, described by what has been read of it so far.

    Attributes:
        channels: by number.
        found: number of messages of each channel.
        metadata: entries by name of the record; later ones override.
    """

    def __init__(self, path: Path, allowance: Allowance) -> None:
        """Check the end of the file; DamageError if it was not closed, or is damaged there."""
        self._path, self._allowance = path, allowance
        self.channels: dict[int, Channel] = {}
        self.found: Counter[int] = Counter()
        self.metadata: dict[str, dict[str, str]] = {}
        with path.open('rb') as stream:
            size = stream.seek(0, 2)
            stream.seek(max(0, size - _FOOTER.size - len(_MAGIC)))
            _, _, start, _, crc = _FOOTER.unpack_from(stream.read())
            stream.seek(start or size)
            allowance.take(size - (start or size))
            summary = stream.read()
        if not start or (crc and crc != zlib.crc32(summary[: -len(_MAGIC) - 4])):
            raise DamageError('the description at its end is missing or damaged')

    def messages(self, topics: Collection[str], start: int = 0) -> Iterator[StoredMessage]:
        """Yield the messages of `topics`, without chunks that end before `start` [ns].

        Raises:
            DamageError: the file is damaged, or holds other messages than its statistics say.
            BlfDscError: it unpacks to more than the limit.
        """
        found: Counter[int] = Counter()
        self.found = found
        wanted: dict[int, bool] = {}
        for record in self._records(start):
            if isinstance(record, tuple):
                number = record[0]
                if number not in wanted:
                    raise DamageError(f'a message of the unknown channel {number}')
                found[number] += 1
                if wanted[number]:
                    yield record
            elif isinstance(record, Channel):
                self.channels[record.id] = record
                wanted[record.id] = record.topic in topics
            elif isinstance(record, Metadata):
                self.metadata.setdefault(record.name, {}).update(record.metadata)
            elif isinstance(record, Statistics) and start == 0:
                stated = Counter(record.channel_message_counts)
                for number in found | stated:
                    if found[number] != stated[number]:
                        name = self.channels[number].topic if number in wanted else number
                        raise DamageError(
                            f'it holds {found[number]} messages of {name}, but its statistics '
                            f'count {stated[number]}'
                        )

    def _records(self, start: int) -> Iterator[Any]:
        """Yield the records, and those in the chunks."""
        with self._path.open('rb') as stream:
            is_closed = False
            for record in StreamReader(stream, emit_chunks=True, record_size_limit=None).records:
                if isinstance(record, Chunk) and not is_closed:
                    if record.message_end_time >= start:
                        yield from records_in(unpack(record, self._allowance))
                elif isinstance(record, Message):
                    times = record.log_time, record.publish_time
                    yield (record.channel_id, record.sequence, *times, record.data)
                else:
                    is_closed |= isinstance(record, DataEnd)
                    yield record
        if not is_closed:
            raise DamageError('cut off')


def records_in(records: bytes) -> Iterator[StoredMessage | Schema | Channel]:
    """Yield the messages, schemas and channels of a chunk; DamageError if lengths do not match."""
    at, size, before = 0, len(records), _HEAD.size + _MESSAGE.size
    head, message = _HEAD.unpack_from, _MESSAGE.unpack_from
    while at < size:
        if at + _HEAD.size > size:
            raise DamageError('cut off')
        opcode, length = head(records, at)
        end = at + _HEAD.size + length
        if end > size or (opcode == Opcode.MESSAGE and end < at + before):
            raise DamageError('a record does not match its length')
        if opcode == Opcode.MESSAGE:
            yield *message(records, at + _HEAD.size), records[at + before : end]
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            stream = ReadDataStream(BytesIO(records[at + _HEAD.size : end]))
            yield (Schema if opcode == Opcode.SCHEMA else Channel).read(stream)
        else:
            raise DamageError(f'unknown record type {opcode} in a chunk')
        at = end


def unpack(chunk: Chunk, allowance: Allowance) -> bytes:
    """Return the records of a chunk; DamageError if they differ from what was written."""
    size, stated = chunk.uncompressed_size, len(chunk.data)
    if chunk.compression == 'zstd':
        stated = frame_content_size(chunk.data)
    elif chunk.compression == 'lz4':
        stated = get_frame_info(chunk.data)['content_size'] or min(size, 255 * stated)
    if stated not in (size, -1) or size > _LARGEST_CHUNK:
        raise DamageError(f'a chunk states {size} bytes, unpacked, but holds {stated}')
    allowance.take(size)
    stream, length = get_chunk_data_stream(chunk, validate_crc=True)
    if length != size:
        raise DamageError(f'a chunk unpacks to {length} bytes instead of {size}')
    return stream.read(length)
