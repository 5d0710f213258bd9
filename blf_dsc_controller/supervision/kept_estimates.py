# SPDX-License-Identifier: Apache-2.0
"""The estimates that hold an arm after a stop: those of the last sound sample, or earlier ones.

The law keeps them from sample to sample (`law.kept_estimates`); which of them count after a
fault is said here.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.start import Start
from blf_dsc_controller.law.torque_sensors import is_fading

Vector = NDArray[np.float64]


class KeptEstimates:
    """The estimates for the torque without the law, and for its next start."""

    def __init__(self, controller: Controller) -> None:
        """Keep the estimates that the law has now."""
        self._controller = controller
        self._past = controller.checks.estimates
        self.keep()

    @property
    def estimate(self) -> Vector:
        """The kept estimate (m,)."""
        return self._past.kept[: self._controller.settings.m]

    @property
    def disturbance(self) -> Vector:
        """The kept disturbance estimate (n,) [N m]: d^3, and r of `load_observer`."""
        return self._past.kept[self._controller.settings.m :]

    def keep(self) -> None:
        """Keep the estimates that the law has now, unless its load observer is in doubt."""
        state = self._controller.state
        if is_fading(state.observer.faded):
            return
        np.concatenate((state.estimate, state.disturbance), out=self._past.kept)
        observed = state.observer.steady
        self.disturbance[: observed.size] += observed

    def begin(self) -> None:
        """Take the kept estimates for those of all past samples: a start has no others."""
        self._past.consistent[:] = self._past.kept
        self._past.moved[:] = self._past.kept

    def return_to_consistent(self) -> None:
        """Keep the estimates from before the error grew."""
        self._past.kept[:] = self._past.consistent

    def return_to_moved(self) -> None:
        """Keep the estimates of when a joint last moved."""
        self._past.kept[:] = self._past.moved

    def restore(self) -> None:
        """Let the law begin with the kept estimates."""
        state = self._controller.state
        state.estimate[:] = self.estimate
        state.disturbance[:] = self.disturbance
        self._controller.begin(Start.AFTER_STOP)
