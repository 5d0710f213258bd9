# SPDX-License-Identifier: Apache-2.0
"""Recovery of a clean bag from a damaged one, which is only read.

Every chunk whose checksum matches is kept. After something unreadable, the next chunk is searched
for; it holds its length twice, so false matches are rare.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from itertools import chain
from mmap import ACCESS_READ, mmap
from pathlib import Path
from struct import Struct
from typing import Any, NamedTuple, TypeAlias
from zlib import crc32

import yaml
from mcap import records
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, Metadata, Schema, Statistics
from zstandard import FRAME_HEADER, ZstdDecompressor

from blf_dsc_controller.bags.sources import (
    HEAD,
    MAGIC_SIZE,
    RECORD,
    BagError,
    DamageError,
    next_record,
    records_in,
)
from blf_dsc_controller.bags.writer import BagWriter
from blf_dsc_controller.configuration.files import load_yaml
from blf_dsc_controller.messages.codecs import Definition

_CHUNK = Struct('<BQQQQII')  # up to the length of the compression's name
_END = Struct('<QQI')  # in the footer: begin of the topics and counts, and their checksum
_KINDS: dict[int, Any] = {
    opcode: getattr(records, opcode.name.title().replace('_', ''))
    for opcode in Opcode
    if opcode != Opcode.MESSAGE
}

_Known: TypeAlias = dict[tuple[type, int], Any]
"""Schemas and channels by their numbers."""


class Recovery(NamedTuple):
    """Result of a recovery."""

    messages: dict[str, int]  # in the clean bag, by topic
    losses: list[str]


def recover(path: Path, out: Path) -> Recovery:
    """Write what a damaged folder or MCAP file still holds to a clean bag `out`.

    Raises:
        BagError: there is no MCAP file, or `out` exists already.
    """
    files = [file for file in (path.glob('*.mcap') if path.is_dir() else [path]) if file.is_file()]
    if not files:
        raise BagError(f'{path} cannot be read as a bag: there is no MCAP file to recover')
    files.sort(key=lambda file: (len(file.name), file.name))  # bag_10 after bag_9
    with BagWriter(out, flush_interval=None) as bag:
        losses = [f'{file.name}: {loss}' for file in files for loss in _copied(file, bag)]
        bag.note({'recovered_from': str(path)})
    return Recovery(bag.message_counts, losses)


def _copied(path: Path, bag: BagWriter) -> Iterator[str]:
    """Copy what a damaged file holds to a clean bag, and yield its losses."""
    known: _Known = {}
    handles: dict[int, int] = {}  # by number of the channel; 0 where its topic is unknown
    found, stated = Counter[int](), Counter[int]()
    unknown, last, is_closed = 0, -1, False  # `last` is the latest time of a message [ns]
    with path.open('rb') as stream:
        data = mmap(stream.fileno(), 0, access=ACCESS_READ) if stream.seek(0, 2) else None
        for record in chain(_described(data), _records(data)) if data else ():
            if isinstance(record, tuple):
                number, sequence, received, published, raw = record
                found[number] += 1
                handles[number] = handles.get(number) or _handle(bag, known, number)
                if handles[number]:
                    last = max(last, received)
                    bag.write(handles[number], _plain(raw), received, published, sequence)
                else:
                    unknown += 1
            elif isinstance(record, (Schema, Channel)):
                known[type(record), record.id] = record
            elif isinstance(record, Statistics):
                stated = Counter(record.channel_message_counts)
            elif isinstance(record, Metadata) and record.name == RECORD:
                bag.note(record.metadata)
            elif isinstance(record, str) and not is_closed:
                yield record if last < 0 else f'{record}, after {last * 1e-9:.6f} s'
            is_closed |= isinstance(record, DataEnd)
    if not is_closed:
        ends = 'nothing in it could be read' if last < 0 else f'it ends at {last * 1e-9:.6f} s'
        yield (
            f'the recording was not closed; {ends}. Later messages are lost: usually the last '
            '0.1 s before a kill, more if the computer was overloaded or lost power'
        )
    if unknown:
        yield f'{unknown} messages of topics whose name or type is unknown'
    yield from _missing(known, found, stated)


def _missing(known: _Known, found: Counter[int], stated: Counter[int]) -> Iterator[str]:
    """Yield what is missing of the numbers of messages that are stated at the end of a file."""
    for number, count in (stated - found).items():
        topic = known[Channel, number].topic if (Channel, number) in known else f'{number}'
        yield f'{count} of {stated[number]} messages of {topic}'


def _plain(raw: bytes) -> bytes:
    """Return a message, which may be compressed by itself: CDR never begins like that."""
    return ZstdDecompressor().decompress(raw) if raw.startswith(FRAME_HEADER) else raw


def _handle(bag: BagWriter, known: _Known, number: int) -> int:
    """Return the handle of a channel in the clean bag, 0 if its topic or type is unknown."""
    channel: Any = known.get((Channel, number))
    schema: Any = channel and known.get((Schema, channel.schema_id))
    if schema is None:
        return 0
    earlier = [*bag.message_counts]  # from other files
    if channel.topic in earlier:
        return 1 + earlier.index(channel.topic)
    hash_, offered = channel.metadata.get('topic_type_hash', ''), None
    definition = Definition(schema.data.decode(errors='replace'), hash_, schema.encoding)
    with suppress(yaml.YAMLError):
        offered = load_yaml(channel.metadata.get('offered_qos_profiles', ''))
    profiles = offered if isinstance(offered, list) else []
    return bag.add_topic(channel.topic, schema.name, profiles, definition)


def _described(data: mmap) -> Iterator[Any]:
    """Yield the topics and counts at the end of a file if they match their checksum, or have none.

    Only there are the topics known if the first chunk is damaged.
    """
    start, _, checksum = _END.unpack(data[-MAGIC_SIZE - _END.size : -MAGIC_SIZE].ljust(_END.size))
    if checksum in (0, crc32(data[start : -MAGIC_SIZE - 4])):
        for record in _records(data, start):
            if isinstance(record, (Schema, Channel, Statistics)):
                yield record


def _records(data: mmap, at: int = MAGIC_SIZE) -> Iterator[Any]:
    """Yield each record, also those in chunks, and where and why something is none."""
    marks: set[tuple[int, ...]] = set()
    is_chunked = False
    while at < len(data):
        data.seek(at)
        try:
            record = next_record(data, len(data), _KINDS)
            if record is None or (is_chunked and isinstance(record, tuple)):
                raise DamageError(f'no record of type {data[at]} belongs here')  # noqa: TRY301
            end = data.tell()
        except Exception as error:  # noqa: BLE001 - anything, if the bytes are arbitrary
            record, end = f'{error}' or type(error).__name__, _next_chunk(data, at + 1)
        is_chunked |= isinstance(record, Chunk)
        for each in _content(record, marks) if isinstance(record, Chunk) else [record]:
            yield f'{end - at} bytes at byte {at} ({each})' if isinstance(each, str) else each
        at = end


def _content(chunk: Chunk, marks: set[tuple[int, ...]]) -> list[Any]:
    """Return the records in a chunk, or why it is lost; `marks` are those of the others."""
    try:
        content = [*records_in(chunk)]
    except Exception as error:  # noqa: BLE001 - as above
        return [f'{error}']
    mark = chunk.uncompressed_crc, chunk.message_start_time, len(chunk.data)
    if mark in marks and chunk.uncompressed_crc:
        return ['a chunk that the file holds twice']
    marks.add(mark)
    return content


def _next_chunk(data: mmap, at: int) -> int:
    """Return where the next chunk may begin, by its lengths; the end of the data if nowhere."""
    while 0 <= (at := data.find(b'\x06', at)) <= len(data) - _CHUNK.size:
        _, length, *_, name = _CHUNK.unpack_from(data, at)
        size = at + _CHUNK.size + name
        stated = int.from_bytes(data[size : size + 8], 'little')
        if name <= len('zstd') and size + 8 + stated == at + HEAD.size + length <= len(data):
            return at
        at += 1
    return len(data)
