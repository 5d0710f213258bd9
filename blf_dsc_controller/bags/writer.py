# SPDX-License-Identifier: Apache-2.0
"""Writer of bags like those of `ros2 bag record`: a folder of metadata.yaml and MCAP files.

It also makes a clean bag of a damaged one, which is only read. Every chunk whose checksum matches
is kept. After a record that cannot be read, the next chunk is where the index at the end of the
file says; without that index, as after a kill, the rest is lost.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import asdict, dataclass
from io import SEEK_END
from math import inf
from pathlib import Path
from struct import Struct
from time import monotonic
from typing import Any, BinaryIO, NamedTuple
from zlib import crc32

import yaml
from mcap import records
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, DataEnd, Schema, Statistics
from mcap.summary import Summary
from mcap.writer import CompressionType, Writer
from zstandard import FRAME_HEADER, ZstdDecompressor

from blf_dsc_controller import __version__
from blf_dsc_controller.bags.sources import (
    MAGIC_SIZE,
    METADATA,
    BagError,
    next_record,
    records_in,
)
from blf_dsc_controller.configuration.files import load_yaml
from blf_dsc_controller.messages.codecs import NANOSECONDS, Definition, definition
from blf_dsc_controller.messages.topics import FOREVER, Quality

_CHUNK_SIZE = 1 << 20
_MOST_CHUNKS = 10_000  # in a file, whose index is kept in memory until it ends
_DURATIONS = ('deadline', 'lifespan', 'liveliness_lease_duration')


@dataclass
class _File:
    """A file of the bag."""

    name: str
    start: int = FOREVER  # ns, of its first message
    end: int = 0  # ns, of its last
    messages: int = 0


def _period(files: Sequence[_File]) -> dict[str, Any]:
    """Return the time from the first message to the last, as rosbag2 writes it."""
    start, end = min(file.start for file in files), max(file.end for file in files)
    return {
        'duration': {'nanoseconds': max(end - start, 0)},
        'starting_time': {'nanoseconds_since_epoch': start},
    }


def _profile(quality: Quality) -> dict[str, Any]:
    """Return a quality of service as rosbag2 writes it, in its order."""
    profile = {'history': quality.history, **asdict(quality)}
    for name in _DURATIONS:
        profile[name] = dict(zip(('sec', 'nsec'), divmod(profile[name], NANOSECONDS), strict=True))
    return {**profile, 'avoid_ros_namespace_conventions': False}


def _dump(tree: object) -> str:
    return str(yaml.safe_dump(tree, sort_keys=False, allow_unicode=True, width=2**20))


class BagWriter(AbstractContextManager['BagWriter']):
    """Writer of serialised messages to a new bag.

    Data leaves the process within `flush_interval` [s] plus the time to the next call of `write` or
    `flush_if_due`, and then survives a kill of the process. Without an interval it leaves when a
    chunk is full. The compression of chunks is `none` or `zstd`. A file ends after 10,000 chunks.
    After an OSError, such as that of a full disk, `recover` saves what was written before.

    Raises:
        BagError: `path` exists already.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        compression: str = 'none',
        flush_interval: float | None = 0.1,
    ) -> None:
        self.path = Path(path)
        self.closed = False
        self._compression = CompressionType[compression.upper()]
        self._flush_interval = inf if flush_interval is None else flush_interval
        self._topics: list[dict[str, Any]] = []  # as in metadata.yaml, with definitions beside
        self._definitions: list[Definition] = []
        self._files: list[_File] = []
        try:
            self.path.mkdir(parents=True)
        except FileExistsError:
            raise BagError(
                f'{path} exists already and is not overwritten: choose another folder or remove it'
            ) from None
        self._flushed = monotonic()
        self._begin_file()

    def add_topic(
        self,
        name: str,
        type_name: str,
        offered: Sequence[Quality | dict[str, Any]],
        known: Definition | None = None,
    ) -> int:
        """Add a topic by its full name, with the quality of service of each publisher.

        A quality may also be plain data, as in another bag. Returns the handle for `write`.

        Raises:
            UnknownTypeError: no definition is given and the type is not one of Jazzy's common ones.
        """
        found = definition(type_name) if known is None else known
        profiles = [_profile(each) if isinstance(each, Quality) else each for each in offered]
        metadata = {
            'name': name,
            'type': type_name,
            'serialization_format': 'cdr',
            'offered_qos_profiles': profiles,
            'type_description_hash': found.hash,
        }
        self._topics.append({'topic_metadata': metadata, 'message_count': 0})
        self._definitions.append(found)
        return self._add_channel(metadata, found)

    def write(
        self,
        handle: int,
        raw: bytes,
        log_time: int,
        publish_time: int | None = None,
        sequence: int = 0,
    ) -> None:
        """Write one serialised message.

        It was received at `log_time` [ns] and published at `publish_time` [ns], or `log_time` if
        not known, with the `sequence` number of the publisher, 0 if not known.
        """
        if self._chunks >= _MOST_CHUNKS:
            self._end_file()
            self._begin_file()
        published = log_time if publish_time is None else publish_time
        self._writer.add_message(handle, log_time, raw, published, sequence)
        self._topics[handle - 1]['message_count'] += 1
        file = self._files[-1]
        file.start, file.end = min(file.start, log_time), max(file.end, log_time)
        file.messages += 1
        self.flush_if_due()

    def flush_if_due(self) -> None:
        """Flush if the flush interval has passed."""
        if monotonic() - self._flushed >= self._flush_interval:
            self.flush()

    def flush(self) -> None:
        """Pass everything written so far to the operating system."""
        if not self.closed:  # a timer may fire once more
            self._end_chunk()
            self._flushed = monotonic()

    def close(self) -> None:
        """Complete the bag; a second call does nothing."""
        if self.closed:
            return
        self.closed = True
        self._end_file()
        text = _dump({'rosbag2_bagfile_information': self._information()})
        (self.path / METADATA).write_text(text, encoding='utf-8')

    @property
    def message_counts(self) -> dict[str, int]:
        """Messages written so far, by topic."""
        return {topic['topic_metadata']['name']: topic['message_count'] for topic in self._topics}

    def __exit__(self, *_: object) -> None:
        self.close()

    def _begin_file(self) -> None:
        """Begin the next file, with the topics of the previous one."""
        self._files.append(_File(f'{self.path.name}_{len(self._files)}.mcap'))
        self._stream = (self.path / self._files[-1].name).open('xb')
        self._writer = Writer(self._stream, chunk_size=_CHUNK_SIZE, compression=self._compression)
        self._writer.start(profile='ros2', library=f'blf_dsc_controller {__version__}')
        self._schemas: dict[str, int] = {}
        self._chunks = 0
        for topic, found in zip(self._topics, self._definitions, strict=True):
            self._add_channel(topic['topic_metadata'], found)

    def _information(self) -> dict[str, Any]:
        """Return rosbag2's metadata, version 9 (that of Jazzy), in its order.

        The compression fields are those of rosbag2's own compression of whole files.
        """
        return {
            'version': 9,
            'storage_identifier': 'mcap',
            **_period(self._files),
            'message_count': sum(file.messages for file in self._files),
            'topics_with_message_count': self._topics,
            'compression_format': '',
            'compression_mode': '',
            'relative_file_paths': [file.name for file in self._files],
            'files': [
                {'path': file.name, **_period([file]), 'message_count': file.messages}
                for file in self._files
            ],
            'custom_data': {},
            'ros_distro': 'jazzy',
        }

    def _add_channel(self, topic: dict[str, Any], known: Definition) -> int:
        """Add a topic to the file and return its number, the same in each file."""
        type_name = topic['type']
        if type_name not in self._schemas:
            schema = self._writer.register_schema(type_name, known.encoding, known.text.encode())
            self._schemas[type_name] = schema
        metadata = {
            'offered_qos_profiles': _dump(topic['offered_qos_profiles']),
            'topic_type_hash': known.hash,
        }
        schema = self._schemas[type_name]
        return self._writer.register_channel(topic['name'], 'cdr', schema, metadata)

    def _end_chunk(self) -> None:
        before = self._stream.tell()
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._stream.flush()
        self._chunks += self._stream.tell() > before

    def _end_file(self) -> None:
        self._end_chunk()
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._stream.close()


