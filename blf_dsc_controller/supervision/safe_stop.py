# SPDX-License-Identifier: Apache-2.0
"""What becomes of an arm after a stop: which load it holds, and whether it comes to rest."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.controller_groups import Safety
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.sensor import FILTER
from blf_dsc_controller.supervision.held_torque import HeldTorque
from blf_dsc_controller.supervision.hold import FADE_TIME, Hold, Load
from blf_dsc_controller.supervision.kept_estimates import KeptEstimates
from blf_dsc_controller.supervision.supervisor import Doubtful, Reason, is_in_doubt
from blf_dsc_controller.supervision.swing import SwingNames

Vector = NDArray[np.float64]

# rad/s over twice the speed at the stop, for _SPEEDS_UP: a load that is new makes less of it
_SPED_UP = 0.5
_GROWING = 0.95  # of the largest speed so far
_SPEEDS_UP = 0.2  # s


class StopSpeed:
    """Finds in a safe stop that the arm speeds up instead of coming to rest."""

    def __init__(self) -> None:
        self.begin(0.0)

    def begin(self, speed: float) -> None:
        """Begin a safe stop at a speed [rad/s], the largest of a joint."""
        self._at_stop = speed
        self._peak = 0.0  # rad/s, since then
        self._speeding = 0.0  # s, for which the arm has been faster

    def observe(self, speed: float, gap: float) -> bool:
        """Take the speed of a state; return whether the arm speeds up.

        That is from when it has become faster for long enough until it is as slow again.
        `speed` [rad/s] is the largest of a joint, `gap` [s] the time since the last one.
        """
        self._peak = max(speed, self._peak)
        is_faster = speed > 2.0 * self._at_stop + _SPED_UP
        has_grown = self._speeding > _SPEEDS_UP
        is_growing = has_grown or speed > _GROWING * self._peak
        self._speeding = self._speeding + gap if is_faster and is_growing else 0.0
        return self._speeding > _SPEEDS_UP


class SafeStop:
    """The ramp to the safe torque of a controller's arm, and what becomes of the arm."""

    def __init__(
        self,
        config: ControllerConfig,
        controller: Controller,
        estimates: KeptEstimates,
        hold: Hold,
        held: HeldTorque,
    ) -> None:
        """Use the ramp of `hold`, what `held` finds, and the kept `estimates` of the law."""
        self._joints, self._units = config.joints, config.units
        self._controller = controller
        self._estimates = estimates
        self._hold = hold
        self._held = held
        self._speed = StopSpeed()
        self._has_sped_up = False  # since the stop
        self._swings = SwingNames(config.joints)

    def begin(
        self,
        reason: Reason,
        speed: float,
        *,
        was_running: bool,
        oscillates: bool,
    ) -> None:
        """Begin a stop for a reason, at a speed [rad/s], the largest of a joint.

        `was_running`: the law was in command.  `oscillates`: the arm did so.
        """
        self._speed.begin(speed)
        self._has_sped_up = False
        self._swings.begin()
        load = self._hold.load.copy()
        if was_running:
            # the ramp begins at the torque that acts after a gap, also that of another node
            acting = self._held.command()
            if acting is not None:
                self._hold.commanded[:] = acting
            in_doubt = is_in_doubt(reason, Doubtful.MOTION)
            if in_doubt and self._held.after_gap is None:
                load = self._estimates.disturbance
            else:
                load = self._held.load()
        awaits = is_in_doubt(reason, Doubtful.EFFECT) and not oscillates
        self._hold.begin(
            load,
            source=Load.AWAITED if awaits else Load.OBSERVED,
            oscillates=oscillates,
        )

    def begin_deactivation(self, safety: Safety) -> None:
        """Begin the ramp of a law that leaves command in order.

        Without the gravity of the model, what the law held the arm by fades.  With it the ramp is
        short, since it begins with what accelerates the arm.
        """
        self._swings.begin()
        ramp = FILTER if safety.torque == 'hold_gravity' else FADE_TIME
        self._hold.begin(self._held.load(), ramp=ramp, source=Load.UNTIL_MOVED)

    def begin_anew(self, load: Vector) -> None:
        """Begin the torque of a law that forgets what it has learned, with this load (n,) [N m]."""
        self._swings.begin()
        self._hold.begin(load)

    def carried(self, safety: Safety, estimate: Vector) -> Vector | None:
        """Return the load (n,) [N m] besides an estimate (m,) that the safe torque carries.

        None: it holds none, or has not yet proven to hold the arm.
        """
        if safety.torque != 'hold_gravity' or not self._hold.carries:
            return None
        return self._hold.carried - self._hold.gravity(estimate)

    def leave(self, safety: Safety, *, was_running: bool) -> Vector | None:
        """Return the last torque (n,) [N m]; None before the first usable state."""
        if was_running:
            self._hold.load[:] = self._held.load()
        return self._hold.leave(safety)

    def observe_speed(self, safety: Safety, speed: float, gap: float) -> bool:
        """Hold the load known before while the arm speeds up; return whether it does so first.

        `speed` [rad/s] is the largest of a joint, `gap` [s] the time since the last one.
        """
        if not self._speed.observe(speed, gap) or safety.torque == 'zero':
            self._hold.observe_again()
            return False
        self._hold.stop_observing()
        is_first, self._has_sped_up = not self._has_sped_up, True
        return is_first

    def name_swings(self) -> str:
        """Return a text about joints that swing in the stop and have not been named; or empty."""
        return self._swings.name(self._hold.has_swung)

    @property
    def missing_effect(self) -> str:
        """What to do if the last change of the commands has moved nothing; empty if it may have."""
        change = self._hold.missed_change
        if change is None:
            return ''
        worst = int(np.argmax(np.abs(change) / self._controller.settings.torque.limit))
        return (
            f'the torque of joint {self._joints[worst]!r} has changed by {change[worst]:+.4g} '
            f'{self._units[worst].torque} since, but the arm has not accelerated: release the '
            'brakes, activate the effort controller, or free the arm; a joint that sticks does so, '
            'too, if its drive gives less than it is sent'
        )
