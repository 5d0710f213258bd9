# SPDX-License-Identifier: Apache-2.0
"""The check of every joint state before the law uses it: stamps, values, missed states.

It reads no clock, so the same states always have the same faults.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import Safety
from blf_dsc_controller.supervision.supervisor import Fault, Reason

Vector = NDArray[np.float64]
_NANO = 1e-9

SKIP = Fault(Reason.NONE, '')
"""Returned for a state to ignore."""


class StateCheck:
    """Checks joint states, one after the other.

    Attributes:
        repeated: states ignored because their stamp was repeated.
        missed: states missing between consecutive stamps, since the start.
        missed_fraction: fraction of missed states, averaged exponentially over
            safety.overrun_window; by their stamps, so a slow computer in lock-step misses none.
    """

    def __init__(self, joints: Sequence[str], sample_time: float) -> None:
        """`sample_time` is T [s]."""
        self._joints = tuple(joints)
        self._sample_time = sample_time
        self._one_sample = (0.5e9 * sample_time, 1.5e9 * sample_time)  # ns
        self.repeated = 0
        self.restart()

    def restart(self) -> None:
        """Start with the next state, whatever its stamp."""
        self.missed = 0
        self.missed_fraction = 0.0
        self._last_stamp = -1
        self._repeats = 0

    def advance(self, stamp: int) -> None:
        """Mark all states up to a stamp [ns] as checked."""
        self._last_stamp = stamp

    def check(self, safety: Safety, stamp: int) -> Fault | None:
        """Return why the controller must stop, SKIP to ignore the state, or None to use it.

        The stamp is in ns; the values are checked by the law (`law.checks.is_valid_state`).
        """
        fault = None if self._is_next(stamp) else self._check_stamp(safety, stamp)
        if fault is None:
            self._last_stamp = stamp
        return fault

    def _is_next(self, stamp: int) -> bool:
        """Whether a stamp is one sample after the last, with nothing to count."""
        shortest, longest = self._one_sample
        return (
            shortest < stamp - self._last_stamp < longest
            and self._last_stamp > 0
            and self._repeats == 0
            and self.missed_fraction == 0.0
        )

    def _check_stamp(self, safety: Safety, stamp: int) -> Fault | None:
        if stamp <= 0:
            text = f'a joint state has the stamp {stamp} ns, which is not a valid time'
            return Fault(Reason.STAMP_MISSING, text)
        if self._last_stamp < 0:
            return None
        step = (stamp - self._last_stamp) * _NANO
        if step == 0.0:
            return self._check_repeats(safety)
        self._repeats = 0
        if step < 0.0:
            text = f'the stamp of a joint state is {-step:.6g} s before the last one'
            return Fault(Reason.STAMP_BACKWARD, text)
        if step > self._sample_time + safety.state_timeout:
            text = (
                f'the stamp of a joint state is {step:.6g} s after the last one: '
                f'{self._sample_time:g} s is the sample time, and it may be late by '
                f'{safety.state_timeout:g} s (safety.state_timeout)'
            )
            return Fault(Reason.STAMP_JUMP, text)
        return self._count_missed(safety, max(1, round(step / self._sample_time)) - 1)

    def _check_repeats(self, safety: Safety) -> Fault:
        self.repeated += 1
        self._repeats += 1
        if self._repeats <= safety.repeated_states:
            return SKIP
        text = f'{self._repeats} joint states in a row repeat the stamp of the one before them'
        return Fault(Reason.STAMP_REPEATED, text)

    def _count_missed(self, safety: Safety, missed: int) -> Fault | None:
        keep = 1.0 - min(1.0, self._sample_time / safety.overrun_window)
        self.missed += missed
        self.missed_fraction *= keep
        if missed:
            self.missed_fraction = 1.0 - (1.0 - self.missed_fraction) * keep**missed
        if self.missed_fraction <= safety.overrun_fraction:
            return None
        text = (
            f'{100.0 * self.missed_fraction:.0f} % of the joint states were missed: more than '
            f'safety.overrun_fraction allows over {safety.overrun_window:g} s, or the arm sends '
            f'them less often than every {self._sample_time:g} s (sample_time)'
        )
        return Fault(Reason.OVERRUN, text)

    def invalid(self, safety: Safety, measurement: Vector) -> Fault:
        """Return the fault of an invalid [q (n,) rad, dq (n,) rad/s, effort (n,) N m]."""
        q, dq, effort = measurement.reshape(3, -1)
        if not np.isfinite(q).all():
            return Fault(Reason.NOT_FINITE, f'the positions are not finite: {q}')
        if not np.isfinite(dq).all():
            text = f'velocities are missing or not finite: {dq}'
            remedy = 'if the hardware measures none, set safety.velocity to estimated'
            return Fault(Reason.NOT_FINITE, f'{text}; {remedy}')
        worst = int(np.argmax(np.abs(dq)))
        if abs(dq[worst]) <= safety.velocity_limit:
            return Fault(
                Reason.NOT_FINITE, f'efforts used for learning are missing or not finite: {effort}'
            )
        text = (
            f'the velocity of joint {self._joints[worst]!r} is {dq[worst]:+.6g} rad/s: more '
            f'than safety.velocity_limit, {safety.velocity_limit:g} rad/s'
        )
        return Fault(Reason.VELOCITY, text)
