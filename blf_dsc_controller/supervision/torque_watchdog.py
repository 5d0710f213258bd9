# SPDX-License-Identifier: Apache-2.0
"""The watchdog on commands: it commands the safe torque if the controller is silent."""

from __future__ import annotations

from dataclasses import replace
from math import inf, isfinite

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.supervision.hold import FADE_TIME, Hold
from blf_dsc_controller.supervision.reading import Readings
from blf_dsc_controller.supervision.sensor_noise import SensorNoise
from blf_dsc_controller.supervision.state_watchdog import LONG_SILENCE
from blf_dsc_controller.supervision.swing import SwingNames

Vector = NDArray[np.float64]


class TorqueWatchdog:
    """Decides when to command in the place of a silent controller, and what.

    Times are those [s] of a steady clock. It commands when no torque of the controller
    has been seen for `timeout` while joint states went on by half of that, by their
    stamps: a plant in lock-step, which waits for a torque, is left alone. It ends with
    the next torque of the controller, or once the states have stopped for as long as
    a load in doubt takes to fade: the drives then keep the gravity of where the arm was.

    It then waits for the next torque of the controller before it watches again, as it
    does after a silence of the states of LONG_SILENCE, and after the controller has
    said that its silence is meant (`stand_down`).  While it commands, nothing else may hold
    the arm, so only a torque of the controller ends that.

    The gravity is that of the initial estimate, and what is missing in it (a payload, say) is
    observed from the motion and the controller's torques all along, as in a safe stop.

    Attributes:
        config: configuration of the controller.
        active: whether it commands now.
        takeovers: how often it began to.
        stamp: of the last joint state [ns]; -1 before the first.
        silence: time [s] without a torque of the controller at the last takeover.
        stands_down: whether the controller has said that its silence is meant.
    """

    def __init__(
        self, config: ControllerConfig, timeout: float, *, armed: bool = False
    ) -> None:
        """Compile the model of a controller's configuration.

        With `armed` it does not wait for a first torque: the controller has died
        before.
        """
        self.active = False
        self.takeovers = 0
        self.silence = 0.0
        self.stands_down = False
        self._timeout = timeout
        self._sensor = SensorNoise(len(config.joints))
        self._readings = Readings(config, self._sensor.state)
        self._swings = SwingNames(config.joints)
        self.config = config
        settings = settings_of_config(config)
        self._hold = Hold(
            self._readings, settings, settings.initial_estimate, config.sample_time
        )
        self._limit = settings.torque.limit
        self.stamp = -1
        self._commanded_stamp = -1  # of the last state before the last torque
        self._state_at = -inf
        self._polled_at = -inf
        self._commanded_at = inf  # no takeover before the first torque
        self._knows_torque = False
        self._armed = armed
        self._rehearse()

    def configure(self, config: ControllerConfig) -> None:
        """Use another configuration of the same joints, from the next torque on."""
        if config.robot != self.config.robot:
            self._hold.forget_load()  # what was missing was missing from another model
            self._readings.count_turns_anew(config)
        self._readings.set_limits(config.safety)
        self.config = config
        settings = settings_of_config(config)
        self._hold.configure(settings, settings.initial_estimate, config.sample_time)
        self._limit = settings.torque.limit

    def _rehearse(self) -> None:
        """Compute a safe torque as after a takeover: its kernels are compiled then."""
        n = self._limit.size
        sensor = SensorNoise(n)
        readings = Readings(self.config, sensor.state)
        settings = settings_of_config(self.config)
        hold = Hold(
            readings, settings, settings.initial_estimate, self.config.sample_time
        )
        holding = replace(self.config.safety, torque='hold_gravity')
        for k in (1, 2):  # the second one shows an acceleration
            reading = readings.take(k * self.config.sample_time_ns, np.zeros(3 * n))
            sensor.take(reading)
            readings.follow(reading)
            hold.advance(holding, 0.0)

    @property
    def has_state(self) -> bool:
        """Whether it knows where the arm is."""
        return self._readings.last.age < FADE_TIME

    @property
    def watches(self) -> bool:
        """Whether it takes over once the controller is silent, or has done so."""
        is_armed = isfinite(self._commanded_at) and self._knows_torque
        return self.active or (is_armed and self.has_state and not self.stands_down)

    def is_engaged(self, now: float) -> bool:
        """Whether it commands, or the controller did just now."""
        since = now - self._commanded_at  # infinite before the first torque
        return self.active or 0.0 <= since <= self._timeout

    def stand_down(self) -> bool:
        """Command nothing until the controller commands again after `stand_by`.

        Return whether it does: not while it commands.
        """
        if self.active:
            return False
        self.stands_down = True
        self._forget_controller()
        return True

    def stand_by(self) -> None:
        """Watch again from the next torque of the controller on."""
        if self.stands_down:
            self.stands_down = False
            self._forget_controller()

    def take_state(self, stamp: int, measurement: Vector, now: float) -> None:
        """Take a joint state [q, dq, effort] (3n,) with its stamp [ns]."""
        reading = self._readings.take(stamp, measurement)
        if reading.doubt is not None:
            return  # `poll` counts the time without a state
        self._sensor.take(reading)
        self._readings.follow(reading)
        if now - self._state_at > LONG_SILENCE:
            self._forget_controller()
        if stamp > self.stamp:
            self._state_at = now
        self.stamp = stamp
        if self._armed:
            self._armed = False
            self._commanded_at = now
            self._commanded_stamp = stamp

    def take_torque(self, torque: Vector, now: float) -> None:
        """Take a torque (n,) [N m] of the controller, and hand over to it.

        Of one that is not finite or beyond its limit, it is not known what the drive holds.
        """
        if (np.abs(torque) <= self._limit).all():
            self._hold.commanded[:] = torque
            self._knows_torque = True
        self._commanded_at = now
        self._commanded_stamp = self.stamp
        self.active = False

    def poll(self, now: float) -> Vector | None:
        """Return the torque (n,) [N m] to command now, None to stay silent."""
        dt = min(now - self._polled_at, self._timeout)
        self._polled_at = now
        safety = self.config.safety
        last = self._readings.last
        if now - self._state_at > self.config.sample_time + safety.state_timeout:
            last.miss(dt)
        if not self.active:
            if self._knows_torque:
                self._hold.observe(dt)
            self._take_over_if_silent(now)
        if not self.active:
            return None
        torque = self._hold.advance(safety, dt)
        if last.age >= FADE_TIME:
            self._forget_controller()
        return torque

    def name_swings(self) -> str:
        """Return a text about joints that swing under its torque, each once; or empty."""
        return self._swings.name(self._hold.has_swung)

    def leave(self) -> Vector | None:
        """Return the torque to leave behind, None if the controller commands."""
        if not self.active:
            return None
        return self._hold.leave(self.config.safety)

    def _forget_controller(self) -> None:
        """Wait for a torque of the controller."""
        self.active = False
        self._commanded_at = inf

    def _take_over_if_silent(self, now: float) -> None:
        """Begin to command if the controller is silent at this time [s] but joint states go on."""
        silence = now - self._commanded_at
        state_progress = (self.stamp - self._commanded_stamp) * 1e-9
        is_silent = silence > self._timeout and state_progress > 0.5 * self._timeout
        if self.stands_down or not is_silent:
            return
        self.active = True
        self.silence = silence
        self.takeovers += 1
        self._swings.begin()
        # as if the torque that the drive holds were the model's
        if not self._knows_torque:
            self._hold.leave(self.config.safety)
