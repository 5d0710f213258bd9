# SPDX-License-Identifier: Apache-2.0
"""Index at the end of a complete MCAP file: topics, message counts, offsets of records."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from heapq import heappop, heappush
from mmap import ACCESS_READ, MADV_DONTNEED, mmap
from operator import attrgetter, itemgetter
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, ChunkIndex, Metadata, Schema

from blf_dsc_controller.bags.folder import StoredTopic
from blf_dsc_controller.bags.mcap_reader import (
    MalformedRecordError,
    Piece,
    messages_in,
    read_messages,
    record_at,
    require_ends,
    scan,
    summary_start,
    unpack,
)
from blf_dsc_controller.bags.metadata import strongest_quality
from blf_dsc_controller.bags.unpacking import Unpacker

_INDEXES = (Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX)


def topics_of(path: Path) -> tuple[list[StoredTopic], tuple[int, int]]:
    """Return topics, time of the first message, and time after the last [ns].

    They are from the index at the end or, if that is incomplete, from all records of the file.

    Raises:
        MalformedRecordError: the file is damaged.
    """
    with _mapped(path) as data:
        content = _indexed(data)
        if not content.is_complete:
            content = _read(data, Unpacker([path]))
    schemas, times = content.schemas, content.times
    topics = [
        StoredTopic(
            one.topic,
            schemas[one.schema_id].name if one.schema_id in schemas else '',
            content.counts[number],
            strongest_quality(one.metadata.get('offered_qos_profiles')),
        )
        for number, one in content.channels.items()
    ]
    return topics, (min(times, default=0), max(times, default=-1) + 1)


@dataclass
class _Content:
    """Channels of a file, with message counts by channel number."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: Counter[int] = field(default_factory=Counter)
    times: list[int] = field(default_factory=list)  # of the first and last message [ns]

    @property
    def is_complete(self) -> bool:
        """Whether each message has its channel, and each channel its type."""
        needed = {one.schema_id for one in self.channels.values()} - {0}
        known = self.counts.keys() <= self.channels.keys() and needed <= self.schemas.keys()
        return bool(self.channels and self.times) and known


def _indexed(data: mmap) -> _Content:
    content = _Content()
    for piece in _summary(data):
        if piece.opcode == Opcode.SCHEMA:
            content.schemas[piece.record.id] = piece.record
        elif piece.opcode == Opcode.CHANNEL:
            content.channels[piece.record.id] = piece.record
        elif piece.opcode == Opcode.STATISTICS:
            content.counts.update(piece.record.channel_message_counts)
            content.times = [piece.record.message_start_time, piece.record.message_end_time]
    return content


def _read(data: mmap, unpacker: Unpacker) -> _Content:
    content = _Content()
    for piece in scan(data):
        records = piece.raw
        if piece.opcode == Opcode.DATA_END:
            break
        if piece.opcode == Opcode.CHUNK:
            records = unpack(piece.record, unpacker)
        elif piece.opcode not in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
            continue
        for number, _, at, *_ in messages_in(records, content.schemas, content.channels):
            content.counts[number] += 1
            content.times = [min([at, *content.times]), max([at, *content.times])]
    return content


def read_in_order(
    path: Path, topics: Collection[str], start: int, stop: int
) -> Iterator[tuple[str, int, bytes]]:
    """Yield topic, log time [ns] and content of messages from `start` to before `stop`, by time.

    Only overlapping chunks are in memory at a time; without an index, all messages are.

    Raises:
        MalformedRecordError: the file is damaged.
        BlfDscError: it unpacks to more than the limit.
    """
    unpacker, waiting, count = Unpacker([path]), list[tuple[int, int, str, bytes]](), 0
    with _mapped(path) as data:
        records = [piece.record for piece in _summary(data)]
        channels = {c.id: c for c in records if isinstance(c, Channel) and c.topic in topics}
        chunks = [one for one in records if isinstance(one, ChunkIndex)]
        if not chunks:
            found = sorted(read_messages(path, topics, unpacker), key=itemgetter(1))
            yield from (one for one in found if start <= one[1] < stop)
            return
        for chunk in sorted(chunks, key=attrgetter('message_start_time')):
            while waiting and waiting[0][0] < chunk.message_start_time:
                at, _, topic, raw = heappop(waiting)
                yield topic, at, raw
            if chunk.message_end_time < start or chunk.message_start_time >= stop:
                continue
            packed = record_at(data, chunk.chunk_start_offset).record
            if not isinstance(packed, Chunk):
                raise MalformedRecordError('the index does not point to a chunk')
            unpacked = unpack(packed, unpacker)
            for number, _, at, _, raw in messages_in(unpacked, {}, channels, topics):
                if start <= at < stop:
                    heappush(waiting, (at, count, channels[number].topic, raw))
                    count += 1
            data.madvise(MADV_DONTNEED)  # release the pages read
        while waiting:
            at, _, topic, raw = heappop(waiting)
            yield topic, at, raw


def context_records(path: Path) -> list[Attachment | Metadata]:
    """Return attachments and metadata of a file; MalformedRecordError if it is damaged."""
    unpacker, found = Unpacker([path]), []
    with _mapped(path) as data:
        pieces = _summary(data)
        indexed = (record_at(data, one.record.offset) for one in pieces if one.opcode in _INDEXES)
        for piece in indexed if pieces else scan(data):
            if isinstance(piece.record, (Attachment, Metadata)):
                unpacker.count(piece.size)  # an index may point to one record a thousand times
                found.append(piece.record)
    return found


@contextmanager
def _mapped(path: Path) -> Iterator[mmap]:
    with path.open('rb') as stream:
        if not stream.read(1):
            raise MalformedRecordError('the file is empty')
        with mmap(stream.fileno(), 0, access=ACCESS_READ) as data:
            yield data


def _summary(data: mmap) -> list[Piece]:
    """Return the records of the index at the end, none if there is no valid index."""
    require_ends(data)
    start = summary_start(data)
    if start is None:
        raise MalformedRecordError('its last record is not the footer of an MCAP file')
    pieces = list(scan(data, start)) if start else []
    return [] if any(piece.reason for piece in pieces) else pieces
