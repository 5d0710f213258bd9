# SPDX-License-Identifier: Apache-2.0
"""Recovery of a clean bag from a damaged one, which is only read.

Every chunk whose checksum matches is kept, wherever it is: after something unreadable, the next
chunk is searched for. A chunk holds its length twice, so false matches are rare.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from datetime import datetime, timezone
from io import BytesIO
from mmap import ACCESS_READ, mmap
from pathlib import Path
from struct import Struct
from typing import Any, NamedTuple

import yaml
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, Message, Metadata, Schema, Statistics
from zstandard import FRAME_HEADER, ZstdDecompressor, frame_content_size

from blf_dsc_controller.bags.mcap_file import (
    Allowance,
    DamageError,
    StoredMessage,
    records_in,
    unpack,
)
from blf_dsc_controller.bags.sources import MESSAGES, RECORD, BagError, checked_files
from blf_dsc_controller.bags.writer import BagWriter
from blf_dsc_controller.configuration.files import load_yaml
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.codecs import NANOSECONDS
from blf_dsc_controller.messages.types import Definition, UnknownTypeError, definition

_MAGIC_SIZE = 8
_CHUNK = Struct('<BQQQQII')  # up to the length of the compression's name
_COMPRESSIONS = (b'', b'zstd', b'lz4')
_KINDS: dict[int, Any] = {
    opcode: getattr(records, ''.join(part.title() for part in opcode.name.split('_')))
    for opcode in Opcode
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
        BlfDscError: it unpacks to more than the limit.
        OSError: a file is not a regular file, or is outside of the folder.
    """
    files = [file for file in checked_files(path) if file.suffix == '.mcap' and file.exists()]
    if not files:
        raise BagError(f'{path} cannot be read as a bag: there is no MCAP file to recover')
    files.sort(key=lambda file: (len(file.name), file.name))  # bag_10 after bag_9
    allowance, losses = Allowance(path), list[str]()
    with BagWriter(out, flush_interval=None) as bag:
        for file in files:
            losses += _DamagedFile(file, allowance, bag).copy()
        bag.note({'recovered_from': str(path)})
    return Recovery(out, bag.message_counts, losses)


