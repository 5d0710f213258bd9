# SPDX-License-Identifier: Apache-2.0
"""Recording of the package's own messages without ROS."""

from __future__ import annotations

from collections import Counter

from blf_dsc_controller.bags.sources import BagError
from blf_dsc_controller.bags.writer import BagWriter
from blf_dsc_controller.messages.topics import Topic


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
