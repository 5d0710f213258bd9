# SPDX-License-Identifier: Apache-2.0
"""Recording of the package's own messages without ROS."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from blf_dsc_controller.bags.sources import BagError
from blf_dsc_controller.bags.writer import BagWriter
from blf_dsc_controller.messages.topics import Topic


class TopicRecorder:
    """A bag of messages by topic, numbered as a publisher does."""

    def __init__(
        self,
        path: Path,
        *,
        compression: str = 'none',
        flush_interval: float | None = 0.1,
        in_background: bool = False,
    ) -> None:
        """Open a new bag; the arguments and errors are those of `BagWriter`."""
        self._bag = BagWriter(
            path,
            compression=compression,
            flush_interval=flush_interval,
            in_background=in_background,
        )
        self._handles: dict[Topic, int] = {}
        self._sent: Counter[Topic] = Counter()

    def write(self, stamp: int, topic: Topic, raw: bytes) -> None:
        """Write a serialised message with its time [ns].

        Raises:
            BagError: the disk is full, or too slow; the bag ends there.
        """
        try:
            self._write(stamp, topic, raw)
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

    def _write(self, stamp: int, topic: Topic, raw: bytes) -> None:
        if topic not in self._handles:
            offered = [topic.offered]
            self._handles[topic] = self._bag.add_topic(
                topic.resolved, topic.type, offered
            )
        self._sent[topic] += 1
        self._bag.write(self._handles[topic], raw, stamp, sequence=self._sent[topic])