# Recovery.

_END = Struct('<QQI')  # in the footer: begin of the summary and its offsets, and their checksum
_KINDS: dict[int, Any] = {
    opcode: getattr(records, opcode.name.title().replace('_', ''))
    for opcode in Opcode
    if opcode != Opcode.MESSAGE
}


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
    return Recovery(bag.message_counts, losses)


def _copied(path: Path, bag: BagWriter) -> Iterator[str]:
    """Copy what a damaged file holds to a clean bag, and yield its losses."""
    handles: dict[int, int] = {}  # by number of the channel; 0 where its topic is unknown
    found, last, is_closed = Counter[int](), -1, False  # `last`: latest time of a message [ns]
    with path.open('rb') as stream:
        size = stream.seek(0, SEEK_END)
        summary = _summary(stream, size)
        for record in _records(stream, size, summary):
            if isinstance(record, tuple):
                number, sequence, received, published, raw = record
                found[number] += 1
                if number not in handles:
                    handles[number] = _handle(bag, summary, number)
                if handles[number]:
                    last = max(last, received)
                    bag.write(handles[number], _plain(raw), received, published, sequence)
            elif not isinstance(record, str):
                _note(record, summary)
            elif not is_closed:
                yield record if last < 0 else f'{record}, after {last * 1e-9:.6f} s'
            is_closed |= isinstance(record, DataEnd)
    if not is_closed:
        ends = 'nothing in it could be read' if last < 0 else f'it ends at {last * 1e-9:.6f} s'
        yield (
            f'the recording was not closed; {ends}. Later messages are lost: usually the last '
            '0.1 s before a kill, more if the computer was overloaded or lost power'
        )
    if unknown := sum(found[number] for number, handle in handles.items() if not handle):
        yield f'{unknown} messages of topics whose name or type is unknown'
    yield from _missing(summary, found)


