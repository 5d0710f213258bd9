# SPDX-License-Identifier: Apache-2.0
"""Time of a loop whose robot does not send states by itself: ticks of this computer's clock."""

from __future__ import annotations

import time

_SPIN = 2e-4  # s before a tick, for which no sleep is trusted


class Ticks:
    """Ticks of a period [s], by the steady clock."""

    def __init__(self, period: float) -> None:
        self.period = period
        self._next = 0.0

    def begin(self) -> float:
        """Return the time [s] of the first tick, which is now."""
        self._next = time.monotonic()
        return self._next

    def wait(self) -> float:
        """Wait for the next tick, and return its time [s].

        One that is over by more than a period is now: those between are left out.
        """
        self._next += self.period
        while (left := self._next - time.monotonic()) > 0.0:
            time.sleep(max(left - _SPIN, 0.0))
        if left < -self.period:
            self._next -= left
        return self._next

    def left(self, share: float) -> float:
        """Return the time [s] left until so much of this period is over."""
        return max(self._next + share * self.period - time.monotonic(), 0.0)
