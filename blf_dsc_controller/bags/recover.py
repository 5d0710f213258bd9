# SPDX-License-Identifier: Apache-2.0
"""Recovery of a clean bag from a damaged one, which is only read.

Every chunk whose checksum matches is kept, wherever it is: after something unreadable, the next
chunk is searched for. A chunk holds its length twice, so false matches are rare.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime, timezone
from io import BytesIO
from mmap import ACCESS_READ, mmap
from pathlib import Path
from struct import Struct
from typing import Any

from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, Message, Metadata, Schema, Statistics
from zstandard import ZstdError

from blf_dsc_controller.bags.mcap_file import (
    Allowance,
    DamageError,
    StoredMessage,
    mcap_files,
    records_in,
    unpack,
    unpacked,
)
from blf_dsc_controller.bags.metadata import parse_qualities
from blf_dsc_controller.bags.sources import MESSAGES, RECORD, BagError, checked
from blf_dsc_controller.bags.writer import BagWriter, Losses, statistics
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.cdr import NANOSECONDS
from blf_dsc_controller.messages.types import Definition, UnknownTypeError, definition

_MAGIC_SIZE = 8
_CHUNK = Struct('<BQQQQII')  # up to the length of the compression's name
_COMPRESSIONS = (b'', b'zstd', b'lz4')
_KINDS: dict[int, Any] = {
    opcode: getattr(records, ''.join(part.title() for part in opcode.name.split('_')))
    for opcode in Opcode
}


@dataclass
class Recovery:
    """Result of a recovery."""

    path: Path  # of the clean bag
    messages: dict[str, int] = field(default_factory=dict)  # recovered, by topic
    missing: dict[str, Losses] = field(default_factory=dict)  # from sequence numbers, by topic
    losses: list[str] = field(default_factory=list)
    unfinished: list[tuple[str, int | None]] = field(default_factory=list)  # file, last time [ns]
    unknown: int = 0  # messages of topics whose name or type is lost

    @property
    def is_whole(self) -> bool:
        """Whether no loss is known."""
        return not (self.losses or self.unfinished or self.unknown)

    @property
    def is_empty(self) -> bool:
        """Whether everything is lost."""
        return not (self.is_whole or any(self.messages.values()))


def recover(path: Path, out: Path) -> Recovery:
    """Write what a damaged folder or MCAP file still holds to a clean bag `out`.

    Raises:
        BagError: there is no MCAP file, or `out` exists already.
        BlfDscError: it unpacks to more than the limit.
        OSError: a file is not a regular file, or is outside of the folder.
    """
    files = [file for file in mcap_files(path) if file.exists() and file.suffix == '.mcap']
    if not files:
        raise BagError(f'{path} cannot be read as a bag: there is no MCAP file to recover')
    allowance = Allowance(checked(path, files))
    recovery = Recovery(out)
    with BagWriter(out, flush_interval=None) as bag:
        for file in files:
            _Salvage(file, allowance, bag, recovery).run()
        recovery.messages = bag.message_counts
        bag.note({'recovered_from': str(path)} | statistics(bag.message_counts, recovery.missing))
    return recovery


class _Salvage:
    """Transfer of the content of one damaged file to a clean bag."""

    def __init__(self, path: Path, allowance: Allowance, bag: BagWriter, to: Recovery) -> None:
        self._path, self._allowance, self._bag, self._to = path, allowance, bag, to
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._handles: dict[int, int | None] = {}
        self._found: Counter[int] = Counter()
        self._seen: set[tuple[int, ...]] = set()
        self._stated: Counter[int] = Counter()
        self._last: int | None = None  # latest time of a message [ns]

    def run(self) -> None:
        """Copy the file, and add its losses."""
        with self._path.open('rb') as stream:
            is_empty = self._path.stat().st_size == 0
            data = b'' if is_empty else mmap(stream.fileno(), 0, access=ACCESS_READ)
            for record, _, _ in self._scan(data):  # topics may only be known from the end
                if isinstance(record, (Schema, Channel, Statistics)):
                    self._take(record)
            if not self._copy_all(data):
                self._to.unfinished.append((self._path.name, self._last))
        for number, count in self._stated.items():
            if count > self._found[number]:
                lost = f'{count - self._found[number]} of {count} messages'
                topic = self._channels[number].topic if number in self._channels else number
                self._to.losses.append(f'{self._path.name}: {lost} of {topic}')

    def _copy_all(self, data: bytes | mmap) -> bool:
        """Copy the messages; return whether the recording was closed."""
        for record, at, end in self._scan(data):
            if isinstance(record, DataEnd):
                return True
            if isinstance(record, str):
                self._lose(at, end - at, record)
            elif isinstance(record, Chunk):
                self._copy(record, at, end)
            elif isinstance(record, Message):
                times = record.log_time, record.publish_time
                self._take((record.channel_id, record.sequence, *times, record.data))
            else:
                self._take(record)
        return False

    def _scan(self, data: bytes | mmap) -> Iterator[tuple[Any, int, int]]:
        """Yield each record with its begin and end, or why something is none."""
        at = unsure = _MAGIC_SIZE
        is_chunked = False
        while at < len(data):
            try:
                record, end = _record(data, at)
                problem = is_chunked and isinstance(record, Message)
                reason = 'a message between the chunks' if problem else ''
            except Exception as error:  # noqa: BLE001 - anything, if the bytes are arbitrary
                reason = f'{error}' or type(error).__name__
            if reason:
                end = _next_chunk(data, unsure + 1)
                yield reason, at, end
                at = unsure = end
                continue
            yield record, at, end
            is_chunked |= isinstance(record, Chunk)
            # The length of another record than a chunk may be wrong: search from its begin then.
            unsure = end if isinstance(record, Chunk) else at
            at = end

    def _copy(self, chunk: Chunk, at: int, end: int) -> None:
        """Copy a chunk if its checksum matches and the file did not hold it before."""
        mark = chunk.uncompressed_crc, chunk.message_start_time, len(chunk.data)
        if mark in self._seen and chunk.uncompressed_crc:
            self._lose(at, end - at, 'a chunk that the file holds twice')
            return
        try:
            found = [*records_in(unpack(chunk, self._allowance))]
        except BlfDscError:
            raise
        except Exception as error:  # noqa: BLE001 - as above
            self._lose(at, end - at, f'{error}')
            return
        self._seen.add(mark)
        for record in found:
            self._take(record)

    def _take(self, record: Any) -> None:
        """Write a message, or note what is known of the topics and the run."""
        if isinstance(record, tuple):
            self._write(record)
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
        if number not in self._handles and number in self._channels:
            self._handles[number] = self._add_topic(self._channels[number])
        handle = self._handles.get(number)
        if handle is None:
            self._to.unknown += 1
            return
        self._found[number] += 1
        self._last = max(log_time, self._last or log_time)
        self._to.missing[self._channels[number].topic].count(sequence)
        with suppress(ZstdError):
            raw = unpacked(raw, self._allowance)
        self._bag.write(handle, raw, log_time, publish_time, sequence)

    def _add_topic(self, channel: Channel) -> int | None:
        schema = self._schemas.get(channel.schema_id)
        if schema is None:
            return None
        if channel.topic in self._bag.message_counts:  # in an earlier file
            return 1 + [*self._bag.message_counts].index(channel.topic)
        try:
            known = definition(schema.name)
        except UnknownTypeError:
            known = Definition('', '')
        if schema.data:
            text = schema.data.decode(errors='replace')
            known = known._replace(text=text, encoding=schema.encoding)
        known = known._replace(hash=channel.metadata.get('topic_type_hash') or known.hash)
        offered = parse_qualities(channel.metadata.get('offered_qos_profiles', ''))
        self._to.missing[channel.topic] = Losses(len(offered))
        return self._bag.add_topic(channel.topic, schema.name, offered, known)

    def _lose(self, at: int, size: int, reason: str) -> None:
        after = '' if self._last is None else f', after {format_time(self._last)}'
        self._to.losses.append(f'{self._path.name}: {size} bytes at byte {at} ({reason}){after}')


def _record(data: bytes | mmap, at: int) -> tuple[Any, int]:
    """Return the record at an offset, and its end; any error if it does not match its length."""
    opcode, length = data[at], int.from_bytes(data[at + 1 : at + 9], 'little')
    end = at + 9 + length
    if at + 9 > len(data) or end > len(data):
        raise DamageError('cut off')
    if opcode not in _KINDS:
        raise DamageError(f'unknown record type {opcode}')
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
    try:
        moment = datetime.fromtimestamp(stamp // NANOSECONDS, tz=timezone.utc)
    except (OverflowError, OSError, ValueError):
        return plain
    return f'{plain} ({moment:%Y-%m-%d %H:%M:%S} UTC)'
