# SPDX-License-Identifier: Apache-2.0
"""A bag as `ros2 bag record` writes it: a folder of metadata.yaml and MCAP files."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import TypeAlias

from blf_dsc_controller.bags.context import ATTACHMENT, RECORD, facts_of
from blf_dsc_controller.bags.mcap_writer import McapFile
from blf_dsc_controller.bags.metadata import BagInformation, TopicInformation
from blf_dsc_controller.bags.sources import BagError
from blf_dsc_controller.messages.cdr import NANOSECONDS
from blf_dsc_controller.messages.topics import Quality
from blf_dsc_controller.messages.types import Definition, definition

_Message: TypeAlias = tuple[int, bytes, int, int, int]
"""As `write` takes it."""


class DiskFullError(BagError):
    """The disk is full; the bag was ended in order before."""

    def __init__(self, path: Path, messages: int) -> None:
        self.messages = messages
        super().__init__(
            f'the disk is full: recording into {path} has ended with {messages} messages, which '
            'are complete and readable; make room, or split and move bags while they are recorded'
        )


@dataclass(frozen=True)
class SplitLimits:
    """When the next file of a bag is begun: at a size [bytes], or after a time [s]; inf: never."""

    size: float = inf
    duration: float = inf


class BagWriter:
    """Writes serialised messages into a new bag.

    Data leaves the process within `flush_interval` [s] plus the time to the next call of `write` or
    `flush_if_due`; then it survives the process being killed. Without an interval it leaves when a
    chunk is full. The chunks are compressed by `none` or `zstd`.

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
        limits: SplitLimits = SplitLimits(),
    ) -> None:
        self.path = Path(path)
        self._compression = compression
        self._limits = limits
        self._bag = BagInformation()
        self._configuration: tuple[str, int] | None = None
        try:
            self.path.mkdir(parents=True)
        except FileExistsError:
            raise BagError(
                f'{path} exists already and is not overwritten: choose another folder or remove it'
            ) from None
        self._file = self._new_file()
        self._flush_interval = inf if flush_interval is None else flush_interval
        self._clock = clock
        self._flushed = self._began = clock()
        self.closed = False

    def add_topic(
        self,
        name: str,
        type_name: str,
        offered: Sequence[Quality],
        known: Definition | None = None,
    ) -> int:
        """Add a topic by its full name, with the quality of service of each publisher.

        Returns:
            the handle to write to it.

        Raises:
            UnknownTypeError: the definition is left out and the type is no common one of Jazzy.
        """
        found = definition(type_name) if known is None else known
        topic = TopicInformation(name, type_name, tuple(offered), found)
        self._bag.topics.append(topic)
        return self._file.add_channel(topic)

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
        self._file.write(
            handle, raw, log_time, log_time if publish_time is None else publish_time, sequence
        )
        self._bag.topics[handle - 1].message_count += 1
        self.flush_if_due()

    def configure(self, configuration: str, known_at: int | None = None) -> None:
        """Store a parameter file of all nodes known so far, received now or at `known_at` [ns]."""
        self._configuration = configuration, time.time_ns() if known_at is None else known_at
        self._bag.custom_data.update(facts_of(configuration))
        self._describe(self._file)

    def note(self, facts: dict[str, str]) -> None:
        """Store facts of the run by name."""
        self._bag.custom_data.update(facts)
        self._file.note(RECORD, self._bag.custom_data)

    def flush_if_due(self) -> None:
        """Flush if the flush interval has passed; DiskFullError as in `write`."""
        if self._file.is_full or self._clock() - self._flushed >= self._flush_interval:
            self.flush()

    def flush(self) -> None:
        """Pass everything written so far to the operating system; DiskFullError as in `write`."""
        self._file.flush()
        self._flushed = self._clock()
        if self._file.is_full:
            self.close()
            raise DiskFullError(self.path, sum(self.message_counts.values()))
        if (
            self._file.size >= self._limits.size
            or self._flushed - self._began >= self._limits.duration
        ):
            self._end(self._file)
            self._file = self._new_file()
            self._began = self._flushed

    def close(self) -> None:
        """Complete the bag; a second call does nothing."""
        if self.closed:
            return
        self.closed = True
        self._end(self._file)
        (self.path / 'metadata.yaml').write_text(self._bag.file_text(), encoding='utf-8')

    @property
    def message_counts(self) -> dict[str, int]:
        """Messages written so far, by topic."""
        return {topic.name: topic.message_count for topic in self._bag.topics}

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _new_file(self) -> McapFile:
        """Begin the next file, with the topics of the one before it."""
        name = f'{self.path.name}_{len(self._bag.files)}.mcap'
        file = McapFile(self.path / name, self._compression)
        self._bag.files.append(file.information)
        file.describe(self._bag)
        for topic in self._bag.topics:
            file.add_channel(topic)
        self._describe(file)
        return file

    def _describe(self, file: McapFile) -> None:
        if self._bag.custom_data:
            file.note(RECORD, self._bag.custom_data)
        if self._configuration is not None:
            text, known_at = self._configuration
            file.attach(ATTACHMENT, 'application/yaml', text, known_at)

    def _end(self, file: McapFile) -> None:
        file.flush()
        file.describe(self._bag)
        file.close()


