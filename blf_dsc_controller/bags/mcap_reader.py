# SPDX-License-Identifier: Apache-2.0
"""Raw records of complete or damaged MCAP files.

Neither lengths nor the index are trusted: a record that does not match its length starts a gap,
which ends at the next chunk, or where another record is found before it. Chunks are searched for
byte by byte; a chunk holds its length three times, so false matches are rare. The reader of rosbags
relies on the index: it silently misses messages in 3 % of small files with one flipped bit, and
takes four times as long.
"""

from __future__ import annotations

import zlib
from collections.abc import Collection, Iterator
from contextlib import suppress
from io import BytesIO
from mmap import ACCESS_READ, MADV_DONTNEED, mmap
from pathlib import Path
from struct import Struct
from struct import error as struct_error
from typing import Any, NamedTuple, TypeAlias

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from zstandard import ZstdError

from blf_dsc_controller.bags.unpacking import LARGEST_CHUNK, Unpacker

Data: TypeAlias = bytes | mmap

StoredMessage: TypeAlias = tuple[int, int, int, int, bytes]
"""Channel number, sequence number, log time [ns], publish time [ns], content."""

INDEX = Struct('<BQHI')
"""Head of a message index: opcode, length, channel number, bytes of the entries."""

_CHUNK_BYTE = bytes([Opcode.CHUNK])
MAGIC = b'\x89MCAP0\r\n'
_SMALLEST = 45  # bytes: the magic twice, and a footer
_HEAD = Struct('<BQ')  # opcode and content length, at the start of each record
_MESSAGE = Struct('<BQHIQQ')
_FOOTER = Struct('<BQQQI')
_CHUNK = Struct('<BQQQQII')  # up to the length of the compression's name
_COMPRESSIONS = ('', 'zstd', 'lz4')
_COMPRESSION_BYTES = tuple(name.encode() for name in _COMPRESSIONS)
_OPCODES = frozenset(Opcode)
_CHANNEL, _MESSAGE_CODE, _SCHEMA = int(Opcode.CHANNEL), int(Opcode.MESSAGE), int(Opcode.SCHEMA)
_KINDS: dict[int, Any] = {
    Opcode.ATTACHMENT: Attachment,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex,
    Opcode.CHANNEL: Channel,
    Opcode.CHUNK: Chunk,
    Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.DATA_END: DataEnd,
    Opcode.FOOTER: Footer,
    Opcode.METADATA: Metadata,
    Opcode.METADATA_INDEX: MetadataIndex,
    Opcode.SCHEMA: Schema,
    Opcode.STATISTICS: Statistics,
    Opcode.SUMMARY_OFFSET: SummaryOffset,
}


class MalformedRecordError(ValueError):
    """A damaged record or file."""


class Piece(NamedTuple):
    """A complete record of a file, or a gap of unreadable bytes (opcode 0)."""

    at: int
    size: int
    opcode: int
    raw: bytes = b''  # the record with its head; empty for a gap
    record: Any = None  # parsed, if it is one of _KINDS
    reason: str = ''  # of a gap


def mcap_files(path: Path) -> list[Path]:
    """Return the MCAP files of a folder by number (bag_10 after bag_9), or the one file."""
    files = sorted(path.glob('*.mcap'), key=_file_number) if path.is_dir() else [path]
    return [file for file in files if file.suffix == '.mcap']


def _file_number(path: Path) -> tuple[int, str]:
    number = path.stem.rsplit('_', 1)[-1]
    return (int(number) if number.isdecimal() else -1, path.name)