class _DamagedFile:
    """Transfer of the content of one damaged file to a clean bag."""

    def __init__(self, path: Path, allowance: Allowance, bag: BagWriter) -> None:
        self._path, self._allowance, self._bag = path, allowance, bag
        self._losses: list[str] = []
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._handles: dict[int, int] = {}
        self._found: Counter[int] = Counter()
        self._seen: set[tuple[int, ...]] = set()
        self._stated: Counter[int] = Counter()
        self._last: int | None = None  # latest time of a message [ns]

    def copy(self) -> list[str]:
        """Copy the file, and return its losses."""
        with self._path.open('rb') as stream:
            data = mmap(stream.fileno(), 0, access=ACCESS_READ) if stream.seek(0, 2) else b''
            for record, _, _ in _scan(data):  # topics may only be known from the end
                if isinstance(record, (Schema, Channel, Statistics)):
                    self._take(record)
            is_closed = False
            for record, at, end in _scan(data):
                is_closed |= isinstance(record, DataEnd)
                if isinstance(record, str) and not is_closed:
                    self._lose(at, end - at, record)
                elif isinstance(record, Chunk):
                    self._copy_chunk(record, at, end)
                else:
                    self._take(record)
        if not is_closed:
            how = 'nothing in it could be read'
            if self._last is not None:
                how = f'it ends at {format_time(self._last)}'
            self._losses.append(
                f'{self._path.name}: the recording was not closed; {how}. Later messages are lost: '
                'usually the last 0.1 s before a kill, more if the computer was overloaded or lost '
                'power'
            )
        return [*self._losses, *self._uncopied()]

    def _uncopied(self) -> Iterator[str]:
        """Yield how many messages of each topic are not in the clean bag."""
        for number in self._found | self._stated:
            count, found = self._stated[number], self._found[number]
            if number not in self._handles and found:
                lost = f'{found} messages of topics whose name or type is unknown'
                yield f'{self._path.name}: {lost}'
            elif count > found:
                topic = self._channels[number].topic if number in self._channels else f'{number}'
                yield f'{self._path.name}: {count - found} of {count} messages of {topic}'

    def _copy_chunk(self, chunk: Chunk, at: int, end: int) -> None:
        """Copy a chunk if its checksum matches and the file did not hold it before."""
        mark = chunk.uncompressed_crc, chunk.message_start_time, len(chunk.data)
        if mark in self._seen and chunk.uncompressed_crc:
            self._lose(at, end - at, 'a chunk that the file holds twice')
            return
        try:
            found = [*records_in(unpack(chunk, self._allowance))]
        except BlfDscError:
            raise
        except Exception as error:  # noqa: BLE001 - anything, if the bytes are arbitrary
            self._lose(at, end - at, f'{error}')
            return
        self._seen.add(mark)
        for record in found:
            self._take(record)

    def _take(self, record: Any) -> None:
        """Write a message, or note what is known of the topics and the run."""
        if isinstance(record, tuple):
            self._write(record)
        elif isinstance(record, Message):
            times = record.log_time, record.publish_time
            self._write((record.channel_id, record.sequence, *times, record.data))
        elif isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            self._channels[record.id] = record
        elif isinstance(record, Statistics):
            self._stated = Counter(record.channel_message_counts)
        elif isinstance(record, Metadata) and record.name == RECORD:
            facts = record.metadata.items()
            self._bag.note({k: v for k, v in facts if not k.startswith(MESSAGES)})

    def _write(self, message: StoredMessage) -> None:
        number, sequence, log_time, publish_time, raw = message
        self._found[number] += 1
        if number not in self._handles:
            handle = self._add_topic(number)
            if handle is None:
                return
            self._handles[number] = handle
        self._last = max(log_time, self._last or log_time)
        if raw.startswith(FRAME_HEADER):  # compressed by itself, as CDR never is
            self._allowance.take(max(0, frame_content_size(raw)))
            raw = ZstdDecompressor().decompress(raw)
        self._bag.write(self._handles[number], raw, log_time, publish_time, sequence)

    def _add_topic(self, number: int) -> int | None:
        """Add a topic to the clean bag and return its handle; None if it is unknown."""
        channel = self._channels.get(number)
        schema = None if channel is None else self._schemas.get(channel.schema_id)
        if channel is None or schema is None:
            return None
        if channel.topic in self._bag.message_counts:  # in an earlier file
            return 1 + [*self._bag.message_counts].index(channel.topic)
        known = Definition('', '')
        with suppress(UnknownTypeError):
            known = definition(schema.name)
        if schema.data:
            text = schema.data.decode(errors='replace')
            known = known._replace(text=text, encoding=schema.encoding)
        known = known._replace(hash=channel.metadata.get('topic_type_hash') or known.hash)
        offered: Any = None
        with suppress(yaml.YAMLError):
            offered = load_yaml(channel.metadata.get('offered_qos_profiles', ''))
        offered = offered if isinstance(offered, list) else []
        return self._bag.add_topic(channel.topic, schema.name, offered, known)

    def _lose(self, at: int, size: int, reason: str) -> None:
        after = '' if self._last is None else f', after {format_time(self._last)}'
        self._losses.append(f'{self._path.name}: {size} bytes at byte {at} ({reason}){after}')


def _scan(data: bytes | mmap) -> Iterator[tuple[Any, int, int]]:
    """Yield each record with its begin and end, or why something is none."""
    at, is_chunked = _MAGIC_SIZE, False
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
    opcode, length = data[at], int.from_bytes(data[at + 1 : at + 9], 'little')
    end = at + 9 + length
    if at + 9 > len(data) or end > len(data):
        raise DamageError('cut off')
    if opcode not in _KINDS or (is_chunked and opcode == Opcode.MESSAGE):
        raise DamageError(f'no record of type {opcode} belongs here')
    stream, kind = ReadDataStream(BytesIO(data[at + 9 : end])), _KINDS[opcode]
    record = kind.read(stream, length) if kind is Message else kind.read(stream)
    if stream.count != length:
        raise DamageError('a record does not match its length')
    return record, end


def _next_chunk(data: bytes | mmap, begin: int) -> int:
    """Return where the next chunk may begin, by its lengths; the end of the data if nowhere."""
    at = data.find(b'\x06', begin)
    while at >= 0:
        if at + _CHUNK.size <= len(data):
            _, length, *_, name = _CHUNK.unpack_from(data, at)
            named = at + _CHUNK.size
            size = int.from_bytes(data[named + name : named + name + 8], 'little')
            ends = named + name + 8 + size == at + 9 + length <= len(data)
            if ends and data[named : named + name] in _COMPRESSIONS:
                return at
        at = data.find(b'\x06', at + 1)
    return len(data)


def format_time(stamp: int) -> str:
    """Format a log time [ns] as seconds and UTC; as seconds only if UTC is out of range."""
    plain = f'{stamp // NANOSECONDS}.{stamp % NANOSECONDS:09d} s'
    with suppress(OverflowError, OSError, ValueError):
        moment = datetime.fromtimestamp(stamp // NANOSECONDS, tz=timezone.utc)
        return f'{plain} ({moment:%Y-%m-%d %H:%M:%S} UTC)'
    return plain
