# SPDX-License-Identifier: Apache-2.0
"""The last trusted joint state, from which the safe torque is computed.

The safe torque damps the velocity by the positions, behind a low pass:

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
from blf_dsc_controller.supervision.observed_load import OBSERVER
from blf_dsc_controller.supervision.recent_motion import is_gap

Vector = NDArray[np.float64]

_REMEMBERED_NS = (
    250_000_000  # ns after a gap, for which the next may be as long as one before
)
_LONGEST_GAP = 0.25  # s: after a longer one the arm is braked all the same


class LastState:
    """The last trusted joint state.

    Attributes:
        measurement: [q, dq, applied torque] (3 n,) [rad, rad/s, N m].
        q, dq: views of it; a velocity that is currently unknown is zero.
        is_measured: whether dq is as measured; else it is `slow`.
        slow: v (n,) [rad/s], the velocity to damp.
        ddq: acceleration since the state before (n,) [rad/s^2], None if it is unknown.
        interval: time [s] since the state before, which ddq is over.
        age: time without a trusted state [s]; infinite before the first.
        gap: longest time [s] between two trusted states between which others were missing or not
            trusted, at most 0.25 s; 0 once none were for a quarter of a second.
        stamp: of the last state [ns]; -1 before the first.
        speed: of each joint (n,) [rad/s], as measured with the law, and beside it as the last
            two positions showed it.
    """

    def __init__(self, n: int) -> None:
        self.measurement = np.zeros(3 * n)
        self.q = self.measurement[:n]
        self.dq = self.measurement[n : 2 * n]
        self.slow = np.zeros(n)
        self.ddq: Vector | None = None
        self.interval = inf
        self.age = inf
        self.gap = 0.0
        # ns, stamps of the states after the last gap, and the last one in which states were missing
        self._resumed = self._missed = 0
        # s, in which each state beside the law had its velocity
        self._measured_for = inf
        self.stamp = -1
        self.speed = np.zeros(n)
        self._known: Vector | None = None  # dq, while it is forgotten
        self.is_measured = True

    def take(self, stamp: int, measurement: Vector, slow: Vector) -> None:
        """Store a valid state with its stamp [ns] and v (n,) [rad/s]."""
        self.measurement[:] = measurement
        self.slow[:] = slow
        self.speed = np.abs(self.dq)
        self.ddq = None
        self.age = 0.0
        self.stamp = stamp
        self._known = None
        self._measured_for = inf  # the law uses no others

    def follow(
        self,
        stamp: int,
        measurement: Vector,
        fastest: Vector,
        period: float,
        *,
        continues: bool = True,
        is_new: bool = True,
        is_measured: bool = True,
    ) -> None:
        """Store a trusted state beside the law, `period` [s] after the last as a rule.

        Velocities that are not measured, not finite or beyond `fastest` (n,) [rad/s] are replaced
        with `slow`.  After a silence, whose positions show only its mean velocity, and where the
        state does not continue the last one, `slow` begins with those that were measured.  A
        reading that is not new does not show how fast the arm is.
        """
        q, dq, _ = measurement.reshape(3, -1)
        elapsed = (stamp - self.stamp) * 1e-9
        is_next = continues and elapsed > 0.0 and not is_gap(elapsed, period)
        is_next = is_next and self.age < inf
        self.measure_gap(stamp, period)
        if self._known is not None:
            self.dq[:] = self._known
            self._known = None
        differenced = np.zeros_like(q)
        if is_next:
            differenced = (q - self.q) / elapsed
            self.speed = np.abs(differenced) if is_new else self.speed
            differenced = np.clip(differenced, -fastest, fastest)
            self.slow += min(1.0, elapsed / FILTER) * (differenced - self.slow)
        # one that comes and goes is none: the two observers of the load would alternate
        is_measured &= bool((np.abs(dq) <= fastest).all())
        passed = max(0.0, elapsed)
        self._measured_for = self._measured_for + passed if is_measured else 0.0
        is_usable = self._measured_for >= FILTER
        usable = np.where(np.abs(dq) <= fastest, dq, 0.0)
        if not is_next:
            self.slow[:] = usable
        if not is_usable:
            # differenced twice, positions would show the noise of their encoders
            usable = self.slow
        is_known = is_next and is_usable == self.is_measured
        self.is_measured = is_usable
        self.ddq = (usable - self.dq) / elapsed if is_known else None
        self.interval = elapsed
        self.q[:] = q
        self.dq[:] = usable
        self.age = 0.0
        self.stamp = stamp

    @property
    def has_settled(self) -> bool:
        """Whether states have come since the last gap for as long as `slow` takes to settle."""
        return (self.stamp - self._resumed) * 1e-9 >= FILTER

    def skip(self, period: float) -> None:
        """Account for a state that is not trusted, as of a `period` [s], whatever its stamp."""
        self.age += period
        if self.age > max(FILTER, self.gap):  # longer than its damping allows for
            self._forget_motion()

    def miss(self, period: float) -> None:
        """Account for `period` [s] without a state: the motion is unknown."""
        self.age += period
        self._forget_motion()

    def _forget_motion(self) -> None:
        """Take the motion for unknown: v and dq are zero until the next state."""
        if self._known is None:
            self._known = self.dq.copy()
        self.dq[:] = self.slow[:] = 0.0
        self.ddq = None

    def measure_gap(self, stamp: int, period: float) -> None:
        """Measure the gap that a state with this stamp [ns] ends, before it is stored.

        `period` [s] is the usual time between two states.
        """
        # where the clock is set back, no states are missing
        back = min(0, stamp - self.stamp)
        self._resumed += back
        self._missed += back
        gap = (stamp - self.stamp) * 1e-9
        if stamp - self._missed > _REMEMBERED_NS:
            self.gap = 0.0
        longest = LONG_GAP * period
        if self.stamp >= 0 and gap > longest:
            self._missed = stamp
            self.gap = max(self.gap, min(gap, _LONGEST_GAP))
        # a shorter one is a sample of the load's observer
        if gap > max(longest, 1.0 / OBSERVER[0]):
            self._resumed = stamp
        self.stamp = stamp
