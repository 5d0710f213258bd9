# SPDX-License-Identifier: Apache-2.0
"""Positions that wrap: encoders that count within one turn, as (-pi, pi] or [0, 2 pi).

Law, checks and differenced velocities need positions that go on.  Turns are counted
from the first trusted state on.  For a continuous joint this is all.  Another joint has a range,
in which a driver that wraps cannot tell where it is: this is a fault.  Its turns are
counted until the next start all the same, since the safe torque needs its motion, too.
"""

from __future__ import annotations

from math import hypot, nan, pi, tau

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.reference.turns import turns_freely
from blf_dsc_controller.supervision.supervisor import Fault, Reason

Vector = NDArray[np.float64]
# s between two states, at most: later, the arm may have been moved by hand
_WRAP_TIME = 0.1
_MOST_TURNS = 1000.0  # turns: a position farther away is not measured


class Wraps:
    """Counts the turns of an arm's joints, one state after the other."""

    def __init__(self, config: ControllerConfig) -> None:
        kinds = config.robot.kinds(config.joints)
        n = len(kinds)
        self._joints = config.joints
        self._is_free = turns_freely(config)
        self._has_range = np.array([kind == 'revolute' for kind in kinds])
        self._offset = self._next = np.zeros(n)  # rad, whole turns, and with this state
        self._is_off = False  # whether any is not zero
        self._last = np.full(n, nan)  # rad, counted on
        self._counted = np.zeros(3 * n)

    def count(
        self, measurement: Vector, gap: float, fastest: Vector
    ) -> tuple[Vector, Fault | None]:
        """Count turns on in a measurement [q, dq, effort] (3n,); return it, and its fault.

        The next call overwrites it.  `gap` [s] is the time since the last trusted state,
        `fastest` (n,) [rad/s] the largest speed of each joint.
        """
        n = self._last.size
        q = measurement[:n] + self._offset if self._is_off else measurement[:n]
        step = q - self._last
        fault = None
        self._next = self._offset
        # as a rule it is less; not if a position is not finite
        if not hypot(*step.tolist()) <= pi:
            fault = self._count_on(measurement, step, gap, fastest)
            q = measurement[:n] + self._next
        self._counted[:] = measurement
        self._counted[:n] = q
        return self._counted, fault

    def trust(self, q: Vector) -> None:
        """Count on from the state that was counted last, at finite q (n,) [rad]."""
        if self._next is not self._offset:
            self._offset = self._next
            self._is_off = bool(self._offset.any())
        self._last[:] = q

    def _count_on(
        self, measurement: Vector, step: Vector, gap: float, fastest: Vector
    ) -> Fault | None:
        """Count turns in a large or not finite `step` (n,) [rad]; return the fault."""
        if not (np.abs(step) > pi).any():
            return None
        turns = -np.rint(np.nan_to_num(step, posinf=0.0, neginf=0.0) / tau)
        turns[np.abs(turns) > _MOST_TURNS] = 0.0
        moved = np.abs(step + tau * turns)
        is_wrap = 0.0 < gap < _WRAP_TIME and moved <= fastest * gap
        at_fault = self._has_range & is_wrap & (turns != 0.0)
        self._next = self._offset + tau * turns * (self._is_free | at_fault)
        if not at_fault.any():
            return None
        return self._fault(int(np.argmax(at_fault)), measurement)

    def restart(self) -> bool:
        """Take positions of joints that have a range as measured; return whether they change."""
        wrong = self._has_range & (self._offset != 0.0)
        self._offset[wrong] = 0.0
        self._is_off = bool(self._offset.any())
        self._last[wrong] = nan
        return bool(wrong.any())

    def _fault(self, i: int, measurement: Vector) -> Fault:
        before = self._last[i] - self._offset[i]
        return Fault(
            Reason.WRAPPED,
            f'the position of joint {self._joints[i]!r} has wrapped from {before:.4g} to '
            f'{measurement[i]:.4g} rad: let its driver count turns, or, if it turns without end, '
            'make it continuous in the URDF',
        )