def read_messages(
    path: Path, topics: Collection[str], unpacker: Unpacker | None = None
) -> Iterator[tuple[str, int, bytes]]:
    """Yield topic, log time [ns] and content of each message of `topics`, in file order.

    The `unpacker` is that of the bag if this is one of its files.

    Raises:
        MalformedRecordError: the file is damaged.
        BlfDscError: it unpacks to more than the limit.
    """
    channels: dict[int, Channel] = {}
    unpacker = unpacker or Unpacker([path])
    with path.open('rb') as stream, mmap(stream.fileno(), 0, access=ACCESS_READ) as data:
        require_ends(data)
        for piece in scan(data):
            records = b''
            if piece.opcode == Opcode.CHUNK:
                try:
                    records = unpack(piece.record, unpacker)
                except MalformedRecordError as error:
                    reason = f'the chunk at byte {piece.at} is damaged: {error}'
                    raise MalformedRecordError(reason) from error
            elif piece.opcode in (Opcode.CHANNEL, Opcode.MESSAGE):
                records = piece.raw
            elif piece.opcode == Opcode.DATA_END:
                return
            elif piece.reason:
                raise MalformedRecordError(piece.reason)
            for number, _, log_time, _, raw in messages_in(records, {}, channels, topics):
                yield channels[number].topic, log_time, raw
            data.madvise(MADV_DONTNEED, 0, piece.at + piece.size)  # release the pages read


def messages_in(
    records: bytes,
    schemas: dict[int, Schema],
    channels: dict[int, Channel],
    topics: Collection[str] | None = None,
) -> Iterator[StoredMessage]:
    """Yield the messages among the records of a chunk, of all topics or the given ones.

    Schemas and channels are added to the dictionaries by number.

    Raises:
        MalformedRecordError: a record does not match its length.
    """
    at, size, before_content = 0, len(records), _MESSAGE.size
    last = size - before_content
    unpack_from = _MESSAGE.unpack_from
    while at < size:
        if records[at] == _MESSAGE_CODE:
            if at > last:
                raise MalformedRecordError('cut off')
            _, length, number, sequence, log_time, publish_time = unpack_from(records, at)
            end = at + 9 + length
            if end > size or end < at + before_content:
                raise MalformedRecordError('a message does not match its length')
            if topics is None or number in channels:
                yield number, sequence, log_time, publish_time, records[at + before_content : end]
        else:
            opcode, end = _head(records, at)
            if opcode == _CHANNEL:
                channel = _parse(records[at:end])
                if topics is None or channel.topic in topics:
                    channels[channel.id] = channel
            elif opcode == _SCHEMA and topics is None:
                schema = _parse(records[at:end])
                schemas[schema.id] = schema
        at = end


def require_ends(data: Data) -> None:
    """Raise MalformedRecordError unless a file begins and ends with MCAP's magic bytes."""
    if len(data) < _SMALLEST or data[: len(MAGIC)] != MAGIC or data[-len(MAGIC) :] != MAGIC:
        raise MalformedRecordError('it does not begin and end like an MCAP file')


def scan(data: Data, begin: int = 0) -> Iterator[Piece]:
    """Yield the records and gaps of a file from a byte on, without the magic bytes."""
    at = begin or (len(MAGIC) if data[: len(MAGIC)] == MAGIC else 0)
    is_chunked = False
    while at < len(data) and not (at == len(data) - len(MAGIC) and data[at:] == MAGIC):
        try:
            piece = record_at(data, at, is_chunked=is_chunked)
        except MalformedRecordError as error:
            end = _end_of_gap(data, at, is_chunked=is_chunked)
            piece = Piece(at, end - at, 0, reason=str(error))
        is_chunked = is_chunked or piece.opcode == Opcode.CHUNK
        yield piece
        at += piece.size


def _end_of_gap(data: Data, at: int, *, is_chunked: bool) -> int:
    """Return where records continue after a malformed one.

    That is the next chunk, unless a record begins before it where the malformed one should end (the
    rest of that may be intact), or where the footer says that the index begins.
    """
    length = int.from_bytes(data[at + 1 : at + _HEAD.size], 'little')
    stated = at + _HEAD.size + length if at else len(MAGIC)
    limit = len(data)
    for other in sorted({stated, summary_start(data) or 0}):
        if at < other < limit:
            with suppress(MalformedRecordError):
                record_at(data, other, is_chunked=is_chunked)
                limit = other
    end = data.find(_CHUNK_BYTE, at + 1, limit)
    while end >= 0 and not _is_chunk(data, end):
        end = data.find(_CHUNK_BYTE, end + 1, limit)
    return limit if end < 0 else end


