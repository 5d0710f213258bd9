# SPDX-License-Identifier: Apache-2.0
"""Another motion than the one that was learned from, and the torque error of a model on it."""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.arms.batch import regressors_at
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.law.factory import model_of
from blf_dsc_controller.reference import terms
from blf_dsc_controller.reference.approach import reference_of

_ROWS = 200
_ROWS_FOR = 15.0  # s


def another_motion(config: ControllerConfig, seed: int) -> ControllerConfig:
    """Return a configuration with other signs and phases of the reference's sinusoids."""
    random, reference = np.random.default_rng(seed), config.reference
    signs = random.choice((-1.0, 1.0), len(reference.amplitude))
    motion = {
        'reference.amplitude': (signs * reference.amplitude).tolist(),
        'reference.phase': random.uniform(0.0, 2.0 * np.pi, len(reference.phase)).tolist(),
    }
    return change(config, motion)


def torque_rows(config: ControllerConfig) -> np.ndarray:
    """Return the rows of H(q, q', q', q'') (k, p) along the configured reference."""
    model = model_of(config)
    times = np.linspace(0.0, _ROWS_FOR, _ROWS)
    q, dq, ddq = np.moveaxis(terms.sampled(reference_of(config), times), 1, 0)
    return regressors_at(model, q, dq, dq, ddq).reshape(_ROWS * model.n, -1)


def torque_error(rows: np.ndarray, estimate: np.ndarray, P: np.ndarray) -> float:
    """Return the torque error of a learned model on such rows, relative to their torque."""
    return float(np.linalg.norm(rows @ (estimate - P)) / np.linalg.norm(rows @ P))
