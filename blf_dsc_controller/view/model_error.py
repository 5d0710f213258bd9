# SPDX-License-Identifier: Apache-2.0
"""Torque error of the learned model, in simulations, whose truth is known."""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.arms.model import regressors_at
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.factory.estimate import model_of
from blf_dsc_controller.factory.gains import law_gains
from blf_dsc_controller.run import Floats


class ModelError:
    """Torques of the learned, initial and true model along the motion of an arm."""

    def __init__(self, config: ControllerConfig) -> None:
        self._model = model_of(config)
        self._initial = np.array(law_gains(config).initial_estimate)
        self._dq = np.full(len(config.joints), np.nan)
        self._time = np.nan

    def squares(
        self, time: float, q: Floats, dq: Floats, estimate: Floats, truth: Floats
    ) -> Floats:
        """Return |tau^ - tau|^2, |tau_0 - tau|^2 and |tau|^2 (3,) [(N m)^2] at a state.

        The acceleration is that since the last call, at `time` [s]; NaN where anything
        is unknown.
        """
        with np.errstate(over='ignore', invalid='ignore'):  # whoever sent them
            return self._squares(time, q, dq, estimate, truth)

    def _squares(
        self, time: float, q: Floats, dq: Floats, estimate: Floats, truth: Floats
    ) -> Floats:
        ddq = (
            (dq - self._dq) / (time - self._time) if time > self._time else dq * np.nan
        )
        self._dq = np.array(dq)
        self._time = time
        p = self._initial.size
        if not (np.isfinite(ddq).all() and np.isfinite(truth[:p]).all()):
            return np.full(3, np.nan)
        (H,) = regressors_at(
            self._model, *(each[np.newaxis] for each in (q, dq, dq, ddq))
        )
        true = H @ truth[:p]
        learned = H @ estimate[:p] - true
        initial = H @ self._initial - true
        return np.array([learned @ learned, initial @ initial, true @ true])


def shares(squares: Floats, frames: int) -> Floats:
    """Return the errors (2, k) of both models [%] from squares (k, 3).

    Each is the rms over the last `frames` frames, relative to that of the true torques.
    """
    known = np.nan_to_num(squares)
    sums = np.cumsum(known, axis=0)
    sums[frames:] -= sums[:-frames].copy() if frames < len(sums) else 0.0
    with np.errstate(divide='ignore', invalid='ignore'):
        ratio: Floats = 100.0 * np.sqrt(sums[:, :2].T / sums[:, 2])
    return ratio
