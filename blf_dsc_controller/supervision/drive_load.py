# SPDX-License-Identifier: Apache-2.0
"""Declare an estimated payload to the drives, so that no joint torque steps.

Drives that compensate gravity only count the load that is declared to them.  A law that
has estimated it can declare it.  They then add its weight, and the command is reduced by
it,

    whole torque = command + G_d(q) = command' + G_d'(q),    G_d' = G_d + that of the load

so that the whole torque of the joint does not change.  But the drives decide when the
change takes effect.  A command that is on its way belongs to the earlier load, and is
wrong by the change for one cycle.  So the load is declared in steps that change no
torque by more than `_STEP` of its limit, each after the one before has taken effect:
`load_declaration` has the sequence.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from blf_dsc_controller.arms.model import regressors_at
from blf_dsc_controller.arms.serial_chain import SerialChain
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.law.contact import is_touched
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.load_observer import max_load_torque
from blf_dsc_controller.law.payload import DEVIATION, MASS
from blf_dsc_controller.law.torque import added_torque
from blf_dsc_controller.messages.tip_load import TipLoad
from blf_dsc_controller.numerics.intervals import TWO_SIDED

Vector = NDArray[np.float64]

_NARROW = 0.05  # kg, half of the interval of a mass that is declared ...
_NARROW_FRACTION = 0.05  # ... or of the mass, if that is more
_CENTRE = 0.03  # m, likewise of its centre
_STEP = 0.005  # of the torque limit


def widest_interval(mass: ArrayLike) -> Vector:
    """Return half of the widest 95 % interval [kg] with which a mass [kg] is declared."""
    return np.maximum(_NARROW, _NARROW_FRACTION * np.abs(mass))


class DriveLoads:
    """The load that is declared to the drives of an arm, step by step.

    It follows the payload estimate with `load.tell_drive`, else from the first load on that is
    declared by hand.

    Attributes:
        in_force: the load that the drives have accepted last.
    """

    def __init__(self, config: ControllerConfig, controller: Controller) -> None:
        robot = config.robot
        self._at_start = TipLoad(robot.drive_payload, robot.drive_payload_centre)
        self.in_force = self._at_start
        # when the law began to learn: at the start, or at a reset
        self._base = self._at_start
        self._requested: TipLoad | None = None  # by hand, whatever is estimated
        self._controller = controller
        self._robot, self._joints = robot, config.joints
        self._is_used = config.load.tell_drive
        self._has_begun = False  # a load has been declared in part

    def declare(self, load: TipLoad) -> None:
        """Let the steps lead to this load, whatever is estimated.

        Raises:
            BlfDscError: the drives add no weight.
        """
        self._begin_use()
        self._requested = load

    def _begin_use(self) -> None:
        """Use the load from now on; raise BlfDscError if the drives add no weight."""
        if self._robot.drive_compensates == 'none':
            raise BlfDscError(
                'robot.drive_compensates: got none: these drives add no weight, so no load '
                'can be declared to them; the law estimates and carries it by itself'
            )
        self._is_used = True

    def take(self, load: TipLoad) -> None:
        """Subtract the weight of this load, which the drives add from now on, from the commands.

        Raises:
            BlfDscError: the drives add no weight.
        """
        self._begin_use()
        self.in_force = load
        self.subtract_again()

    def subtract_again(self) -> None:
        """Subtract the weight that the drives add, after the settings were replaced."""
        if not self._is_used:
            return
        controller = self._controller
        settings = controller.settings
        settings.torque.drive_inertias[:] = self._added()
        # the last command met the drives with this load already
        added = added_torque(settings.torque, controller.signals.q)
        controller.state.saturation.added[:] = added

    def forget(self) -> None:
        """Begin again with a law that has forgotten what the tip holds.

        The drives hold it by the load in force: the law counts neither.  Joint torque sensors
        measure both, so the load observer is off from then on.
        """
        if not self._is_used:
            return
        self._base = self.in_force
        self._has_begun = False
        settings = self._controller.settings
        settings.torque.drive_inertias[:] = self._added()
        is_left_out = not np.allclose(self._base.moments, self._at_start.moments)
        max_torque = 0.0 if is_left_out else max_load_torque(settings.torque.limit)
        settings.observer.max_torque[:] = max_torque

    def begin_step(self) -> TipLoad | None:
        """Begin the next step: return the load to declare now; None if there is none.

        There is none either while the estimate is too uncertain, or something touches the arm.
        """
        if not self._is_used:
            return None
        controller = self._controller
        target = (
            self._estimated_target()
            if self._requested is None
            else self._requested_target()
        )
        if target is None or is_touched(controller.state.contact):
            return None
        settings = controller.settings
        chain = SerialChain(
            settings.n, settings.torque.drive, settings.torque.drive_chain
        )
        q = controller.signals.q[np.newaxis]
        (H,) = regressors_at(chain, q, *np.zeros((3, 1, settings.n)))
        change = H @ (self._columns(TipLoad.of(target)) - self._columns(self.in_force))
        largest = float((np.abs(change) / (_STEP * settings.torque.limit)).max())
        fraction = min(1.0, 1.0 / largest) if largest > 0.0 else 1.0
        moments = self.in_force.moments
        self._has_begun = fraction < 1.0
        return TipLoad.of(moments + fraction * (target - moments))

    def _requested_target(self) -> Vector | None:
        """Return mass [kg] and moments [kg m] (4,) that a user declares.

        None: the drives have them, or nothing is declared.
        """
        if self._requested is None or np.allclose(
            self.in_force.moments, self._requested.moments
        ):
            return None
        return self._requested.moments

    @property
    def is_declared(self) -> bool:
        """Whether the drives have what a user declares, if anything."""
        return self._requested_target() is None

    def _estimated_target(self) -> Vector | None:
        """Return mass [kg] and moments [kg m] (4,) that the drives should get by the estimate.

        None: it is too uncertain, or no change.
        """
        load = self._controller.state.payload.load
        interval = TWO_SIDED * load[DEVIATION]
        narrow = widest_interval(load[MASS])
        if not 0.0 < interval < narrow:
            return None
        picked_up = np.zeros(4)
        if abs(load[MASS]) > narrow:
            centre_interval = TWO_SIDED * load[DEVIATION + 1 :]
            if not ((centre_interval > 0.0) & (centre_interval < _CENTRE)).all():
                return None
            picked_up[:] = load[MASS] * np.array((1.0, *load[MASS + 1 : DEVIATION]))
        target = self._base.moments + picked_up
        target = np.asarray(TipLoad.of(target).moments)
        is_new = abs(target[0] - self.in_force.mass) > narrow
        return target if is_new or self._has_begun else None

    def _added(self) -> Vector:
        """Return the factors of the columns of the drives' gravity that the law subtracts."""
        if self._base is self._at_start:
            return self._columns(self.in_force)
        change = self._columns(self.in_force) - self._columns(self._base)
        return self._columns(self._at_start) + change

    def _columns(self, load: TipLoad) -> Vector:
        """Return the factors of the columns of the drives' gravity, with this load."""
        robot = replace(
            self._robot, drive_payload=load.mass, drive_payload_centre=load.centre
        )
        chain = robot.chain(self._joints)
        inertias = robot.drive_inertias(chain, chain.inertias)
        return np.asarray(inertias[:, :4].ravel())
