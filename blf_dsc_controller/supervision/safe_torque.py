# SPDX-License-Identifier: Apache-2.0
"""The safe torque, and the ramp that leads to it from the last torque of the law."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import Safety
from blf_dsc_controller.law.settings import Settings

Vector = NDArray[np.float64]


def gravity(settings: Settings, q: Vector, estimate: Vector) -> Vector:
    """Gravity torque (n,) [N m] of the learned model at q (n,) [rad]: H(q, 0, 0, 0) P^."""
    rest = np.zeros(settings.n)
    H = np.zeros((settings.n, settings.p))
    settings.model.regressor(q, rest, rest, rest, H)
    return H @ estimate[: settings.p]


def safe_torque(
    safety: Safety, settings: Settings, q: Vector, dq: Vector, estimate: Vector
) -> Vector:
    """Safe torque (n,) [N m], within the torque limit and always finite.

    Args:
        safety: says which torque is safe.
        settings: of the law: model and torque limit.
        q: last usable positions (n,) [rad].
        dq: velocities (n,) [rad/s]; zero where they are not known.
        estimate: theta^ (m,).
    """
    torque = np.zeros(settings.n)
    with np.errstate(over='ignore', invalid='ignore'):  # what comes of it is looked at below
        if safety.torque != 'zero':
            torque -= np.array(safety.damping) * dq
        if safety.torque == 'hold_gravity':
            torque += gravity(settings, q, estimate)
    if not np.isfinite(torque).all():
        return np.zeros(settings.n)
    return np.clip(torque, -settings.torque_limit, settings.torque_limit)


class Ramp:
    """The way from one torque to another, over a set time.

    Args:
        n: joints.
    """

    def __init__(self, n: int) -> None:
        self._start = np.zeros(n)
        self._duration = 0.0
        self._elapsed = 0.0

    def begin(self, torque: Vector, duration: float) -> None:
        """Start from `torque` (n,) [N m]; it takes `duration` [s]."""
        self._start[:] = torque
        self._duration = duration
        self._elapsed = 0.0

    def towards(self, goal: Vector, dt: float) -> Vector:
        """Go on by `dt` [s] and return the torque (n,) [N m] between the start and `goal` there."""
        self._elapsed += dt
        if self._elapsed >= self._duration:
            return goal
        share = self._elapsed / self._duration
        return self._start + share * (goal - self._start)
