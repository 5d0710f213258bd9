# SPDX-License-Identifier: Apache-2.0
"""What the arm gets while the law is not in command: the safe torque, by what holds the arm."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.controller_groups import Safety
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.supervision.held_torque import HeldTorque
from blf_dsc_controller.supervision.kept_estimates import KeptEstimates
from blf_dsc_controller.supervision.model_torque import gravity_torque
from blf_dsc_controller.supervision.safe_torque import Load, SafeTorque
from blf_dsc_controller.supervision.stop_speed import StopSpeed
from blf_dsc_controller.supervision.supervisor import Reason
from blf_dsc_controller.supervision.swing_names import SwingNames

Vector = NDArray[np.float64]

# The cause may be commands that do not reach the arm, or wrong velocities: both wind up
# the estimates.
_PERHAPS_UNREACHED = (Reason.OUTSIDE_BOUND, Reason.SATURATED)
# So do a velocity above its limit, a contact and an oscillation.
WINDING_UP = (
    *_PERHAPS_UNREACHED,
    Reason.VELOCITY,
    Reason.CONTACT,
    Reason.OSCILLATION,
)
"""Reasons of stops before which the estimates may have wound up."""

_FASTER = 0.1  # rad/s, of a joint while the torque of a deactivation ramps down


class SafeStop:
    """The ramp to the safe torque of a controller's arm, and what becomes of the arm."""

    def __init__(
        self,
        config: ControllerConfig,
        controller: Controller,
        estimates: KeptEstimates,
        torque: SafeTorque,
        held: HeldTorque,
    ) -> None:
        """Use the ramp of `torque`, what `held` finds, and the kept `estimates` of the law."""
        self._joints, self._units = config.joints, config.units
        self._controller = controller
        self._estimates = estimates
        self._torque = torque
        self._held = held
        self._speed = StopSpeed()
        self._swings = SwingNames(config.joints)

    def begin(
        self,
        safety: Safety,
        reason: Reason,
        speed: float,
        *,
        was_running: bool,
        oscillates: bool,
    ) -> None:
        """Begin the ramp of a stop at a speed [rad/s], the largest of a joint."""
        self._speed.begin(speed)
        self._swings.begin()
        load = self._torque.load.copy()
        if was_running:
            self._continue_from_held()
            load = self._load_at_stop(reason)
        reached = reason not in (*_PERHAPS_UNREACHED, Reason.NO_EFFECT)
        self._torque.begin_ramp(
            safety.stop_ramp,
            load,
            reached=reached or oscillates,
            oscillates=oscillates,
        )

    def begin_deactivation(self, safety: Safety) -> None:
        """Begin the ramp of a law that leaves command in order.

        A linear ramp of R from the torque of an acceleration a makes a joint faster by
        a R / 2.  It is so short that this is at most `_FASTER`.
        """
        self._swings.begin()
        fastest = float(np.abs(self._controller.signals.ddqr).max())
        ramp = safety.deactivation_ramp
        if safety.torque == 'hold_gravity' and fastest * ramp > 2.0 * _FASTER:
            ramp = 2.0 * _FASTER / fastest
        self._torque.begin_ramp(ramp, self._held.load(), source=Load.UNTIL_MOVED)

    def begin_anew(self, safety: Safety, load: Vector) -> None:
        """Begin the ramp of a law that forgets what it has learned, with this load (n,) [N m]."""
        self._swings.begin()
        self._torque.begin_ramp(safety.stop_ramp, load)

    def carried(self, safety: Safety, estimate: Vector) -> Vector | None:
        """Return the load (n,) [N m] besides an estimate (m,) that the safe torque carries.

        None: it holds none, or the arm has not shown that it does.
        """
        if safety.torque != 'hold_gravity' or not self._torque.carries:
            return None
        settings, q = self._controller.settings, self._torque.last.q
        held = gravity_torque(settings, self._estimates.estimate, q) + self._torque.load
        return held - gravity_torque(settings, estimate, q)

    def advance(self, safety: Safety, dt: float) -> Vector | None:
        """Return the torque (n,) [N m] `dt` [s] later; None before a usable state."""
        settings = self._controller.settings
        return self._torque.advance(safety, settings, self._estimates.estimate, dt)

    def leave(self, safety: Safety, *, was_running: bool) -> Vector | None:
        """Return the last torque (n,) [N m]; None before the first usable state."""
        if was_running:
            self._torque.load[:] = self._held.load()
        settings = self._controller.settings
        return self._torque.leave(safety, settings, self._estimates.estimate)

    def observe_speed(self, safety: Safety, speed: float, gap: float) -> bool:
        """Return to the load known before if the arm speeds up; return whether it does.

        `speed` [rad/s] is the largest of a joint, `gap` [s] the time since the last one.
        """
        begins = self._speed.observe(speed, gap)
        if not begins or safety.torque == 'zero':
            return False
        self._torque.stop_observing()
        return True

    def name_swings(self) -> str:
        """Return a text about joints that swing in the stop and have not been named; or empty."""
        return self._swings.name(self._torque.has_swung)

    @property
    def missing_effect(self) -> str:
        """That the last change of the commands has moved nothing; empty if it may have."""
        change = self._torque.missed_change
        if change is None:
            return ''
        worst = int(np.argmax(np.abs(change) / self._controller.settings.torque.limit))
        return (
            f'the torque of joint {self._joints[worst]!r} has changed by {change[worst]:+.4g} '
            f'{self._units[worst].torque} since, but the arm has not accelerated: release the '
            'brakes, activate the effort controller, or free the arm; a joint that sticks does so, '
            'too, if its drive gives less than it is sent'
        )

    def _continue_from_held(self) -> None:
        """Let the ramp begin at the torque that acts after a gap, also that of another node."""
        held = self._held.command()
        if held is not None:
            self._torque.commanded[:] = held

    def _load_at_stop(self, reason: Reason) -> Vector:
        """Return the torque (n,) [N m] that holds the arm besides its model when the law stops."""
        is_wound_up = reason in WINDING_UP or reason is Reason.NO_EFFECT
        if is_wound_up and self._held.after_gap is None:
            return self._estimates.disturbance
        return self._held.load()
