# SPDX-License-Identifier: Apache-2.0
"""Bags as those of `ros2 bag record` are written: metadata.yaml and MCAP files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import asdict, dataclass
from functools import partial
from math import inf
from pathlib import Path
from time import monotonic
from typing import Any

import yaml
from mcap.writer import CompressionType, Writer

from blf_dsc_controller import __version__
from blf_dsc_controller.bags.background_file import BackgroundFile
from blf_dsc_controller.bags.sources import METADATA, BagError, BagExistsError
from blf_dsc_controller.messages.codecs import NANOSECONDS, Definition, definition
from blf_dsc_controller.messages.topics import FOREVER, Quality, Topic
from blf_dsc_controller.writing import whole

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
    start = min(file.start for file in files)
    end = max(file.end for file in files)
    return {
        'duration': {'nanoseconds': max(end - start, 0)},
        'starting_time': {'nanoseconds_since_epoch': start},
    }


def _profile(quality: Quality) -> dict[str, Any]:
    """Return a quality of service as rosbag2 writes it, in its order."""
    profile = {'history': quality.history, **asdict(quality)}
    for name in _DURATIONS:
        profile[name] = dict(
            zip(('sec', 'nsec'), divmod(profile[name], NANOSECONDS), strict=True)
        )
    return {**profile, 'avoid_ros_namespace_conventions': False}


def _dump(tree: object) -> str:
    return str(yaml.safe_dump(tree, sort_keys=False, allow_unicode=True, width=2**20))


class BagWriter(AbstractContextManager['BagWriter']):
    """Writer of serialised messages to a new bag.

    Data leaves the process within `flush_interval` [s] plus the time to the next call
    of `write` or `flush_if_due`, and then survives a kill of the process. Without an
    interval it leaves when a chunk is full. The compression of chunks is `none` or
    `zstd`. A file ends after 10,000 chunks. With `in_background`, a thread writes to
    the disk; errors are raised by a later call. After an OSError, such as that of a
    full disk, `abandon` the bag. Its files have the `name` of the folder, or the given one.

    Raises:
        BagExistsError: `path` exists already.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        name: str = '',
        compression: str = 'none',
        flush_interval: float | None = 0.1,
        in_background: bool = False,
    ) -> None:
        self.path = Path(path)
        self._name = name or self.path.name
        self._in_background = in_background
        self.closed = False
        self._compression = CompressionType[compression.upper()]
        self._flush_interval = inf if flush_interval is None else flush_interval
        # as in metadata.yaml, with definitions beside
        self._topics: list[dict[str, Any]] = []
        self._definitions: list[Definition] = []
        self._files: list[_File] = []
        try:
            self.path.mkdir(parents=True)
        except FileExistsError:
            raise BagExistsError(
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

        A quality may also be plain data, as in another bag. Returns the handle for
        `write`.

        Raises:
            UnknownTypeError: no definition is given and the type is not one of Jazzy's common ones.
        """
        found = definition(type_name) if known is None else known
        profiles = [
            _profile(each) if isinstance(each, Quality) else each for each in offered
        ]
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

        It was received at `log_time` [ns] and published at `publish_time` [ns], or
        `log_time` if not known, with the `sequence` number of the publisher, 0 if not
        known.
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
        with whole(self.path / METADATA) as part:
            part.write_text(text, encoding='utf-8')

    def abandon(self, error: OSError | BagError) -> BagError:
        """End the bag as it is after an error of the disk; return what to tell of it."""
        self.closed = True
        if isinstance(self._stream, BackgroundFile):
            self._stream.abandon()
        else:
            with suppress(OSError):  # the same error again
                self._stream.close()
        return BagError(
            f'{self.path} cannot be written any further: '
            f'{getattr(error, "strerror", None) or error}; '
            f'blf_dsc recover {self.path} saves what was written before, with --out on another '
            'disk if this one is full'
        )

    @property
    def message_counts(self) -> dict[str, int]:
        """Messages written so far, by topic."""
        return {
            topic['topic_metadata']['name']: topic['message_count']
            for topic in self._topics
        }

    def __exit__(self, *_: object) -> None:
        self.close()

    def _begin_file(self) -> None:
        """Begin the next file, with the topics of the previous one."""
        self._files.append(_File(f'{self._name}_{len(self._files)}.mcap'))
        path = self.path / self._files[-1].name
        make: Callable[[Path], Any] = partial(Path.open, mode='xb')
        if self._in_background:
            make = BackgroundFile
        self._stream = make(path)
        self._writer = Writer(
            self._stream, chunk_size=_CHUNK_SIZE, compression=self._compression
        )
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
            schema = self._writer.register_schema(
                type_name, known.encoding, known.text.encode()
            )
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


class TopicRecorder:
    """A bag of messages by topic, numbered as a publisher does."""

    def __init__(self, bag: BagWriter) -> None:
        """Record into a new bag."""
        self._bag = bag
        self._handles: dict[Topic, int] = {}
        self._sent: Counter[Topic] = Counter()

    def write(self, stamp: int, topic: Topic, raw: bytes) -> None:
        """Write a serialised message with its time [ns].

        Raises:
            BagError: the disk is full, or too slow; the bag ends there.
        """
        try:
            if topic not in self._handles:
                offered = [topic.offered]
                self._handles[topic] = self._bag.add_topic(
                    topic.resolved, topic.type, offered
                )
            self._sent[topic] += 1
            handle = self._handles[topic]
            self._bag.write(handle, raw, stamp, sequence=self._sent[topic])
        except (OSError, BagError) as error:
            raise self._bag.abandon(error) from error

    def close(self) -> None:
        """Complete the bag.

        Raises:
            BagError: as `write`.
        """
        try:
            self._bag.close()
        except (OSError, BagError) as error:
            raise self._bag.abandon(error) from error
