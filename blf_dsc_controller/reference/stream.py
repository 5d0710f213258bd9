# SPDX-License-Identifier: Apache-2.0
"""Streams of targets: when each was sent, and when the reference is to be there.

The messages carry no time, and arrive late, early or not at all. Their sender is taken
to be periodic: the arrivals are numbered, each by the whole intervals since the one
before, and a line of least squares through them is its clock.

Nobody knows whether another target follows, so every motion is one to rest at the last
target, a while after it was sent, and the next one replaces it on the way.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from blf_dsc_controller.reference.retargeting import Target

_INTERVALS_TO_REST = 2.0  # from sending, at least ...
_TO_REST = 0.1  # s, ... and so long
_COAST = 0.03  # s on the line after its time, at least ...
_INTERVALS = 2.0  # ... and so many intervals
_KEPT = 64  # messages: a clock's error is a quarter of a single arrival's
_SHORTEST = 1e-3  # s, of an interval
_RECENT = 15  # gaps between arrivals, by which the interval must not be ...
_UNLIKE = 1.4  # ... so many times as long as their mean, ...
_MOSTLY = 0.1  # ... or as much shorter than all but this share: losses make gaps longer


class TargetStream:
    """The targets of one sender.

    Attributes:
        interval: estimated time between two messages [s]; 0 before the second one.
    """

    def __init__(self) -> None:
        self.interval = 0.0
        self._sent = 0.0  # s, estimated
        self._due = 0.0  # s, of the last target
        self._arrivals: deque[float] = deque(maxlen=_KEPT)  # s
        self._positions: deque[np.ndarray] = deque(maxlen=_KEPT)

    def restart(self) -> None:
        """Forget all messages: the next one is the first of a stream."""
        self._arrivals.clear()
        self._positions.clear()

    def last(self, now: float, timeout: float) -> np.ndarray | None:
        """Return the last positions (n,) [rad]; None if the next ones begin a stream.

        They do after a pause of `timeout` [s].
        """
        if not self._arrivals or now - self._arrivals[-1] > timeout:
            return None
        return self._positions[-1]

    def target(
        self,
        arrived: float,
        positions: np.ndarray,
        *,
        timeout: float,
        velocities: np.ndarray | None = None,
        ahead: float = 0.0,
    ) -> Target:
        """Return the target of a message.

        Args:
            arrived: time since the start [s].
            positions: (n,) [rad].
            timeout: pause [s] after which a stream begins anew.
            velocities: (n,) [rad/s] at the positions, if the sender gives them; without, the
                reference comes to rest there, two intervals after sending at the earliest.
            ahead: time [s] from sending to the positions.
        """
        if self._arrivals and arrived - self._arrivals[-1] > timeout:
            self.restart()
        stays = bool(self._arrivals) and np.array_equal(positions, self._positions[-1])
        self._arrivals.append(arrived)
        self._positions.append(positions)
        self._estimate_clock()
        where = tuple(positions.tolist())
        if velocities is None:
            if not stays:
                span = max(_INTERVALS_TO_REST * self.interval, _TO_REST, ahead)
                self._due = self._sent + span
            return Target(where, (), self._due, self._due, held=True)
        due = self._sent + ahead
        coast = min(max(_INTERVALS * self.interval, _COAST), timeout)
        if self.interval == 0.0 and not np.any(velocities):
            coast = 0.0
        return Target(where, tuple(velocities.tolist()), due, due + coast, held=True)

    def _estimate_clock(self) -> None:
        """Estimate the interval, and when the last message was sent."""
        arrivals = np.array(self._arrivals)
        gaps = np.diff(arrivals)
        if gaps.size == 0:
            self.interval = 0.0
            self._sent = arrivals[0]
            return
        recent = np.sort(gaps[-_RECENT:])
        mean = max(float(np.mean(recent)), _SHORTEST)
        is_faster = self.interval > _UNLIKE * mean
        is_slower = self.interval * _UNLIKE < recent[int(_MOSTLY * recent.size)]
        if gaps.size < _RECENT:
            self.interval = mean
        elif is_faster or is_slower:
            for each in (self._arrivals, self._positions):
                while len(each) > 2:
                    each.popleft()
            self.interval = 0.0
            self._estimate_clock()
            return
        passed = _whole_intervals(gaps / self.interval)
        numbers = np.concatenate(([0.0], np.cumsum(passed)))
        centred = numbers - np.mean(numbers)
        slope = centred @ arrivals / (centred @ centred)
        self.interval = max(float(slope), _SHORTEST)
        self._sent = float(np.mean(arrivals) + self.interval * centred[-1])


def _whole_intervals(gaps: np.ndarray) -> np.ndarray:
    """Return how many intervals (k,) messages are apart, from gaps (k,).

    Messages that arrive together were no losses in the gap before.
    """
    passed: np.ndarray = np.maximum(np.rint(gaps), 0.0)
    for i in np.flatnonzero(passed == 0.0):
        passed[i] = 1.0
        longer = np.flatnonzero(passed[:i] > 1.0)
        if longer.size:
            passed[longer[-1]] -= 1.0
    return passed
