# SPDX-License-Identifier: Apache-2.0
"""Streams of targets: when each was sent, and with which velocity the sender moves.

The messages carry no time, and arrive late, early or not at all. Their sender is taken
to be periodic: the arrivals are numbered, each by the whole intervals since the one
before, and a line of least squares through them is its clock. A velocity that the
sender does not give is the mean of the last `_SPAN`, at least of the last interval.

The reference is at a target one interval after it was sent, when the next one is due:
it then interpolates and never has to guess what the sender will do.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from blf_dsc_controller.reference.retargeting import Target

_SPAN = 0.02  # s over which a velocity is averaged
_COAST = 0.03  # s on the line after its time, at least ...
_INTERVALS = 2.0  # ... and so many intervals
_STEP = 1.5  # of the velocity limit; a faster change of positions is a step
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
        self._arrivals: deque[float] = deque(maxlen=_KEPT)  # s
        self._positions: deque[np.ndarray] = deque(maxlen=_KEPT)
        self._numbers = np.zeros(1)  # of the messages, in intervals

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
        fastest: np.ndarray,
        velocities: np.ndarray | None = None,
        ahead: float | None = None,
    ) -> Target:
        """Return the target of a message.

        Args:
            arrived: time since the start [s].
            positions: (n,) [rad].
            timeout: pause [s] after which a stream begins anew, at rest.
            fastest: largest velocities (n,) [rad/s]; a step is no motion.
            velocities: (n,) [rad/s], if the sender gives them.
            ahead: time [s] from sending to the positions; without, one interval, and the reference
                rests where it has braked if nothing follows.
        """
        if self._arrivals and arrived - self._arrivals[-1] > timeout:
            self.restart()
        self._arrivals.append(arrived)
        self._positions.append(positions)
        self._estimate_clock()
        if velocities is None:
            velocities = self._velocity(fastest)
        due = self._sent + (self.interval if ahead is None else ahead)
        coast = min(max(_INTERVALS * self.interval, _COAST), timeout)
        if self.interval == 0.0 and not np.any(velocities):
            coast = 0.0
        return Target(
            tuple(positions.tolist()),
            tuple(velocities.tolist()),
            due,
            due + coast,
            held=ahead is not None,
        )

    def _estimate_clock(self) -> None:
        """Estimate the interval, and when the last message was sent."""
        arrivals = np.array(self._arrivals)
        gaps = np.diff(arrivals)
        if gaps.size == 0:
            self.interval = 0.0
            self._sent = arrivals[0]
            self._numbers = np.zeros(1)
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
        self._numbers = np.concatenate(([0.0], np.cumsum(passed)))
        centred = self._numbers - np.mean(self._numbers)
        slope = centred @ arrivals / (centred @ centred)
        self.interval = max(float(slope), _SHORTEST)
        self._sent = float(np.mean(arrivals) + self.interval * centred[-1])

    def _velocity(self, fastest: np.ndarray) -> np.ndarray:
        """Return the velocity (n,) [rad/s] at the last target; zero after a step.

        It is the slope of the parabola through the last target and two before, or of
        the line.
        """
        if self.interval == 0.0:
            return np.zeros_like(fastest)
        wanted = max(1, int(_SPAN / self.interval))
        x, slope = self._slope(wanted)
        farther, chord = self._slope(2 * wanted)
        velocity = slope
        if farther > x:
            velocity = (farther * slope - x * chord) / (farther - x)
        velocity = velocity / self.interval
        velocity[np.abs(velocity) > _STEP * fastest] = 0.0
        return velocity

    def _slope(self, intervals: int) -> tuple[float, np.ndarray]:
        """Return time and mean rise, both in intervals, since a target at least so long ago."""
        before = self._numbers[-1] - self._numbers
        i = max(int(np.count_nonzero(before >= intervals)) - 1, 0)
        passed = float(before[i])
        return passed, (self._positions[-1] - self._positions[i]) / passed


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
