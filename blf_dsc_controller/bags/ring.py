# SPDX-License-Identifier: Apache-2.0
"""Black-box recorder: the last seconds in memory, written as a bag on demand."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

from blf_dsc_controller.bags.writer import BagWriter
from blf_dsc_controller.messages.cdr import NANOSECONDS
from blf_dsc_controller.messages.topics import Quality

_Message: TypeAlias = tuple[int, bytes, int, int, int]
"""Arguments of `write`."""


class Ring:
    """Buffer of the messages of the last `seconds`.

    It also keeps the last message of each latched topic, however old. It can replace a BagWriter;
    `message_counts` counts all messages written so far, by topic.
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
        """Store a message, and drop those that are now too old."""
        self.message_counts[self._topics[handle - 1][0]] += 1
        self._messages.append((handle, raw, log_time, publish_time, sequence))
        while self._messages[0][2] < log_time - self._span:
            old = self._messages.popleft()
            if self._is_latched(old[0]):
                self._latched[old[0]] = old

    def configure(self, configuration: str, known_at: int | None = None) -> None:
        """Store the configuration of the run, as in BagWriter."""
        self._configuration = configuration, time.time_ns() if known_at is None else known_at

    def note(self, facts: dict[str, str]) -> None:
        """Do nothing: each dump is given its own facts."""

    def flush_if_due(self) -> None:
        """Do nothing: the messages stay in memory."""

    def flush(self) -> None:
        """Do nothing: the messages stay in memory."""

    def close(self) -> None:
        """Do nothing: messages not yet dumped are discarded."""

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
