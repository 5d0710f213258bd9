# SPDX-License-Identifier: Apache-2.0
"""The second line against a dead controller: its safe torque, computed elsewhere."""

from __future__ import annotations

from math import inf

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.law.factory import settings_of_config
from blf_dsc_controller.supervision.safe_torque import SafeTorque, model_torque

Vector = NDArray[np.float64]


class SecondLine:
    """Decides when to command in the place of a silent controller, and what.

    Times are those [s] of a steady clock. It commands when no torque of the controller has been
    seen for `timeout` while joint states went on by half of that, by their stamps: a plant in
    lock-step, which waits for a torque, is left alone. It ends with the next torque of the
    controller, or when the safe torque has faded because the states stopped, too.

    The gravity is that of the initial estimate, and what it lacks (a payload, say) is observed from
    the motion and the controller's torques all along, as in a safe stop.

    Attributes:
        config: configuration of the controller.
        active: whether it commands now.
        takeovers: how often it began to.
        stamp: of the last joint state [ns]; -1 before the first.
        silence: time [s] without a torque of the controller at the last takeover.
    """

    def __init__(self, config: ControllerConfig, timeout: float, *, armed: bool = False) -> None:
        """Compile the model of a controller's configuration.

        With `armed` it does not wait for a first torque: the controller has died before.
        """
        self.config = config
        self.active = False
        self.takeovers = 0
        self.silence = 0.0
        self._timeout = timeout
        self._settings = settings_of_config(config)
        self._safe = SafeTorque(self._settings.n)
        self._safe.longest_step = config.sample_time
        self.stamp = self._commanded_stamp = -1  # the second: before the last torque
        self._seen_at = self._polled_at = -inf
        self._commanded_at = inf  # no takeover before the first torque
        self._knows_torque = False
        self._armed = armed
        model_torque(self._settings, self._estimate, np.zeros(self._settings.n))

    @property
    def _estimate(self) -> Vector:
        return self._settings.initial_estimate

    def state(self, stamp: int, measurement: Vector, now: float) -> None:
        """Take a joint state with its stamp [ns]; `measurement` is [q, dq, effort] (3 n,)."""
        limit = self.config.safety.velocity_limit
        self._safe.last.salvage(stamp, measurement, limit, self.config.sample_time)
        if stamp > self.stamp or self.stamp < 0:
            self._seen_at = now
        self.stamp = stamp
        if self._armed:
            self._armed, self._commanded_at, self._commanded_stamp = False, now, stamp

    def torque_of_controller(self, torque: Vector, now: float) -> None:
        """Take a torque (n,) [N m] that the controller has commanded, and hand over to it."""
        self._safe.commanded[:] = np.nan_to_num(torque)
        self._knows_torque = True
        self._commanded_at, self._commanded_stamp = now, self.stamp
        self.active = False

    def poll(self, now: float) -> Vector | None:
        """Return the torque (n,) [N m] to command now, None to stay silent."""
        dt, self._polled_at = min(now - self._polled_at, self._timeout), now
        safety, safe = self.config.safety, self._safe
        if now - self._seen_at > self.config.sample_time + safety.state_timeout:
            safe.last.miss(dt)
        if not self.active:
            if self._knows_torque:
                safe.observe(self._settings, self._estimate, dt)
            self._begin_if_due(now)
        if not self.active:
            return None
        torque = safe.advance(safety, self._settings, self._estimate, dt)
        if safe.last.age >= safety.fade_time:
            self.active, self._commanded_at = False, inf
        return torque

    def leave(self) -> Vector | None:
        """Return the torque to leave behind, None if the controller commands."""
        if not self.active:
            return None
        return self._safe.leave(self.config.safety, self._settings, self._estimate)

    def _begin_if_due(self, now: float) -> None:
        silence = now - self._commanded_at
        gone_on = (self.stamp - self._commanded_stamp) * 1e-9
        if silence > self._timeout and gone_on > 0.5 * self._timeout:
            self.active, self.silence = True, silence
            self.takeovers += 1
            self._safe.begin_ramp(0.0, self._safe.load)
            if not self._knows_torque:  # as if the torque that the drive holds were the model's
                self._safe.leave(self.config.safety, self._settings, self._estimate)
