# SPDX-License-Identifier: Apache-2.0
"""What is summed up over many samples: saturation, missed states, silence."""

from __future__ import annotations

LOOK = 0.008
"""Time [s] from one look at the steady clock to the next while it is silent."""

_MARGIN = 0.001  # s, after which what was due has come or is late
_NANO = 1e-9


class Saturation:
    """Time for which some torque has been at its limit without a break.

    Attributes:
        lasted: that time [s].
        count: samples at the limit since the start.
    """

    def __init__(self) -> None:
        self.lasted = 0.0
        self.count = 0

    def take(self, dt: float, *, saturated: bool) -> None:
        """Take note of one sample of `dt` [s]."""
        self.lasted = self.lasted + dt if saturated else 0.0
        self.count += saturated


class Overruns:
    """Part of the states that were missed, averaged exponentially.

    Missed are the states that the stamps jump over: the loop, the network or the arm's driver was
    too slow.  It is counted in the plant's time, so that a slow computer in lock-step misses none.

    Attributes:
        fraction: missed part, from 0 to 1.
        count: states missed since the start.
    """

    def __init__(self) -> None:
        self.fraction = 0.0
        self.count = 0

    def take(self, samples: int, memory: float) -> None:
        """Take note of a state that is `samples` after the last; `memory` is in samples."""
        keep = 1.0 - min(1.0, 1.0 / memory)
        self.fraction *= keep
        if samples > 1:
            missed = samples - 1
            self.count += missed
            self.fraction = 1.0 - (1.0 - self.fraction) * keep**missed


class Silence:
    """Watches the steady clock between two states.

    A watch that was itself late proves nothing, because the states may wait in the queue behind
    it: then the verdict is left to the next look.

    Attributes:
        next_look: time [s] from the last look to the next: as soon as it could have become silent.
    """

    def __init__(self) -> None:
        self.next_look = LOOK
        self._last_state = -1
        self._last_look = -1

    def state(self, now: int) -> None:
        """Take note of a state at `now` [ns, steady clock]."""
        self._last_state = now

    def forget(self) -> None:
        """Wait for a state without counting the time."""
        self._last_state = -1

    def look(self, now: int, limit: float) -> float:
        """Return for how long it has been silent past `limit` [s]; 0 if it has not.

        Args:
            now: steady clock [ns], `next_look` after the last look.
            limit: longest time between two states [s].
        """
        is_late = (now - self._last_look) * _NANO > self.next_look + LOOK
        self._last_look = now
        silent = (now - self._last_state) * _NANO if self._last_state >= 0 else 0.0
        self.next_look = limit - silent + _MARGIN if silent <= limit else LOOK
        return silent if silent > limit and not is_late else 0.0
