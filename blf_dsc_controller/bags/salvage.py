# SPDX-License-Identifier: Apache-2.0
"""Recoverable content of one damaged MCAP file, and its losses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Schema

from blf_dsc_controller.bags.mcap_reader import (
    INDEX,
    Data,
    MalformedRecordError,
    Piece,
    StoredMessage,
    messages_in,
    scan,
    unpack,
)
from blf_dsc_controller.bags.unpacking import Unpacker
from blf_dsc_controller.bags.writer import CHANNEL_RECORD, channel_checksum
from blf_dsc_controller.messages.cdr import NANOSECONDS

_INDEX_ENTRY = 16  # bytes


@dataclass
class Loss:
    """A part of a file that could not be recovered."""

    file: str
    at: int  # offset [bytes]
    size: int  # bytes
    reason: str
    start: int | None = None  # earliest time of its messages [ns], None if unknown
    end: int | None = None  # latest
    messages: dict[str, int] = field(default_factory=dict)  # by topic, where the index counts them

    def __str__(self) -> str:
        if self.start is None:
            span = 'at an unknown time' if self.end is None else f'before {format_time(self.end)}'
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
    """Content of one damaged file; complete once its `messages` have been read."""

    path: Path
    unpacker: Unpacker | None = None  # of the whole bag, if this is one of its files
    schemas: dict[int, Schema] = field(default_factory=dict)  # by number in the file
    channels: dict[int, Channel] = field(default_factory=dict)
    attachments: list[Attachment] = field(default_factory=list)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)  # later entries override
    losses: list[Loss] = field(default_factory=list)
    is_complete: bool = False  # the recording was closed properly
    last: int | None = None  # latest time of a message [ns]

    def messages(self, data: Data) -> Iterator[StoredMessage]:
        """Yield every complete message of the file's content, in order."""
        lost_chunk: Loss | None = None
        unpacker = self.unpacker or Unpacker([self.path])
        counts: list[tuple[Loss, int, int]] = []
        for piece in scan(data):
            if piece.opcode == Opcode.CHUNK:
                chunk, lost_chunk = piece.record, None
                try:
                    records = unpack(chunk, unpacker)
                except MalformedRecordError as error:
                    lost_chunk = self._lose(piece, f'chunk: {error}')
                    lost_chunk.start = chunk.message_start_time
                    lost_chunk.end = chunk.message_end_time
                else:
                    yield from self._messages_in(records, piece, 'part of a chunk: ')
            elif piece.opcode in (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL):
                yield from self._messages_in(piece.raw, piece, '')
            elif piece.opcode == Opcode.MESSAGE_INDEX and lost_chunk is not None:
                *_, number, size = INDEX.unpack_from(piece.raw)
                counts.append((lost_chunk, number, size // _INDEX_ENTRY))
            elif piece.opcode:
                self._describe(piece)
            elif not self.is_complete:
                lost_chunk = None  # the next index may be that of another chunk
                self._lose(piece, piece.reason)
        for loss, number, count in counts:
            channel = self.channel(number)
            topic = f'topic number {number}' if channel is None else channel.topic
            loss.messages[topic] = count

    def channel(self, number: int) -> Channel | None:
        """Return a channel by number, or its copy in the metadata; None if both are damaged."""
        channel = self.channels.get(number)
        if channel is not None and self._is_intact(channel):
            return channel
        entries = self.metadata.get(f'{CHANNEL_RECORD}{number}', {})
        channel = Channel(number, entries.get('topic', ''), 'cdr', entries, 0)
        return channel if channel.topic and self._is_intact(channel) else None

    def type_of(self, channel: Channel) -> str:
        """Return the type of a channel's messages; empty if it is lost."""
        schema = self.schemas.get(channel.schema_id)
        return channel.metadata.get('topic_type', '') if schema is None else str(schema.name)

    def _is_intact(self, channel: Channel) -> bool:
        """Return whether a channel matches its checksum; bags of other recorders have none."""
        checksum = channel.metadata.get('checksum')
        expected = channel_checksum(channel.topic, self.type_of(channel), channel.metadata)
        return checksum is None or checksum == expected

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

    def _describe(self, piece: Piece) -> None:
        if piece.opcode == Opcode.ATTACHMENT:
            self.attachments.append(piece.record)
        elif piece.opcode == Opcode.METADATA:
            entries = self.metadata.setdefault(piece.record.name, {})
            entries.update(piece.record.metadata)
        elif piece.opcode == Opcode.DATA_END:
            self.is_complete = True

    def _lose(self, piece: Piece, reason: str) -> Loss:
        loss = Loss(self.path.name, piece.at, piece.size, reason, self.last)
        self.losses.append(loss)
        return loss


def format_time(stamp: int) -> str:
    """Format a log time [ns] as seconds and UTC; as seconds only if UTC is out of range."""
    plain = f'{stamp // NANOSECONDS}.{stamp % NANOSECONDS:09d} s'
    try:
        moment = datetime.fromtimestamp(stamp // NANOSECONDS, tz=timezone.utc)
    except (OverflowError, OSError, ValueError):
        return plain
    return f'{plain} ({moment:%Y-%m-%d %H:%M:%S} UTC)'
