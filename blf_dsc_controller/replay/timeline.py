# SPDX-License-Identifier: Apache-2.0
"""Time in a bag while it is played: rate, pause and jumps.

All times are integers [ns], of the bag or of the caller's steady clock.
"""

from __future__ import annotations


class Timeline:
    """Position in a bag over time; it begins paused.

    Attributes:
        paused: whether only `jump` moves it.
    """

    def __init__(self, start: int, rate: float) -> None:
        """Begin at `start`; rate 0 is as fast as possible: only `jump` moves the position."""
        self._bag = start
        self._now = 0
        self._rate = rate
        self.paused = True

    def position(self, now: int) -> int:
        """Return the time in the bag."""
        return self._bag if self.paused else self._bag + round((now - self._now) * self._rate)

    def pause(self, now: int) -> None:
        """Hold the position."""
        self._bag, self.paused = self.position(now), True

    def resume(self, now: int) -> None:
        """Continue from the position."""
        self._bag, self._now, self.paused = self.position(now), now, False

    def jump(self, to: int, now: int) -> None:
        """Move to a time in the bag."""
        self._bag, self._now = to, now

    def wait(self, until: int, now: int) -> float:
        """Return the time [s] until the position reaches `until`; infinite while paused."""
        if self.paused:
            return float('inf')
        left = max(0, until - self.position(now))
        return left / self._rate * 1e-9 if self._rate > 0.0 else 0.0
