# SPDX-License-Identifier: Apache-2.0
"""The torque that holds an arm where its law stops, and the load besides the model.

Both follow from the motion before.  After a gap, in which others may have commanded the
arm, they follow from its efforts.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.torque import added_torque
from blf_dsc_controller.supervision.kept_estimates import KeptEstimates
from blf_dsc_controller.supervision.model_torque import needed_torque
from blf_dsc_controller.supervision.reading import Reading
from blf_dsc_controller.supervision.recent_motion import RecentMotion

Vector = NDArray[np.float64]


class HeldTorque:
    """The command that holds a controller's arm, and the load in it besides the model.

    Attributes:
        recent: the motion of the last samples.
        after_gap: the last reading, if it is the first after a gap; else None.
    """

    def __init__(
        self,
        config: ControllerConfig,
        controller: Controller,
        estimates: KeptEstimates,
    ) -> None:
        """Look at the law of the controller, and at its kept `estimates`."""
        self.recent = RecentMotion(len(config.joints), config.sample_time)
        self.after_gap: Reading | None = None
        self._effort = config.robot.effort
        self._controller = controller
        self._estimates = estimates

    def command(self) -> Vector | None:
        """Return the command (n,) [N m] that acts after a gap, within the torque limit.

        None: there was no gap, or efforts are no torques, or missing.
        """
        if self.after_gap is None or self._effort not in ('whole', 'commanded'):
            return None
        q, effort = self.after_gap.q, self.after_gap.effort
        if not (np.isfinite(effort).all() and np.isfinite(q).all()):
            return None
        settings = self._controller.settings
        held = effort.copy()
        if self._effort == 'whole':
            held -= added_torque(settings.torque, q)
        limit = settings.torque.limit
        return np.asarray(np.clip(held, -limit, limit))

    def load(self) -> Vector:
        """Return the load (n,) [N m] by the command after a gap, else by the last samples.

        Where these are too few, it is the disturbance estimate of the law.
        """
        held = self.command()
        if held is not None and self.after_gap is not None:
            return self.load_of(held, self.after_gap.q)
        load = self.recent.load(self._controller.settings, self._estimates.estimate)
        return self._estimates.disturbance if load is None else load

    def load_before_learning(self) -> Vector:
        """Return the load (n,) [N m] besides the initial estimate, by the last samples.

        Where these are too few, it is the disturbance estimate of the law.
        """
        settings = self._controller.settings
        load = self.recent.load(settings, settings.initial_estimate)
        return self._estimates.disturbance.copy() if load is None else load

    def load_of(self, command: Vector, q: Vector) -> Vector:
        """Return what a command (n,) [N m] carries besides the model, at rest at q (n,) [rad]."""
        at_rest = np.zeros((2, q.size))
        estimate = self._estimates.estimate
        return command - needed_torque(self._controller.settings, estimate, q, *at_rest)