class Ring:
    """A black box: the messages of the last `seconds` in memory, written out on demand.

    It also keeps the last message of each latched topic however old it is. It takes the place of a
    BagWriter; `message_counts` are all messages written so far, by topic.
    """

    closed = False

    def __init__(self, seconds: float, compression: str) -> None:
        self.message_counts: Counter[str] = Counter()
        self._span = round(seconds * NANOSECONDS)
        self._compression = compression
        self._topics: list[tuple[str, str, tuple[Quality, ...]]] = []
        self._messages: deque[_Message] = deque()
        self._latched: dict[int, _Message] = {}
        self._configuration: tuple[str, int] | None = None

    def add_topic(self, name: str, type_name: str, offered: Sequence[Quality]) -> int:
        """Add a topic and return its handle."""
        self._topics.append((name, type_name, tuple(offered)))
        self.message_counts[name] = 0
        return len(self._topics)

    def write(
        self, handle: int, raw: bytes, log_time: int, publish_time: int, sequence: int
    ) -> None:
        """Keep a message, and drop those that are too old by now."""
        self.message_counts[self._topics[handle - 1][0]] += 1
        self._messages.append((handle, raw, log_time, publish_time, sequence))
        while self._messages[0][2] < log_time - self._span:
            old = self._messages.popleft()
            if self._is_latched(old[0]):
                self._latched[old[0]] = old

    def configure(self, configuration: str, known_at: int | None = None) -> None:
        """Keep the configuration of the run, as in BagWriter."""
        self._configuration = configuration, time.time_ns() if known_at is None else known_at

    def note(self, facts: dict[str, str]) -> None:
        """Do nothing: each dump has facts of its own."""

    def flush_if_due(self) -> None:
        """Do nothing: the messages stay in memory."""

    def flush(self) -> None:
        """Do nothing: the messages stay in memory."""

    def close(self) -> None:
        """Do nothing: what was not dumped is dropped."""

    def dump(self, path: Path, facts: dict[str, str]) -> int:
        """Write the kept messages as a bag and return their number; the ring continues.

        Raises:
            BagError: `path` exists already.
            DiskFullError: there is no room for all of it.
        """
        kept = [*self._latched.values(), *self._messages]
        with BagWriter(path, compression=self._compression, flush_interval=None) as bag:
            if self._configuration is not None:
                bag.configure(*self._configuration)
            bag.note(facts)
            for name, type_name, offered in self._topics:
                bag.add_topic(name, type_name, offered)
            for message in kept:
                bag.write(*message)
            bag.flush()
        return len(kept)

    def _is_latched(self, handle: int) -> bool:
        offered = self._topics[handle - 1][2]
        return bool(offered) and all(one.durability == 'transient_local' for one in offered)