def _note(record: Any, summary: Summary) -> None:
    """Note a type, a topic, numbers of messages, or the place of a chunk."""
    if isinstance(record, Schema):
        summary.schemas[record.id] = record
    elif isinstance(record, Channel):
        summary.channels[record.id] = record
    elif isinstance(record, Statistics):
        summary.statistics = record
    elif isinstance(record, ChunkIndex):
        summary.chunk_indexes.append(record)


def _missing(summary: Summary, found: Counter[int]) -> Iterator[str]:
    """Yield what is missing of the numbers of messages that are stated at the end of a file."""
    stated = Counter(summary.statistics.channel_message_counts if summary.statistics else ())
    for number, count in (stated - found).items():
        topic = summary.channels[number].topic if number in summary.channels else f'{number}'
        yield f'{count} of {stated[number]} messages of {topic}'


def _plain(raw: bytes) -> bytes:
    """Return a message, which may be compressed by itself: CDR never begins like that."""
    return ZstdDecompressor().decompress(raw) if raw.startswith(FRAME_HEADER) else raw


def _handle(bag: BagWriter, summary: Summary, number: int) -> int:
    """Return the handle of a channel in the clean bag, 0 if its topic or type is unknown."""
    channel = summary.channels.get(number)
    schema = summary.schemas.get(channel.schema_id) if channel else None
    if channel is None or schema is None:
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


def _summary(stream: BinaryIO, size: int) -> Summary:
    """Return the topics and the index at the end of a file, empty unless they match a checksum.

    Only there are the topics known if the first chunk is damaged.
    """
    summary = Summary()
    with suppress(Exception):  # anything, if the bytes are arbitrary
        stream.seek(size - MAGIC_SIZE - _END.size)
        start, _, checksum = _END.unpack(stream.read(_END.size))
        stream.seek(start)
        if checksum in (0, crc32(stream.read(size - MAGIC_SIZE - 4 - start))):
            stream.seek(start)
            while stream.tell() < size - MAGIC_SIZE:
                _note(next_record(stream, size, _KINDS), summary)
    return summary


def _records(stream: BinaryIO, size: int, summary: Summary) -> Iterator[Any]:
    """Yield each record, also those in chunks, and where and why something is none."""
    starts = [index.chunk_start_offset for index in summary.chunk_indexes]
    at, chunks = MAGIC_SIZE, set[int]()
    while at < size:
        stream.seek(at)
        end = 0
        try:
            record = next_record(stream, size, _KINDS)
            if record is None or ((starts or chunks) and isinstance(record, tuple)):
                raise ValueError('no such record belongs here')  # noqa: TRY301
            end = stream.tell()
            if not isinstance(record, Chunk):
                yield record
            elif hash(record.data) in chunks:
                yield f'{end - at} bytes at byte {at} (a chunk that the file holds twice)'
            else:
                chunks.add(hash(record.data))
                yield from records_in(record)
        except Exception as error:  # noqa: BLE001 - anything, if the bytes are arbitrary
            end = end or min((start for start in starts if start > at), default=size)
            yield f'{end - at} bytes at byte {at} ({f"{error}" or type(error).__name__})'
        at = end
