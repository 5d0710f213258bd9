# SPDX-License-Identifier: Apache-2.0
"""How a law takes an arm over: along which motion, and from which torque."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.start import Start
from blf_dsc_controller.reference.approach import BlendedReference
from blf_dsc_controller.supervision.first_torque import check_first_torque
from blf_dsc_controller.supervision.held_torque import HeldTorque
from blf_dsc_controller.supervision.reading import Reading
from blf_dsc_controller.supervision.running_reference import RunningReference

Vector = NDArray[np.float64]


class Takeover:
    """The start of a controller's law, and its return to the reference after a gap.

    Attributes:
        acting: torque (n,) [N m] by which another node holds the arm; None: none does.
        carried: load (n,) [N m] that acts at a reset, which the law goes on to carry; None: it
            begins with its estimates.
        left_at: positions (n,) [rad] at which the law left command; None: it has had none.
    """

    def __init__(
        self, controller: Controller, reference: RunningReference, held: HeldTorque
    ) -> None:
        self.acting: Vector | None = None
        self.carried: Vector | None = None
        self.left_at: Vector | None = None
        self._controller = controller
        self._reference = reference
        self._held = held

    def start(
        self,
        config: ControllerConfig,
        reading: Reading,
        commanded: Vector | None,
    ) -> bool:
        """Begin with a joint state; return whether the running reference is resumed.

        Else it starts there at t = 0.  `commanded` (n,) [N m] is the last
        torque, None before the first one.

        Raises:
            StartError: the law cannot take over there.
            MotionError: no approach from there keeps the limits.
        """
        stamp, q, dq = reading.stamp, reading.q, reading.dq
        reference = self._reference
        motion = None
        if reference.resumable:
            motion = reference.plan_resumption(config, stamp, q, dq)
        resumed = motion is not None
        if motion is None:
            again = commanded is not None
            motion = reference.plan_start(config, q, dq, again=again)
        self._controller.reference_vector = motion.vector
        self._begin_elsewhere(q)
        self._begin_at_acting(q)
        if self.carried is not None:
            self._begin_with_load(self.carried)
        if commanded is None:
            check_first_torque(
                self._controller, config, reading.measurement, self.acting
            )
        if not resumed:
            reference.start_at(stamp, config, q)
        self._follow(motion, q, commanded)
        return resumed

    def rejoin(
        self,
        config: ControllerConfig,
        reading: Reading,
        commanded: Vector | None,
    ) -> bool:
        """Return to the running reference; return whether the arm is near enough for that.

        The arguments are those of `start`.  If the sample before was the first one, its plan
        may have taken all that time: another would take it again, and the law go on blind.
        """
        stamp, q, dq = reading.stamp, reading.q, reading.dq
        reference = self._reference
        has_just_planned = self._controller.samples == 1
        way = reference.as_planned if has_just_planned else reference.plan_resumption
        motion = way(config, stamp, q, dq)
        if motion is None:
            return False
        self._controller.begin(Start.AFTER_GAP)
        self._follow(motion, q, commanded)
        return True

    def _begin_elsewhere(self, q: Vector) -> None:
        """Keep nothing of the posture that the arm was left in, if it is elsewhere.

        That is farther away than the bound on its error.
        """
        left_at, self.left_at = self.left_at, None
        law = self._controller
        if left_at is not None and (np.abs(q - left_at) > law.bound_at(0.0)).any():
            law.begin(Start.ELSEWHERE)

    def _begin_at_acting(self, q: Vector) -> None:
        """Let the law begin with the torque that another node holds the arm by, if any."""
        if self.acting is None:
            return
        self._begin_with_load(self._held.load_of(self.acting, q))
        self._controller.take_over(self.acting, q)

    def _begin_with_load(self, load: Vector) -> None:
        """Let d^3 begin with a load (n,) [N m]."""
        law = self._controller
        integrates = law.settings.disturbance.gain > 0.0
        law.state.disturbance[integrates] = load[integrates]

    def _follow(
        self, motion: BlendedReference, q: Vector, commanded: Vector | None
    ) -> None:
        """Follow a motion from q (n,) [rad] on, at the torque that acts."""
        self._reference.follow_from_start(motion)
        if commanded is not None and self.acting is None:
            held = self._held.command()
            self._controller.take_over(commanded if held is None else held, q)
