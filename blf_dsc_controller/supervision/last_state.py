# SPDX-License-Identifier: Apache-2.0
"""The last usable joint state, from which the safe torque is computed.

The safe torque damps the velocity that the positions show, behind a low pass:

    v' = (dq/dt - v) / 0.03 s

Whatever springs a joint has, its damping then fades above the frequencies of the motion
to be braked, and cannot keep up an oscillation of the arm.  It is that of
`sensor.compare_velocities`, so that it is known from the first sample of a stop on.
"""

from __future__ import annotations

from math import inf

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.law.sensor import FILTER, LONG_GAP
from blf_dsc_controller.supervision.recent_motion import is_gap

Vector = NDArray[np.float64]

_REMEMBERED = 250_000_000  # ns, for which the next gap may be as long as one before
_LONGEST = 0.25  # s: after a longer one the arm is braked all the same


class LastState:
    """The last usable joint state.

    Attributes:
        measurement: [q, dq, applied torque] (3 n,) [rad, rad/s, N m].
        q, dq: views of it; a velocity that is currently unknown is zero.
        slow: v (n,) [rad/s], the velocity to damp.
        ddq: acceleration since the state before (n,) [rad/s^2], None if it is unknown.
        age: time without a usable state [s]; infinite before the first.
        gap: longest time [s] between two states of the last quarter of a second, in which
            states were missing, at most 0.25 s; 0 if none were.
    """

    def __init__(self, n: int) -> None:
        self.measurement = np.zeros(3 * n)
        self.q = self.measurement[:n]
        self.dq = self.measurement[n : 2 * n]
        self.slow = np.zeros(n)
        self.ddq: Vector | None = None
        self.age = inf
        self.gap = 0.0
        self._gap_ended = 0  # ns, stamp of the state after it
        self._stamp = -1

    def take(self, stamp: int, measurement: Vector, slow: Vector) -> None:
        """Store a valid state with its stamp [ns] and v (n,) [rad/s]."""
        self.measurement[:] = measurement
        self.slow[:] = slow
        self.ddq = None
        self.age = 0.0
        self._stamp = stamp

    def take_usable(
        self, stamp: int, measurement: Vector, velocity_limit: float, period: float
    ) -> None:
        """Store the usable part of any other state, `period` [s] after the last.

        Positions that are not finite or have a repeated stamp do not show where the arm
        is now. A velocity that is missing, not finite or beyond the limit is replaced
        with the one differenced from the positions, within the limit.  After a silence,
        whose positions show only its mean velocity, `slow` begins with the measured one.
        """
        q, dq, _ = measurement.reshape(3, -1)
        if stamp == self._stamp or not np.isfinite(q).all():
            self.miss(period)
            return
        elapsed = (stamp - self._stamp) * 1e-9
        self.measure_gap(stamp, period)
        is_late = is_gap(elapsed, period)
        is_next = self.age == 0.0 and elapsed > 0.0 and not is_late
        differenced = np.zeros_like(q)
        if is_next:
            differenced = np.clip(
                (q - self.q) / elapsed, -velocity_limit, velocity_limit
            )
            self.slow += min(1.0, elapsed / FILTER) * (differenced - self.slow)
        usable = np.where(np.abs(dq) <= velocity_limit, dq, differenced)
        if is_late:
            self.slow[:] = usable
        self.ddq = (usable - self.dq) / elapsed if is_next else None
        self.q[:] = q
        self.dq[:] = usable
        self.age = 0.0
        self._stamp = stamp

    def leads_to(self, stamp: int, q: Vector, fastest: float, period: float) -> bool:
        """Whether the arm at q (n,) [rad] comes from this state: no gap, and no jump.

        `stamp` [ns] is that of q, `fastest` [rad/s] the largest speed of a joint, `period`
        [s] the time between two states.
        """
        elapsed = (stamp - self._stamp) * 1e-9
        is_next = elapsed > 0.0 and not is_gap(elapsed, period)
        return bool(is_next and np.abs(q - self.q).max() <= fastest * elapsed)

    def miss(self, period: float) -> None:
        """Account for `period` [s] without a usable state."""
        self.dq[:] = self.slow[:] = 0.0
        self.ddq = None
        self.age += period

    def measure_gap(self, stamp: int, period: float) -> None:
        """Measure the gap that a state with this stamp [ns] ends, before it is stored.

        `period` [s] is the usual time between two states.
        """
        gap = (stamp - self._stamp) * 1e-9
        if stamp - self._gap_ended > _REMEMBERED:
            self.gap = 0.0
        if self._stamp >= 0 and gap > max(self.gap, LONG_GAP * period):
            self.gap = min(gap, _LONGEST)
            self._gap_ended = stamp
        self._stamp = stamp
