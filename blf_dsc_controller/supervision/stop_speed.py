# SPDX-License-Identifier: Apache-2.0
"""Speed of the arm in the safe stop: whether it speeds up instead of coming to rest."""

from __future__ import annotations

# rad/s over twice the speed at the stop, for _SPEEDS_UP: a load that is new makes less
# of it
_FASTER = 0.5
_GROWING = 0.95  # of the largest speed so far
_SPEEDS_UP = 0.2  # s


class StopSpeed:
    """Finds, once in a safe stop, that the arm speeds up."""

    def __init__(self) -> None:
        self.begin(0.0)

    def begin(self, speed: float) -> None:
        """Begin a safe stop at a speed [rad/s], the largest of a joint."""
        self._at_stop = speed
        self._peak = 0.0  # rad/s, since then
        self._speeding = 0.0  # s, for which the arm has been faster

    def observe(self, speed: float, gap: float) -> bool:
        """Take the speed of a state; return whether this shows that the arm speeds up.

        That is once it has been faster for long enough, and at most once in a stop.

        `speed` [rad/s] is the largest of a joint, `gap` [s] the time since the last
        one.
        """
        if self._speeding > _SPEEDS_UP:
            return False
        self._peak = max(speed, self._peak)
        is_faster = speed > 2.0 * self._at_stop + _FASTER
        is_growing = speed > _GROWING * self._peak
        self._speeding = self._speeding + gap if is_faster and is_growing else 0.0
        return self._speeding > _SPEEDS_UP
