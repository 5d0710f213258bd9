# SPDX-License-Identifier: Apache-2.0
"""Everything that can be had from one damaged MCAP file."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from blf_dsc_controller.bags.damage import Loss
from blf_dsc_controller.bags.mcap_records import (
    ATTACHMENT,
    CHANNEL,
    CHUNK,
    DATA_END,
    HEAD,
    MESSAGE,
    MESSAGE_INDEX,
    METADATA,
    SCHEMA,
    Attachment,
    Buffer,
    Channel,
    Chunk,
    Fields,
    MalformedRecordError,
    Message,
    Schema,
    attachment_of,
    channel_of,
    chunk_of,
    message_of,
    metadata_of,
    records_in,
    schema_of,
)
from blf_dsc_controller.bags.scan import Data, Gap, Record, scan

_INDEX_ENTRY = 16  # bytes of a message's time and place


@dataclass
class Salvage:
    """Reads a file once; afterwards the attributes are complete.

    Attributes:
        schemas: definitions by their number in the file.
        channels: topics by their number in the file.
        attachments: all that are whole.
        metadata: entries of every metadata record that is whole, the later over the earlier.
        losses: what is damaged.
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
    _lost_chunk: Loss | None = None
    _counts: list[tuple[Loss, int, int]] = field(default_factory=list)

    def messages(self, data: Data) -> Iterator[Message]:
        """Every message that is whole, in the order of the file."""
        for piece in scan(data):
            if isinstance(piece, Gap):
                if not self.is_complete:
                    self._lose(piece.at, piece.size, piece.reason)
                continue
            if piece.opcode == CHUNK:
                yield from self._chunk(piece, chunk_of(piece.content))
            elif piece.opcode == MESSAGE:
                yield from self._message(piece)
            else:
                self._take(piece)
        for loss, number, count in self._counts:
            loss.messages[self.topic(number)] = count

    def topic(self, number: int) -> str:
        """Name of a topic by its number in the file."""
        known = self.channels.get(number)
        return f'topic number {number}' if known is None else known.topic

    def _chunk(self, piece: Record, chunk: Chunk) -> Iterator[Message]:
        try:
            records = chunk.unpack()
        except MalformedRecordError as error:
            loss = self._lose(piece.at, len(piece.content), f'chunk: {error}')
            loss.start, loss.end = chunk.start, chunk.end
            self._lost_chunk = loss
            return
        self._lost_chunk = None
        try:
            for opcode, content in records_in(records):
                if opcode == MESSAGE:
                    message = message_of(content)
                    self._note(message)
                    yield message
                else:
                    self._define(opcode, content)
        except MalformedRecordError as error:
            self._lose(piece.at, len(piece.content), f'part of a chunk: {error}')

    def _message(self, piece: Record) -> Iterator[Message]:
        try:
            message = message_of(bytes(HEAD.size) + piece.content)
        except MalformedRecordError as error:
            self._lose(piece.at, len(piece.content), str(error))
            return
        self._note(message)
        yield message

    def _note(self, message: Message) -> None:
        if self.losses and self.losses[-1].end is None:
            self.losses[-1].end = message.log_time
        if self.last is None or message.log_time > self.last:
            self.last = message.log_time

    def _lose(self, at: int, size: int, reason: str) -> Loss:
        loss = Loss(self.path.name, at, size, reason, self.last)
        self.losses.append(loss)
        return loss

    def _take(self, piece: Record) -> None:
        if piece.opcode == DATA_END:
            self.is_complete = True
        elif piece.opcode == MESSAGE_INDEX:
            if self._lost_chunk is not None:
                fields = Fields(piece.content)
                number, size = fields.u16(), fields.u32()
                self._counts.append((self._lost_chunk, number, size // _INDEX_ENTRY))
        elif piece.opcode in (METADATA, ATTACHMENT):
            try:
                self._describe(piece)
            except MalformedRecordError as error:
                self._lose(piece.at, len(piece.content), f'attachment: {error}')
        else:
            self._define(piece.opcode, piece.content)

    def _describe(self, piece: Record) -> None:
        if piece.opcode == ATTACHMENT:
            self.attachments.append(attachment_of(piece.content))
        else:
            name, entries = metadata_of(piece.content)
            self.metadata.setdefault(name, {}).update(entries)

    def _define(self, opcode: int, content: Buffer) -> None:
        if opcode == SCHEMA:
            schema = schema_of(content)
            self.schemas[schema.id] = schema
        elif opcode == CHANNEL:
            channel = channel_of(content)
            self.channels[channel.id] = channel
