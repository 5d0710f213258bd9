# SPDX-License-Identifier: Apache-2.0
"""Streams of targets: when each was sent, and with which velocity the sender moves.

The messages carry no time, and arrive late, early or not at all. Their sender is taken to be
periodic: an alpha-beta filter estimates its clock from the arrivals, and a message that is missing
is counted as a whole interval. A velocity that the sender does not give is the mean of the last
`_SPAN`, at least of the last interval.

The reference is at a target one interval after it was sent, when the next one is due: it then
interpolates and never has to guess what the sender will do.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from blf_dsc_controller.reference.retargeting import Target

# Of the filter in the long run: as little damped as keeps it from swinging.
_POSITION_GAIN = 0.02
_INTERVAL_GAIN = _POSITION_GAIN**2 / (2.0 - _POSITION_GAIN)
_MISSING = 0.7  # of an interval; a message that is later counts as one more
_SPAN = 0.02  # s over which a velocity is averaged
_COAST = 0.03  # s on the line after its time, at least ...
_INTERVALS = 2.0  # ... and so many intervals
_STEP = 1.5  # of the velocity limit; a faster change of positions is a step
_KEPT = 64  # targets
_GAPS = 15  # between arrivals, whose median the interval must resemble ...
_UNLIKE = 1.4  # ... up to this factor


class TargetStream:
    """The targets of one sender.

    Attributes:
        interval: estimated time between two messages [s]; 0 before the second one.
    """

    def __init__(self) -> None:
        self.interval = 0.0
        self._sent = 0.0  # s, estimated
        self._arrived = -np.inf
        self._count = 0
        self._targets: deque[tuple[int, np.ndarray]] = deque(maxlen=_KEPT)
        self._gaps: deque[float] = deque(maxlen=_GAPS)

    def restart(self) -> None:
        """Forget all messages: the next one is the first of a stream."""
        self._arrived = -np.inf

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
        self._arrive(arrived, timeout)
        self._targets.append((self._count, positions))
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

    def _arrive(self, arrived: float, timeout: float) -> None:
        """Estimate when a message was sent, and the interval."""
        gap = arrived - self._arrived
        self._arrived = arrived
        if gap > timeout:
            self.interval = 0.0
            self._sent = arrived
            self._count = 0
            self._targets.clear()
            self._gaps.clear()
            return
        self._count += 1
        self._gaps.append(gap)
        typical = float(np.median(self._gaps))
        if not 1.0 / _UNLIKE < self.interval / max(typical, 1e-3) < _UNLIKE:
            self.interval = 0.0
            self._targets.clear()
        if self.interval == 0.0:
            self.interval = max(typical, 1e-3)
            self._sent = arrived
            return
        passed = max(1, int((arrived - self._sent) / self.interval + 1.0 - _MISSING))
        self._count += passed - 1
        late = arrived - self._sent - passed * self.interval
        # at first those of the line of least squares through all arrivals
        k = self._count
        area = (k + 1.0) * (k + 2.0)
        position_gain = max(_POSITION_GAIN, (4.0 * k + 2.0) / area)
        interval_gain = max(_INTERVAL_GAIN, 6.0 / area)
        self._sent += passed * self.interval + position_gain * late
        self.interval += interval_gain * late / passed

    def _velocity(self, fastest: np.ndarray) -> np.ndarray:
        """Return the velocity (n,) [rad/s] at the last target; zero after a step.

        It is the slope of the parabola through the last target and two before, or of the line.
        """
        last, position = self._targets[-1]
        if len(self._targets) < 2 or self.interval == 0.0:
            return np.zeros_like(position)
        wanted = max(1, int(_SPAN / self.interval))
        x, slope = self._slope(last - wanted)
        farther, chord = self._slope(last - 2 * wanted)
        velocity = slope
        if farther > x:
            velocity = (farther * slope - x * chord) / (farther - x)
        velocity = velocity / self.interval
        velocity[np.abs(velocity) > _STEP * fastest] = 0.0
        return velocity

    def _slope(self, number: int) -> tuple[int, np.ndarray]:
        """Return the intervals from a target with a number, or before, and the mean rise in one."""
        last, position = self._targets[-1]
        for earlier, before in reversed(self._targets):  # noqa: B007 - the last is used
            if earlier <= number or earlier == self._targets[0][0]:
                break
        passed = last - earlier
        return passed, (position - before) / passed
