# SPDX-License-Identifier: Apache-2.0
"""Counting what did not arrive, by the numbers that a publisher gives to its messages."""

from __future__ import annotations

NOTHING_MISSED = '0 missed'
"""Words of a topic of which everything came."""


class Losses:
    """Messages of one topic that were published but never came.

    Several publishers each count for themselves, so nothing can be said of a topic that ever had
    more than one.

    Args:
        publishers: number of publishers at present.

    Attributes:
        missed: messages between others that did not come; None if that cannot be told.
        before: messages that a publisher had sent before the first of its own that came.
    """

    def __init__(self, publishers: int) -> None:
        self.missed: int | None = 0
        self.before = 0
        self._last = 0
        self.publishers_seen(publishers)

    def publishers_seen(self, publishers: int) -> None:
        """Take note of the present number of publishers."""
        if publishers > 1:
            self.missed, self.before = None, 0

    def count(self, sequence: int) -> None:
        """Take note of a message; a number that is not higher than the last is a new publisher."""
        if self.missed is not None:
            if self._last and sequence > self._last:
                self.missed += sequence - self._last - 1
            else:
                self.before += max(sequence - 1, 0)
        self._last = sequence

    def text(self) -> str:
        """Words to follow the number of messages that came."""
        if self.missed is None:
            return ''
        earlier = f', {self.before} sent before the recorder heard them' if self.before else ''
        return f', {self.missed} missed{earlier}'
