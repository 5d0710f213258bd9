# SPDX-License-Identifier: Apache-2.0
"""Everything that can be read from one damaged MCAP file.

Where a record makes no sense, the next chunk is searched for byte by byte: a chunk holds its length
three times, so that hardly anything else looks like one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from struct import Struct
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Schema

from blf_dsc_controller.bags.mcap_reader import (
    HEAD,
    MAGIC,
    Data,
    MalformedRecordError,
    StoredMessage,
    messages_in,
    read_record,
    record_head,
    unpack,
)
from blf_dsc_controller.messages.cdr import NANOSECONDS

_TIMES_AND_SIZES = 28  # bytes from the start of a chunk's content to its compression
_COMPRESSIONS = (b'', b'zstd', b'lz4')
_LONGEST_NAME = 8  # of a compression
_CHUNK_BYTE = bytes([Opcode.CHUNK])
_INDEX = Struct('<HI')  # channel number, bytes of the entries
_INDEX_ENTRY = 16  # bytes
_U32 = Struct('<I')
_U64 = Struct('<Q')


class Piece(NamedTuple):
    """A whole record of a file, or a gap: bytes that make no sense (opcode 0)."""

    at: int
    size: int
    opcode: int
    content: bytes = b''
    reason: str = ''


@dataclass
class Loss:
    """A part of a file that could not be recovered.

    Attributes:
        file: its name.
        at: offset of the part [bytes].
        size: of the part [bytes].
        reason: why it cannot be read.
        start: earliest time of its messages [ns], None if unknown.
        end: latest.
        messages: lost messages by topic, as far as the index of the file counts them.
    """

    file: str
    at: int
    size: int
    reason: str
    start: int | None = None
    end: int | None = None
    messages: dict[str, int] = field(default_factory=dict)

    def __str__(self) -> str:
        if self.start is None:
            span = 'of unknown time' if self.end is None else f'before {format_time(self.end)}'
        elif self.end is None:
            span = f'after {format_time(self.start)}'
        else:
            seconds = (self.end - self.start) / NANOSECONDS
            span = f'from {format_time(self.start)} to {format_time(self.end)} ({seconds:.3f} s)'
        counts = ', '.join(f'{count} of {topic}' for topic, count in self.messages.items())
        lost = f'; messages lost: {counts}' if counts else ''
        return f'{self.file}: {self.size} bytes at byte {self.at} ({self.reason}), {span}{lost}'


@dataclass
class Salvage:
    """The content of a file; complete once its `messages` have been read.

    Attributes:
        schemas: by their number in the file.
        channels: by their number in the file.
        attachments: all that are whole.
        metadata: entries of every metadata record that is whole, the later over the earlier.
        losses: damaged parts.
        last: latest time of a message [ns].
        is_complete: whether the recording was ended properly.
    """

    path: Path
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    attachments: list[Attachment] = field(default_factory=list)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    losses: list[Loss] = field(default_factory=list)
    is_complete: bool = False
    last: int | None = None

    def messages(self, data: Data) -> Iterator[StoredMessage]:
        """Every whole message of the file's content, in its order."""
        lost_chunk: Loss | None = None
        counts: list[tuple[Loss, int, int]] = []
        for piece in scan(data):
            opcode, content = piece.opcode, piece.content
            if opcode == Opcode.CHUNK:
                chunk, lost_chunk = read_record(opcode, content), None
                try:
                    records = unpack(chunk)
                except MalformedRecordError as error:
                    lost_chunk = self._lose(piece, f'chunk: {error}')
                    lost_chunk.start, lost_chunk.end = (
                        chunk.message_start_time,
                        chunk.message_end_time,
                    )
                else:
                    yield from self._messages_in(records, piece, 'part of a chunk: ')
            elif opcode in (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL):
                record = HEAD.pack(opcode, len(content)) + content
                yield from self._messages_in(record, piece, '')
            elif opcode == Opcode.MESSAGE_INDEX and lost_chunk is not None:
                number, size = _INDEX.unpack_from(content)
                counts.append((lost_chunk, number, size // _INDEX_ENTRY))
            elif opcode:
                self._describe(opcode, content)
            elif not self.is_complete:
                self._lose(piece, piece.reason)
        for loss, number, count in counts:
            channel = self.channels.get(number)
            topic = f'topic number {number}' if channel is None else channel.topic
            loss.messages[topic] = count

    def _messages_in(self, records: bytes, piece: Piece, kind: str) -> Iterator[StoredMessage]:
        try:
            for message in messages_in(records, self.schemas, self.channels):
                log_time = message[2]
                if self.losses and self.losses[-1].end is None:
                    self.losses[-1].end = log_time
                if self.last is None or log_time > self.last:
                    self.last = log_time
                yield message
        except MalformedRecordError as error:
            self._lose(piece, f'{kind}{error}')

    def _describe(self, opcode: int, content: bytes) -> None:
        if opcode == Opcode.ATTACHMENT:
            self.attachments.append(read_record(opcode, content))
        elif opcode == Opcode.METADATA:
            record = read_record(opcode, content)
            self.metadata.setdefault(record.name, {}).update(record.metadata)
        elif opcode == Opcode.DATA_END:
            self.is_complete = True

    def _lose(self, piece: Piece, reason: str) -> Loss:
        loss = Loss(self.path.name, piece.at, piece.size, reason, self.last)
        self.losses.append(loss)
        return loss


def scan(data: Data) -> Iterator[Piece]:
    """Whole records and gaps of a file, in its order; together all but the magic bytes."""
    at = len(MAGIC) if data[: len(MAGIC)] == MAGIC else 0
    while at < len(data) and not (at == len(data) - len(MAGIC) and data[at:] == MAGIC):
        try:
            opcode, end = _check_record(data, at)
        except MalformedRecordError as error:
            end = data.find(_CHUNK_BYTE, at + 1)
            while end >= 0 and not _is_chunk(data, end):
                end = data.find(_CHUNK_BYTE, end + 1)
            end = len(data) if end < 0 else end
            yield Piece(at, end - at, 0, reason=str(error))
        else:
            content = data[at + HEAD.size : end]
            yield Piece(at, len(content), opcode, content)
        at = end


def format_time(stamp: int) -> str:
    """Log time [ns] as a plain number and as UTC; one out of range as the number alone."""
    plain = f'{stamp // NANOSECONDS}.{stamp % NANOSECONDS:09d} s'
    try:
        moment = datetime.fromtimestamp(stamp // NANOSECONDS, tz=timezone.utc)
    except (OverflowError, OSError, ValueError):
        return plain
    return f'{plain} ({moment:%Y-%m-%d %H:%M:%S} UTC)'


def _check_record(data: Data, at: int) -> tuple[int, int]:
    """Opcode and end of a record whose content fits its length, or MalformedRecordError.

    Where the content does not determine its length, another record must follow.
    """
    opcode, end = record_head(data, at)
    content_at = at + HEAD.size
    if opcode == Opcode.CHUNK:
        if not _is_chunk(data, at):
            raise MalformedRecordError('the head of a chunk is damaged')
    elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.ATTACHMENT):
        read_record(opcode, data[content_at:end])
    elif opcode == Opcode.MESSAGE_INDEX:
        entries_at = content_at + _INDEX.size
        if entries_at > end or entries_at + _INDEX.unpack_from(data, content_at)[1] != end:
            raise MalformedRecordError('the record does not fit its length')
    elif end + HEAD.size < len(data):
        record_head(data, end)
    return opcode, end


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
        data[names + 4 : packed] in _COMPRESSIONS
        and end == at + HEAD.size + length
        and end <= len(data)
    )
