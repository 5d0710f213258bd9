# SPDX-License-Identifier: Apache-2.0
"""Which message to play when: rate, pause, single steps and loops.

All times are integers [ns], of the bag or of the caller's steady clock.
"""

from __future__ import annotations

from collections.abc import Sequence


class Timeline:
    """Position in a bag over time.

    Attributes:
        paused: whether only `step` advances.
        next: number of the next message.
    """

    def __init__(self, times: Sequence[int], rate: float, *, loop: bool = False) -> None:
        """Start at the first of the messages' `times` [ns]; rate 0 is as fast as possible."""
        self._times = times
        self._rate = rate
        self._loop = loop
        self._bag = times[0] if times else 0
        self._now: int | None = None
        self.paused = False
        self.next = 0

    @property
    def is_over(self) -> bool:
        """Whether no message is left."""
        return self.next >= len(self._times) and not (self._loop and self._times)

    def position(self, now: int) -> int:
        """Time in the bag [ns]."""
        if self.paused or self._now is None:
            return self._bag
        if self._rate == 0.0:
            return self._times[min(self.next, len(self._times) - 1)]
        return self._bag + round((now - self._now) * self._rate)

    def pause(self, now: int) -> None:
        """Hold the position."""
        self._bag, self.paused = self.position(now), True

    def resume(self, now: int) -> None:
        """Continue from the position."""
        self._bag, self._now, self.paused = self.position(now), now, False

    def step(self) -> int | None:
        """Advance by a message and return its number; None unless paused, or at the end."""
        if not self.paused or self.is_over:
            return None
        self._wrap()
        number = self.next
        self._bag = self._times[number]
        self.next += 1
        return number

    def due(self, now: int, most: int) -> range:
        """Advance to now and return the numbers of the messages to play, at most `most`."""
        if self._now is None:
            self._now = now
        if self.paused or self.is_over:
            return range(0)
        if self.next >= len(self._times):
            self._wrap()
            self._now = now
        first, end = self.next, min(self.next + most, len(self._times))
        if self._rate > 0.0:
            position = self.position(now)
            while self.next < end and self._times[self.next] <= position:
                self.next += 1
        else:
            self.next = end
        return range(first, self.next)

    def wait(self, now: int) -> float:
        """Time until the next message is due [s]; infinite while paused."""
        if self.paused or self.is_over:
            return float('inf')
        if self._rate == 0.0 or self.next >= len(self._times):
            return 0.0
        return max(0.0, (self._times[self.next] - self.position(now)) / self._rate * 1e-9)

    def _wrap(self) -> None:
        if self.next >= len(self._times):
            self.next = 0
            self._bag = self._times[0]
