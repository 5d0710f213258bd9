# SPDX-License-Identifier: Apache-2.0
"""The safe torque, the state it is computed from, and the ramps between it and the law."""

from __future__ import annotations

from math import inf

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.batch import regressors_at
from blf_dsc_controller.configuration.controller import Safety
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.drive import added_torque
from blf_dsc_controller.law.saturation import RATE_CUT
from blf_dsc_controller.law.settings import Settings

Vector = NDArray[np.float64]


class LastState:
    """The last usable joint state.

    Attributes:
        measurement: [q, dq, applied torque] (3 n,) [rad, rad/s, N m].
        q, dq: views of it; a velocity that is currently unknown is zero.
        age: time without a usable state [s]; infinite before the first.
    """

    def __init__(self, n: int) -> None:
        self.measurement = np.zeros(3 * n)
        self.q = self.measurement[:n]
        self.dq = self.measurement[n : 2 * n]
        self.age = inf
        self._stamp = -1

    def take(self, stamp: int, measurement: Vector) -> None:
        """Store a valid state with its stamp [ns]."""
        self.measurement[:] = measurement
        self.age = 0.0
        self._stamp = stamp

    def salvage(
        self, stamp: int, measurement: Vector, velocity_limit: float, period: float
    ) -> None:
        """Store the usable part of any other state, `period` [s] after the last.

        Positions that are not finite or have a repeated stamp do not show where the arm is now.
        """
        q, dq, _ = measurement.reshape(3, -1)
        if stamp == self._stamp or not np.isfinite(q).all():
            self.miss(period)
            return
        self.q[:] = q
        self.dq[:] = np.where(np.abs(dq) <= velocity_limit, dq, 0.0)
        self.age = 0.0
        self._stamp = stamp

    def miss(self, period: float) -> None:
        """Account for `period` [s] without a usable state."""
        self.dq[:] = 0.0
        self.age += period


def safe_torque(safety: Safety, settings: Settings, last: LastState, estimate: Vector) -> Vector:
    """Return the safe torque (n,) [N m], within the torque limit and always finite.

    It is zero, damping -D dq, or damping plus gravity H(q, 0, 0, 0) P^ as far as the drive does not
    add it, and fades to zero while no usable state arrives.
    """
    torque = np.zeros(settings.n)
    if last.age >= safety.fade_time:
        return torque
    with np.errstate(over='ignore', invalid='ignore'):  # checked below
        if safety.torque != 'zero':
            torque -= np.array(safety.damping) * last.dq
        if safety.torque == 'hold_gravity':
            rest = np.zeros((1, settings.n))
            (H,) = regressors_at(settings.model, last.q[np.newaxis], rest, rest, rest)
            torque += H @ estimate[: settings.p] - added_torque(settings, last.q)
    if not np.isfinite(torque).all():
        return np.zeros(settings.n)
    limited = np.clip(torque, -settings.torque_limit, settings.torque_limit)
    return limited * (1.0 - last.age / safety.fade_time)


class SafeTorque:
    """The torque without the law: a ramp from the last torque to the safe torque.

    Attributes:
        commanded: the last torque (n,) [N m], from the law or this ramp.
        last: the last usable joint state.
    """

    def __init__(self, n: int) -> None:
        self.commanded = np.zeros(n)
        self.last = LastState(n)
        self._start = np.zeros(n)
        self._duration = self._elapsed = 0.0

    def begin_ramp(self, duration: float) -> None:
        """Start a linear ramp of `duration` [s] at the last torque."""
        self._start[:] = self.commanded
        self._duration, self._elapsed = duration, 0.0

    def advance(
        self, safety: Safety, settings: Settings, estimate: Vector, dt: float
    ) -> Vector | None:
        """Return the torque (n,) [N m] `dt` [s] later; None before the first usable state."""
        if self.last.age == inf:
            return None
        goal = safe_torque(safety, settings, self.last, estimate)
        self._elapsed += dt
        if self._elapsed < self._duration:
            goal = self._start + self._elapsed / self._duration * (goal - self._start)
        limit = settings.torque_limit
        self.commanded[:] = np.clip(goal, -limit, limit)
        return self.commanded


def limit_first_torque(controller: Controller, last: Vector, dt: float) -> None:
    """Limit the rate of the law's first torque, `dt` [s] after the torque `last` (n,) [N m].

    The law does not know `last`.
    """
    settings, state, sample = controller.settings, controller.state, controller.sample
    step = np.where(settings.rate_limit > 0.0, settings.rate_limit * dt, inf)
    slowed = np.clip(sample.torque, last - step, last + step)
    limited = np.clip(slowed, -settings.torque_limit, settings.torque_limit)
    cut = limited != sample.torque
    state.rate_cuts[cut] += 1.0
    sample.cuts[cut] += RATE_CUT
    sample.torque[:] = state.torque[:] = limited