def summary_start(data: Data) -> int | None:
    """Return where the index at the end begins, 0 if there is none; None without a valid footer."""
    at = len(data) - len(MAGIC) - _FOOTER.size
    if at < 0:
        return None
    opcode, length, start, _, _ = _FOOTER.unpack_from(data, at)
    is_footer = opcode == Opcode.FOOTER and length == _FOOTER.size - _HEAD.size
    return int(start) if is_footer and start <= at else None


def unpack(chunk: Chunk, unpacker: Unpacker) -> bytes:
    """Return the uncompressed records of a chunk.

    Raises:
        MalformedRecordError: they differ from what was written.
        BlfDscError: the bag unpacks to more than the limit.
    """
    written = chunk.uncompressed_size
    if written > LARGEST_CHUNK:
        raise MalformedRecordError(f'{written} bytes, unpacked; at most {LARGEST_CHUNK} are read')
    try:
        records = unpacker.unpack(chunk.data, chunk.compression, written)
    except (ZstdError, RuntimeError, ValueError, EOFError) as error:
        raise MalformedRecordError(f'cannot be decompressed: {error}') from error
    if len(records) != written:
        raise MalformedRecordError(f'{len(records)} bytes, unpacked, instead of {written}')
    if chunk.uncompressed_crc and zlib.crc32(records) != chunk.uncompressed_crc:
        raise MalformedRecordError('the checksum does not match')
    return records


def _head(data: Data, at: int) -> tuple[int, int]:
    """Return opcode and end of the record at an offset; MalformedRecordError if invalid."""
    if at + _HEAD.size > len(data):
        raise MalformedRecordError('cut off')
    opcode, length = _HEAD.unpack_from(data, at)
    end = at + _HEAD.size + length
    if end > len(data):
        raise MalformedRecordError('cut off')
    if opcode not in _OPCODES:
        raise MalformedRecordError(f'unknown record type {opcode}')
    return int(opcode), int(end)


def record_at(data: Data, at: int, *, is_chunked: bool = False) -> Piece:
    """Return the record at an offset; MalformedRecordError if it does not match its length.

    Where the content does not determine its length, another record must follow. In a chunked file,
    a message between the chunks is an index with a damaged opcode.
    """
    opcode, end = _head(data, at)
    if is_chunked and opcode == Opcode.MESSAGE:
        raise MalformedRecordError('a message between the chunks')
    raw, record = data[at:end], None
    if opcode in _KINDS:
        record = _parse(raw)
    elif opcode == Opcode.MESSAGE_INDEX:
        if len(raw) < INDEX.size or INDEX.size + INDEX.unpack_from(raw)[-1] != len(raw):
            raise MalformedRecordError('the record does not match its length')
    elif end + _HEAD.size < len(data):
        _head(data, end)
    return Piece(at, end - at, opcode, raw, record)


def _is_chunk(data: Data, at: int) -> bool:
    """Check by its lengths whether a chunk begins here, without copying it."""
    if at + _CHUNK.size > len(data):
        return False
    _, length, *_, name = _CHUNK.unpack_from(data, at)
    named = at + _CHUNK.size
    begin = named + name + 8  # of the records
    if begin > len(data) or data[named : begin - 8] not in _COMPRESSION_BYTES:
        return False
    size = int.from_bytes(data[begin - 8 : begin], 'little')
    return bool(begin + size == at + _HEAD.size + length <= len(data))


def _parse(raw: bytes) -> Any:
    """Parse a record of one of _KINDS; MalformedRecordError unless it is rewritten identically.

    The checksum of an attachment may be omitted, as zero.
    """
    stream = ReadDataStream(BytesIO(raw))
    builder = RecordBuilder()
    try:
        record = _KINDS[stream.read(_HEAD.size)[0]].read(stream)
        record.write(builder)
    except (McapError, struct_error, OverflowError, UnicodeDecodeError) as error:
        raise MalformedRecordError('the record is too short') from error
    again = builder.end()  # type: ignore[no-untyped-call]
    if raw not in (again, again[:-4] + bytes(4)):
        raise MalformedRecordError('the record does not match its length or checksum')
    if isinstance(record, Chunk) and record.compression not in _COMPRESSIONS:
        raise MalformedRecordError('the compression of a chunk is unknown')
    return record
