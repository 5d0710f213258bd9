# SPDX-License-Identifier: Apache-2.0
"""Writer of bags like those of `ros2 bag record`: a folder of metadata.yaml and MCAP files."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from math import inf
from pathlib import Path
from typing import IO, cast

from mcap.writer import CompressionType, Writer

from blf_dsc_controller import __version__
from blf_dsc_controller.bags.metadata import (
    BagInformation,
    FileInformation,
    TopicInformation,
    profile_of,
)
from blf_dsc_controller.bags.reserved_file import ReservedFile
from blf_dsc_controller.bags.sources import MESSAGES, RECORD, VERSION, BagError
from blf_dsc_controller.messages.topics import Quality
from blf_dsc_controller.messages.types import Definition, definition

_COMPRESSIONS = {'none': CompressionType.NONE, 'zstd': CompressionType.ZSTD}
_CHUNK_SIZE = 1 << 20
_CHUNK_ENTRY = 100  # bytes that a chunk takes in the index at the end ...
_CHANNEL_ENTRY = 16  # ... and for each channel
_MOST_CHUNKS = 20_000  # in a file, whose index is kept in memory until it ends


class DiskFullError(BagError):
    """The disk is full; the bag has been completed and closed."""

    def __init__(self, path: Path, messages: int) -> None:
        self.messages = messages
        super().__init__(
            f'the disk is full: recording into {path} has ended with {messages} messages, which '
            'are complete and readable; make room, or split and move bags while they are recorded'
        )


class BagWriter:
    """Writer of serialised messages to a new bag.

    Data leaves the process within `flush_interval` [s] plus the time to the next call of `write` or
    `flush_if_due`, and then survives a kill of the process. Without an interval it leaves when a
    chunk is full. The compression of chunks is `none` or `zstd`. The first message after
    `split_size` [bytes] or `split_duration` [s] starts the next file, so no file is empty.

    Raises:
        BagError: `path` exists already.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        compression: str = 'none',
        flush_interval: float | None = 0.1,
        clock: Callable[[], float] = time.monotonic,
        split_size: float = inf,
        split_duration: float = inf,
    ) -> None:
        self.path = Path(path)
        self.closed = False
        self._compression = _COMPRESSIONS[compression]
        self._flush_interval = inf if flush_interval is None else flush_interval
        self._clock = clock
        self._split_size, self._split_duration = split_size, split_duration
        self._bag = BagInformation(custom_data={VERSION: __version__})
        try:
            self.path.mkdir(parents=True)
        except FileExistsError:
            raise BagError(
                f'{path} exists already and is not overwritten: choose another folder or remove it'
            ) from None
        self._begin_file()
        self._flushed = self._began

    def add_topic(
        self,
        name: str,
        type_name: str,
        offered: Sequence[Quality],
        known: Definition | None = None,
    ) -> int:
        """Add a topic by its full name, with the quality of service of each publisher.

        Returns:
            the handle for `write`.

        Raises:
            UnknownTypeError: no definition is given and the type is not one of Jazzy's common ones.
        """
        found = definition(type_name) if known is None else known
        topic = TopicInformation(name, type_name, [profile_of(one) for one in offered], found)
        self._bag.topics.append(topic)
        return self._add_channel(topic)

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

        Raises:
            DiskFullError: there is no room left; the bag is complete and closed.
        """
        if self._is_due:
            self._end_chunk()
            self._end_file()
            self._begin_file()
        published = log_time if publish_time is None else publish_time
        self._writer.add_message(handle, log_time, raw, published, sequence)
        self._bag.topics[handle - 1].message_count += 1
        file = self._bag.files[-1]
        file.message_count += 1
        file.starting_time = min(file.starting_time, log_time)
        file.ending_time = max(file.ending_time, log_time)
        self.flush_if_due()

    def note(self, facts: dict[str, str]) -> None:
        """Store facts about the run by name."""
        self._bag.custom_data.update(facts)
        self._writer.add_metadata(RECORD, self._bag.custom_data)

    def flush_if_due(self) -> None:
        """Flush if the flush interval has passed; DiskFullError as in `write`."""
        if self._stream.is_full or self._clock() - self._flushed >= self._flush_interval:
            self.flush()

    def flush(self) -> None:
        """Pass everything written so far to the operating system; DiskFullError as in `write`."""
        self._end_chunk()
        self._flushed = self._clock()
        if self._stream.is_full:
            self.close()
            raise DiskFullError(self.path, sum(self.message_counts.values()))

    def close(self) -> None:
        """Complete the bag; a second call does nothing."""
        if self.closed:
            return
        self.closed = True
        self._end_chunk()
        self._end_file()
        (self.path / 'metadata.yaml').write_text(self._bag.file_text(), encoding='utf-8')

    @property
    def message_counts(self) -> dict[str, int]:
        """Messages written so far, by topic."""
        return {topic.name: topic.message_count for topic in self._bag.topics}

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def _is_due(self) -> bool:
        """Whether the next message starts a new file."""
        is_long = self._flushed - self._began >= self._split_duration
        is_full = is_long or self._stream.tell() >= self._split_size
        is_full |= self._chunks >= _MOST_CHUNKS
        return is_full and self._bag.files[-1].message_count > 0

    def _begin_file(self) -> None:
        """Begin the next file, with the topics of the previous one."""
        file = FileInformation(f'{self.path.name}_{len(self._bag.files)}.mcap')
        self._bag.files.append(file)
        self._stream = ReservedFile(self.path / file.path)
        self._writer = Writer(
            cast('IO[bytes]', self._stream), chunk_size=_CHUNK_SIZE, compression=self._compression
        )
        self._writer.start(profile='ros2', library=f'blf_dsc_controller {__version__}')
        self._schemas: dict[str, int] = {}
        self._index_size = self._chunks = 0
        self._describe()
        for topic in self._bag.topics:
            self._add_channel(topic)
        self.note({})
        self._began = self._clock()

    def _describe(self) -> None:
        """Store the metadata so far; rosbag2 reads the last such record of a file."""
        self._writer.add_metadata('rosbag2', {'serialized_metadata': self._bag.record_text()})

    def _add_channel(self, topic: TopicInformation) -> int:
        """Add a topic to the file and return its number, the same in each file."""
        text, hash_, encoding = topic.definition
        if topic.type not in self._schemas:
            schema = self._writer.register_schema(topic.type, encoding, text.encode())
            self._schemas[topic.type] = schema
        metadata = {'offered_qos_profiles': topic.offered_text(), 'topic_type_hash': hash_}
        schema = self._schemas[topic.type]
        return self._writer.register_channel(topic.name, 'cdr', schema, metadata)

    def _end_chunk(self) -> None:
        before = self._stream.tell()
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._stream.flush()
        if self._stream.tell() > before:
            self._chunks += 1
            self._index_size += _CHUNK_ENTRY + _CHANNEL_ENTRY * len(self._bag.topics)
            self._stream.reserve(self._index_size)

    def _end_file(self) -> None:
        self._describe()
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._stream.close()


class Losses:
    """Counter of one topic's published but unrecorded messages, by sequence number.

    Each publisher numbers its own messages: losses of a topic that ever had several are unknown.
    """

    def __init__(self, publishers: int) -> None:
        self.missed: int | None = 0  # between recorded ones; None if unknown
        self.before = 0  # sent by a publisher before its first recorded one
        self._last = 0
        self.publishers_seen(publishers)

    def publishers_seen(self, publishers: int) -> None:
        """Update the number of publishers."""
        if publishers > 1:
            self.missed, self.before = None, 0

    def count(self, sequence: int) -> None:
        """Count a message; a number that is not higher than the last means a new publisher."""
        if self.missed is not None:
            if self._last and sequence > self._last:
                self.missed += sequence - self._last - 1
            else:
                self.before += max(sequence - 1, 0)
        self._last = sequence

    def text(self) -> str:
        """Return the text that follows the number of recorded messages."""
        if self.missed is None:
            return ''
        earlier = f', {self.before} sent before the recorder connected' if self.before else ''
        return f', {self.missed} missed{earlier}'


def statistics(written: Mapping[str, int], losses: Mapping[str, Losses]) -> dict[str, str]:
    """Return facts that state how many messages of each topic were written and lost."""
    return {
        f'{MESSAGES}{topic}': f'{count} written{losses[topic].text()}'
        for topic, count in written.items()
    }
