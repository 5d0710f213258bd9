# SPDX-License-Identifier: Apache-2.0
"""Configurations and runs of presets, for the tests of the paper's variants."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.configuration.nodes import LoopConfig, load_loop
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.telemetry import sample_columns
from blf_dsc_controller.simulation.loop import simulate

P = np.array([1.0, 0.32, 0.4])
NO_DISTURBANCE = {'disturbance.constant': [0.0, 0.0], 'disturbance.amplitude': [0.0, 0.0]}
EXACT = {
    'truth.parameters': [1.0, 0.32, 0.4],
    'truth.constant': [0.1, 0.1],
    'truth.amplitude': [0.1, 0.1],
}


def configured(
    preset: str,
    duration: float,
    law: Mapping[str, object] | None = None,
    arm: Mapping[str, object] | None = None,
) -> LoopConfig:
    """Return a preset with changes to the controller (`law`) and to the plant (`arm`)."""
    config = load_loop(preset, {'sim_plant': {'duration': duration}})
    return config._replace(
        controller=change(config.controller, law or {}), plant=change(config.plant, arm or {})
    )


class Loop(NamedTuple):
    """A whole run; the first axis is the sample."""

    t: np.ndarray  # s
    xi1: np.ndarray  # (., 2) rad
    xi2: np.ndarray  # (., 2) rad/s
    torque: np.ndarray  # (., 2) N m
    disturbance: np.ndarray  # (., 2) N m, d^3 and learned friction
    estimate: np.ndarray  # (., m)
    lyapunov: np.ndarray  # (., 4)
    latched: np.ndarray  # (.,)
    changes: np.ndarray  # (.,) of the arm, detected so far
    P: np.ndarray  # (., 3) of the plant at that time
    controller: Controller

    @property
    def parameter_error(self) -> np.ndarray:
        """|P^ - P| / |P| of each sample."""
        off = np.linalg.norm(self.estimate[:, :3] - self.P, axis=1)
        return off / np.linalg.norm(self.P, axis=1)

    def error_at(self, t: float) -> float:
        """Return the relative parameter error at a time [s]."""
        return float(self.parameter_error[np.abs(self.t - t).argmin()])

    def largest(self, begin: float) -> np.ndarray:
        """Largest |xi1| of each joint (2,) from a time on [rad]."""
        return np.abs(self.xi1[self.t >= begin]).max(axis=0)


def run(config: LoopConfig) -> Loop:
    """Run a configuration offline."""
    record = simulate(config.controller, config.plant, supervised=False)
    samples = sample_columns(record.samples, record.controller.settings)
    names = ('xi1', 'xi2', 'torque', 'disturbance', 'estimate', 'lyapunov')
    parts = [getattr(samples, name) for name in names]
    parts += [samples.latched[:, 0], samples.changes[:, 0], record.truths[:, :3]]
    return Loop(record.stamps * 1e-9, *parts, record.controller)
