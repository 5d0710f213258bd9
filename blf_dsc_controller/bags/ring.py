# SPDX-License-Identifier: Apache-2.0
"""A black box: the last seconds of all topics in memory, written out on demand."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

from blf_dsc_controller.bags.writer import BagWriter
from blf_dsc_controller.messages.cdr import NANOSECONDS
from blf_dsc_controller.messages.topics import Quality

_Message: TypeAlias = tuple[int, bytes, int, int, int]
"""As `write` takes it."""


class Ring:
    """Messages of the last `seconds`, and the last of each latched topic however old it is."""

    def __init__(self, seconds: float, compression: str) -> None:
        self._span = round(seconds * NANOSECONDS)
        self._compression = compression
        self._topics: list[tuple[str, str, tuple[Quality, ...]]] = []
        self._messages: deque[_Message] = deque()
        self._latched: dict[int, _Message] = {}
        self._configuration: tuple[str, int] | None = None

    def add_topic(self, name: str, type_name: str, offered: Sequence[Quality]) -> int:
        """Add a topic and return its handle."""
        self._topics.append((name, type_name, tuple(offered)))
        return len(self._topics)

    def write(
        self, handle: int, raw: bytes, log_time: int, publish_time: int, sequence: int
    ) -> None:
        """Keep a message, and drop those that are too old by now."""
        self._messages.append((handle, raw, log_time, publish_time, sequence))
        while self._messages[0][2] < log_time - self._span:
            old = self._messages.popleft()
            if self._is_latched(old[0]):
                self._latched[old[0]] = old

    def configure(self, configuration: str, known_at: int) -> None:
        """Keep the configuration of the run, as in BagWriter."""
        self._configuration = configuration, known_at

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
