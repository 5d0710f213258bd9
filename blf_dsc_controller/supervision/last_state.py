# SPDX-License-Identifier: Apache-2.0
"""The last trusted joint state, from which the safe torque is computed, and what it trusts.

A state is trusted if it comes from the last one: newer, within reach of an arm, and not the
same reading although that says that the arm moves.  No other state ever enters a torque: not
one of a second sender on the same topic, of a reader that hangs, or one that arrives twice.

The safe torque damps the velocity that the positions show, behind a low pass:

    v' = (dq/dt - v) / 0.03 s

Whatever springs a joint has, its damping then fades above the frequencies of the motion
to be braked, and cannot keep up an oscillation of the arm.  It is that of
`sensor.compare_velocities`, so that it is known from the first sample of a stop on.
"""

from __future__ import annotations

from enum import Enum
from math import inf, nan

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.law.repeats import BRIDGED
from blf_dsc_controller.law.sensor import FILTER, LONG_GAP
from blf_dsc_controller.supervision.recent_motion import is_gap

Vector = NDArray[np.float64]

_REMEMBERED = 250_000_000  # ns, for which the next gap may be as long as one before
_LONGEST = 0.25  # s: after a longer one the arm is braked all the same
_STEPS = 3.0  # of the sensor: an arm that has moved by more reads otherwise
_FINEST = 1e-4  # rad, a count of an encoder of 16 bits: no step counts as less


class Doubt(Enum):
    """Why a state is not trusted."""

    NOT_FINITE = 'positions are not finite'
    COPY = 'the stamp of the last one'
    REPEATED = 'the same values, although they say that the arm moves'
    OUT_OF_REACH = 'positions that an arm does not reach from the last ones'


class LastState:
    """The last trusted joint state.

    Attributes:
        measurement: [q, dq, applied torque] (3 n,) [rad, rad/s, N m].
        q, dq: views of it; a velocity that is currently unknown is zero.
        slow: v (n,) [rad/s], the velocity to damp.
        ddq: acceleration since the state before (n,) [rad/s^2], None if it is unknown.
        age: time without a trusted state [s]; infinite before the first.
        gap: longest time [s] between two states of the last quarter of a second, in which
            states were missing, at most 0.25 s; 0 if none were.
        resolution: steps (n,) [rad] of positions.
    """

    def __init__(self, n: int) -> None:
        self.measurement = np.zeros(3 * n)
        self.q = self.measurement[:n]
        self.dq = self.measurement[n : 2 * n]
        self.slow = np.zeros(n)
        self.ddq: Vector | None = None
        self.age = inf
        self.gap = 0.0
        self.resolution = np.zeros(n)
        self._gap_ended = 0  # ns, stamp of the state after it
        self._stamp = -1
        self._read = np.full(2 * n, nan)  # q and dq as last read
        self._new_at = -1  # ns, stamp of the first state with these
        self._speed = np.zeros(n)  # rad/s, as the last positions showed it

    def take(self, stamp: int, measurement: Vector, slow: Vector) -> None:
        """Store a valid state with its stamp [ns] and v (n,) [rad/s]."""
        self._count_new(stamp, measurement)
        self.measurement[:] = measurement
        self.slow[:] = slow
        self.ddq = None
        self.age = 0.0
        self._stamp = stamp

    def follow(
        self,
        stamp: int,
        measurement: Vector,
        fastest: Vector,
        period: float,
        *,
        continues: bool = True,
    ) -> None:
        """Store a trusted state beside the law, `period` [s] after the last as a rule.

        A velocity that is not finite or beyond `fastest` (n,) [rad/s] is replaced with the one
        that the positions show, within it.  After a silence, whose positions show only its mean
        velocity, and where it does not continue the last one, `slow` begins with the measured.
        """
        self._count_new(stamp, measurement)
        q, dq, _ = measurement.reshape(3, -1)
        elapsed = (stamp - self._stamp) * 1e-9
        is_next = continues and elapsed > 0.0 and not is_gap(elapsed, period)
        is_next = is_next and self.age < inf
        self.measure_gap(stamp, period)
        differenced = np.zeros_like(q)
        if is_next:
            differenced = (q - self.q) / elapsed
            self._speed = np.abs(differenced)
            differenced = np.clip(differenced, -fastest, fastest)
            self.slow += min(1.0, elapsed / FILTER) * (differenced - self.slow)
        usable = np.where(np.abs(dq) <= fastest, dq, differenced)
        if not is_next:
            self.slow[:] = usable
        self.ddq = (usable - self.dq) / elapsed if is_next else None
        self.q[:] = q
        self.dq[:] = usable
        self.age = 0.0
        self._stamp = stamp

    def doubt(
        self, stamp: int, measurement: Vector, fastest: Vector, period: float
    ) -> Doubt | None:
        """Return why a state is not trusted; None: it comes from this one.

        `fastest` (n,) [rad/s] is the largest speed of each joint in order; it may be twice as fast,
        or twice as fast as before.  Stamps jitter, and clocks are set back: a `period` [s] counts
        as one at least.
        """
        n = self.q.size
        q = measurement[:n]
        if not np.isfinite(q).all():
            return Doubt.NOT_FINITE
        if self.age == inf:
            return None
        elapsed = (stamp - self._stamp) * 1e-9
        if elapsed == 0.0:
            return Doubt.COPY
        if self._is_repeated(stamp, measurement, period):
            return Doubt.REPEATED
        reach = 2.0 * (fastest + self._speed) * max(elapsed, period)
        if (np.abs(q - self.q) > reach).any():
            return Doubt.OUT_OF_REACH
        return None

    def _is_repeated(self, stamp: int, measurement: Vector, period: float) -> bool:
        """Whether a state is an old reading for too long, of an arm that it says moves."""
        n = self.q.size
        age = (stamp - self._new_at) * 1e-9
        if age < BRIDGED * period or not self._equals(measurement):
            return False
        least = _STEPS * np.maximum(self.resolution, _FINEST)
        return bool((np.abs(measurement[n : 2 * n]) * age > least).any())

    def _equals(self, measurement: Vector) -> bool:
        return bool((measurement[: self._read.size] == self._read).all())

    def _count_new(self, stamp: int, measurement: Vector) -> None:
        if not self._equals(measurement):
            self._read[:] = measurement[: self._read.size]
            self._new_at = stamp

    def skip(self, period: float) -> None:
        """Account for a state that is not trusted: after some, the motion is unknown."""
        self.age += period
        if self.age > LONG_GAP * period:
            self._forget_motion()

    def miss(self, period: float) -> None:
        """Account for `period` [s] without a state."""
        self._forget_motion()
        self.age += period

    def _forget_motion(self) -> None:
        self.dq[:] = self.slow[:] = 0.0
        self.ddq = None

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
