# SPDX-License-Identifier: Apache-2.0
"""The safe torque, and the ramp to it from the last torque of the law."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import Safety
from blf_dsc_controller.law.settings import Settings

Vector = NDArray[np.float64]


def safe_torque(
    safety: Safety, settings: Settings, q: Vector, dq: Vector, estimate: Vector
) -> Vector:
    """Safe torque (n,) [N m], within the torque limit and always finite.

    It is zero, damping -D dq, or damping with the gravity H(q, 0, 0, 0) P^, at the last valid
    positions q (n,) [rad]; dq (n,) [rad/s] is zero if unknown.
    """
    torque = np.zeros(settings.n)
    with np.errstate(over='ignore', invalid='ignore'):  # checked below
        if safety.torque != 'zero':
            torque -= np.array(safety.damping) * dq
        if safety.torque == 'hold_gravity':
            rest = np.zeros(settings.n)
            H = np.zeros((settings.n, settings.p))
            settings.model.regressor(q, rest, rest, rest, H)
            torque += H @ estimate[: settings.p]
    if not np.isfinite(torque).all():
        return np.zeros(settings.n)
    return np.clip(torque, -settings.torque_limit, settings.torque_limit)


class Ramp:
    """A straight line in time from one torque (n,) [N m] to another."""

    def __init__(self, n: int) -> None:
        self._start = np.zeros(n)
        self._duration = 0.0
        self._elapsed = 0.0

    def begin(self, torque: Vector, duration: float) -> None:
        """Start at `torque` (n,) [N m]; the ramp lasts `duration` [s]."""
        self._start[:] = torque
        self._duration = duration
        self._elapsed = 0.0

    def advance(self, goal: Vector, dt: float) -> Vector:
        """Advance by `dt` [s] towards `goal` and return the torque (n,) [N m] there."""
        self._elapsed += dt
        if self._elapsed >= self._duration:
            return goal
        return self._start + self._elapsed / self._duration * (goal - self._start)
