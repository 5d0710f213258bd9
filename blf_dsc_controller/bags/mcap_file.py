# SPDX-License-Identifier: Apache-2.0
"""MCAP files, read from begin to end: nothing in them is lost without an error.

The mcap library parses the records and checks each chunk's checksum. What no checksum covers, such
as a chunk whose opcode has flipped, shows in the counts of the statistics at the end of the file.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Callable, Iterator
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
from zstandard import FRAME_HEADER, ZstdDecompressor, frame_content_size

from blf_dsc_controller.errors import BlfDscError

StoredMessage: TypeAlias = tuple[int, int, int, int, bytes]
"""Channel number, sequence number, log time [ns], publish time [ns], content."""

MAX_UNPACKED: ContextVar[float] = ContextVar('MAX_UNPACKED', default=1e9)
"""Bytes that a bag may unpack to; set by `--max-unpacked`, in GB."""

LARGEST_CHUNK = 1 << 29  # bytes, unpacked
_EXPECTED = 100  # multiple of the size of its files that any bag may unpack to
_MAGIC = b'\x89MCAP0\r\n'
_HEAD = Struct('<BQ')  # opcode and content length, at the start of each record
_MESSAGE = Struct('<HIQQ')
_FOOTER = Struct('<BQQQI')


class DamageError(ValueError):
    """A damaged file."""


class Allowance:
    """What a bag of these files may still unpack to: a few kilobytes can unpack to gigabytes."""

    def __init__(self, files: list[Path]) -> None:
        self._name = str(files[0].parent if len(files) > 1 else files[0])
        packed = sum(file.stat().st_size for file in files)
        self._limit = self._left = max(int(MAX_UNPACKED.get()), _EXPECTED * packed)

    def take(self, size: int) -> None:
        """Count unpacked bytes; BlfDscError if there are too many."""
        self._left -= size
        if self._left < 0:
            raise BlfDscError(
                f'{self._name} unpacks to more than {self._limit / 1e9:.3g} GB, which is '
                'unusual for a recording: if you trust it, raise --max-unpacked'
            )


def unpacked(raw: bytes, allowance: Allowance) -> bytes:
    """Return a message, unpacked if it is compressed by itself, as metadata.yaml would state."""
    if not raw.startswith(FRAME_HEADER):  # as CDR never does
        return raw
    allowance.take(max(0, frame_content_size(raw)))
    return ZstdDecompressor().decompress(raw, LARGEST_CHUNK)


def mcap_files(path: Path) -> list[Path]:
    """Return the MCAP files of a folder by number (bag_10 after bag_9), or the one file."""

    def number(file: Path) -> tuple[int, str]:
        digits = file.stem.rsplit('_', 1)[-1]
        return (int(digits) if digits.isdecimal() else -1, file.name)

    return sorted(path.glob('*.mcap'), key=number) if path.is_dir() else [path]


class McapFile:
    """One file: its description at the end, and its messages.

    Attributes:
        schemas, channels: by number.
        statistics: counts of the messages; None if the recorder did not store them.
        metadata: entries by name of the record; later ones override.
    """

    def __init__(self, path: Path, allowance: Allowance | None = None) -> None:
        """Read the description, or the whole file if it has none; DamageError if it is damaged."""
        self.path = path
        self.allowance = allowance or Allowance([path])
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.statistics: Statistics | None = None
        self.metadata: dict[str, dict[str, str]] = {}
        self._read_description()
        needed = {one.schema_id for one in self.channels.values()} - {0}
        if self.statistics is None or not needed <= self.schemas.keys():
            for _ in self.messages():
                pass

    def _read_description(self) -> None:
        with self.path.open('rb') as stream:
            size = stream.seek(0, 2)
            stream.seek(max(0, size - _FOOTER.size - len(_MAGIC)))
            tail = stream.read()
            if not tail:
                raise DamageError('the file is empty')
            if not tail.endswith(_MAGIC):
                raise DamageError('it does not end like an MCAP file: the recording was not closed')
            opcode, _, start, _, crc = _FOOTER.unpack_from(tail)
            if opcode != Opcode.FOOTER or start > size:
                raise DamageError('its last record is not the footer of an MCAP file')
            if start == 0:
                return
            stream.seek(start)
            summary = stream.read()
            self.allowance.take(len(summary))
        if crc and crc != zlib.crc32(summary[: -len(_MAGIC) - 4]):
            raise DamageError('the checksum of its description does not match')
        for record in StreamReader(BytesIO(summary), skip_magic=True).records:
            self._note(record)

    def _note(self, record: object) -> None:
        if isinstance(record, Schema):
            self.schemas[record.id] = record
        elif isinstance(record, Channel):
            self.channels[record.id] = record
        elif isinstance(record, Statistics):
            self.statistics = record
        elif isinstance(record, Metadata):
            self.metadata.setdefault(record.name, {}).update(record.metadata)

    @property
    def counts(self) -> Counter[int]:
        """Number of messages by channel number."""
        return Counter(self.statistics.channel_message_counts if self.statistics else {})

    def messages(
        self, wanted: Callable[[Channel], bool] = lambda _: False, start: int = 0
    ) -> Iterator[StoredMessage]:
        """Yield the messages of the wanted channels, without chunks that end before `start` [ns].

        Raises:
            DamageError: the file is damaged, or holds other messages than it says.
            BlfDscError: it unpacks to more than the limit.
        """
        found: Counter[int] = Counter()
        known = {number: wanted(channel) for number, channel in self.channels.items()}
        begin, end, self._is_whole = 2**64, -1, True
        for record in self._records(start):
            if isinstance(record, tuple):
                number, _, at, _, _ = record
                if number not in self.channels:
                    raise DamageError(f'a message of the unknown channel {number}')
                found[number] += 1
                begin, end = min(begin, at), max(end, at)
                if known[number]:
                    yield record
            else:
                self._note(record)
                if isinstance(record, Channel):
                    known[record.id] = wanted(record)
        if self.statistics is None:
            self.statistics = Statistics(
                0, len(known), dict(found), 0, end, found.total(), begin % 2**64, 0, 0
            )  # fmt: skip
        elif self._is_whole and found != +self.counts:
            number = next(k for k in found | self.counts if found[k] != self.counts[k])
            name = self.channels[number].topic if number in self.channels else f'channel {number}'
            raise DamageError(
                f'it holds {found[number]} messages of {name}, but its statistics count '
                f'{self.counts[number]}'
            )

    def _records(self, start: int) -> Iterator[Any]:
        """Yield the records up to the end of the data, and those in its chunks."""
        with self.path.open('rb') as stream:
            for record in StreamReader(stream, emit_chunks=True, record_size_limit=None).records:
                if isinstance(record, DataEnd):
                    return
                if isinstance(record, Message):
                    times = record.log_time, record.publish_time
                    yield (record.channel_id, record.sequence, *times, record.data)
                elif not isinstance(record, Chunk):
                    yield record
                elif record.message_end_time >= start:
                    yield from records_in(unpack(record, self.allowance))
                else:
                    self._is_whole = False
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
    size, packed = chunk.uncompressed_size, len(chunk.data)
    if chunk.compression == 'zstd':
        stated = frame_content_size(chunk.data)
    elif chunk.compression == 'lz4':
        stated = get_frame_info(chunk.data)['content_size'] or min(size, 255 * packed)
    else:
        stated = packed
    if stated not in (size, -1) or size > LARGEST_CHUNK:
        raise DamageError(f'a chunk states {size} bytes, unpacked, but holds {stated}')
    allowance.take(size)
    stream, length = get_chunk_data_stream(chunk, validate_crc=True)
    if length != size:
        raise DamageError(f'a chunk unpacks to {length} bytes instead of {size}')
    return stream.read(length)
