# SPDX-License-Identifier: Apache-2.0
"""Recovery of a clean bag from a damaged one, which is only read.

Every chunk whose checksum matches is kept. After something unreadable, the next chunk is searched
for; it holds its length twice, so false matches are rare.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from io import BytesIO
from mmap import ACCESS_READ, mmap
from pathlib import Path
from struct import Struct
from typing import Any, NamedTuple
from zlib import crc32

import yaml
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, Metadata, Schema, Statistics
from zstandard import FRAME_HEADER, ZstdDecompressor

from blf_dsc_controller.bags.sources import (
    HEAD,
    MAGIC_SIZE,
    MESSAGES,
    RECORD,
    BagError,
    DamageError,
    message_of,
    records_in,
)
from blf_dsc_controller.bags.writer import BagWriter
from blf_dsc_controller.configuration.files import load_yaml
from blf_dsc_controller.messages.codecs import Definition

_CHUNK = Struct('<BQQQQII')  # up to the length of the compression's name
_END = Struct('<QQI')  # in the footer: begin of the topics and counts, and their checksum
_KINDS: dict[int, Any] = {
    opcode: getattr(records, opcode.name.title().replace('_', '')) for opcode in Opcode
}


class Recovery(NamedTuple):
    """Result of a recovery."""

    path: Path  # of the clean bag
    messages: dict[str, int]  # recovered, by topic
    losses: list[str]

    @property
    def is_empty(self) -> bool:
        """Whether everything is lost."""
        return bool(self.losses) and not any(self.messages.values())


def recover(path: Path, out: Path) -> Recovery:
    """Write what a damaged folder or MCAP file still holds to a clean bag `out`.

    Raises:
        BagError: there is no MCAP file, or `out` exists already.
    """
    files = [file for file in (path.glob('*.mcap') if path.is_dir() else [path]) if file.is_file()]
    if not files:
        raise BagError(f'{path} cannot be read as a bag: there is no MCAP file to recover')
    files.sort(key=lambda file: (len(file.name), file.name))  # bag_10 after bag_9
    losses = []
    with BagWriter(out, flush_interval=None) as bag:
        for file in files:
            losses += [f'{file.name}: {loss}' for loss in _Copy(bag).of(file)]
        bag.note({'recovered_from': str(path)})
    return Recovery(out, bag.message_counts, losses)


class _Copy:
    """Copy of what one damaged file holds to a clean bag."""

    def __init__(self, bag: BagWriter) -> None:
        self._bag = bag
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._handles: dict[int, int] = {}
        self._found: Counter[int] = Counter()
        self._stated: Counter[int] = Counter()
        self._seen: set[tuple[int, ...]] = set()  # marks of chunks
        self._last = -1  # latest time of a message [ns]

    def of(self, path: Path) -> Iterator[str]:
        """Copy a file, and yield its losses."""
        is_closed = False
        with path.open('rb') as stream:
            data = mmap(stream.fileno(), 0, access=ACCESS_READ) if stream.seek(0, 2) else b''
            for record, *_ in _scan(data) if _has_intact_end(data) else ():
                if isinstance(record, (Schema, Channel, Statistics)):
                    self._take(record)
            for record, at, end in _scan(data):
                problem = self._take_chunk(record) if isinstance(record, Chunk) else record
                if problem is record and not isinstance(record, str):
                    self._take(record)
                elif problem and not is_closed:
                    after = '' if self._last < 0 else f', after {self._last * 1e-9:.6f} s'
                    yield f'{end - at} bytes at byte {at} ({problem}){after}'
                is_closed |= isinstance(record, DataEnd)
        if not is_closed:
            ends = f'it ends at {self._last * 1e-9:.6f} s'
            ends = 'nothing in it could be read' if self._last < 0 else ends
            yield (
                f'the recording was not closed; {ends}. Later messages are lost: usually the last '
                '0.1 s before a kill, more if the computer was overloaded or lost power'
            )
        unknown = sum(n for number, n in self._found.items() if number not in self._handles)
        if unknown:
            yield f'{unknown} messages of topics whose name or type is unknown'
        for number, count in (self._stated - self._found).items():
            topic = self._channels[number].topic if number in self._channels else f'{number}'
            yield f'{count} of {self._stated[number]} messages of {topic}'

    def _take_chunk(self, chunk: Chunk) -> str:
        """Take the content of a chunk; return why it is lost, or nothing."""
        try:
            content = [*records_in(chunk)]
        except Exception as error:  # noqa: BLE001 - anything, if the bytes are arbitrary
            return f'{error}'
        mark = chunk.uncompressed_crc, chunk.message_start_time, len(chunk.data)
        if mark in self._seen and chunk.uncompressed_crc:
            return 'a chunk that the file holds twice'
        self._seen.add(mark)
        for record in content:
            self._take(record)
        return ''

    def _take(self, record: Any) -> None:
        """Write a message, or note what is known of the topics and the run."""
        if isinstance(record, tuple):
            number, sequence, received, published, raw = record
            self._found[number] += 1
            if number in self._handles or self._add_topic(number):
                self._last = max(self._last, received)
                if raw.startswith(FRAME_HEADER):  # compressed by itself, as CDR never is
                    raw = ZstdDecompressor().decompress(raw)
                self._bag.write(self._handles[number], raw, received, published, sequence)
        elif isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            self._channels[record.id] = record
        elif isinstance(record, Statistics):
            self._stated = Counter(record.channel_message_counts)
        elif isinstance(record, Metadata) and record.name == RECORD:
            facts = record.metadata.items()
            self._bag.note({k: v for k, v in facts if not k.startswith(MESSAGES)})

    def _add_topic(self, number: int) -> bool:
        """Add a topic to the clean bag; return False if it is unknown."""
        channel = self._channels.get(number)
        schema = None if channel is None else self._schemas.get(channel.schema_id)
        if channel is None or schema is None:
            return False
        earlier = [*self._bag.message_counts]  # from other files
        if channel.topic in earlier:
            self._handles[number] = 1 + earlier.index(channel.topic)
            return True
        hash_ = channel.metadata.get('topic_type_hash', '')
        known = Definition(schema.data.decode(errors='replace'), hash_, schema.encoding)
        offered: Any = None
        with suppress(yaml.YAMLError):
            offered = load_yaml(channel.metadata.get('offered_qos_profiles', ''))
        self._handles[number] = self._bag.add_topic(
            channel.topic, schema.name, offered if isinstance(offered, list) else [], known
        )
        return True


def _scan(data: bytes | mmap) -> Iterator[tuple[Any, int, int]]:
    """Yield each record with its begin and end, or why something is none."""
    at, is_chunked = MAGIC_SIZE, False
    while at < len(data):
        try:
            record, end = _record(data, at, is_chunked=is_chunked)
        except Exception as error:  # noqa: BLE001 - as above
            record, end = f'{error}' or type(error).__name__, _next_chunk(data, at + 1)
        yield record, at, end
        is_chunked |= isinstance(record, Chunk)
        at = end


def _record(data: bytes | mmap, at: int, *, is_chunked: bool) -> tuple[Any, int]:
    """Return the record at an offset, and its end; any error if it does not match its length."""
    opcode, length = HEAD.unpack(data[at : at + HEAD.size].ljust(HEAD.size, b'\xff'))
    begin, end = at + HEAD.size, at + HEAD.size + length
    if end > len(data):
        raise DamageError('cut off')
    if opcode == Opcode.MESSAGE and not is_chunked:
        return message_of(data[begin:end]), end
    if opcode not in _KINDS or opcode == Opcode.MESSAGE:
        raise DamageError(f'no record of type {opcode} belongs here')
    stream = ReadDataStream(BytesIO(data[begin:end]))
    record = _KINDS[opcode].read(stream)
    if stream.count != length:
        raise DamageError('a record does not match its length')
    return record, end


def _has_intact_end(data: bytes | mmap) -> bool:
    """Return whether the topics and counts at the end of a file match their checksum, or have none.

    Only there are the topics known if the first chunk is damaged.
    """
    if len(data) < MAGIC_SIZE + _END.size:
        return False
    start, _, checksum = _END.unpack_from(data, len(data) - MAGIC_SIZE - _END.size)
    return checksum in (0, crc32(data[start : -MAGIC_SIZE - 4]))


def _next_chunk(data: bytes | mmap, at: int) -> int:
    """Return where the next chunk may begin, by its lengths; the end of the data if nowhere."""
    while 0 <= (at := data.find(b'\x06', at)) <= len(data) - _CHUNK.size:
        _, length, *_, name = _CHUNK.unpack_from(data, at)
        size = at + _CHUNK.size + name
        stated = int.from_bytes(data[size : size + 8], 'little')
        if name <= len('zstd') and size + 8 + stated == at + HEAD.size + length <= len(data):
            return at
        at += 1
    return len(data)
