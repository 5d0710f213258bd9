# SPDX-License-Identifier: Apache-2.0
"""Configurations and runs of presets, and arms that change during learning, by events."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from blf_dsc_controller import change, load_loop, simulate
from blf_dsc_controller.analysis.lyapunov import energies
from blf_dsc_controller.law.samples import sample_columns

P = np.array([1.0, 0.32, 0.4])
NO_DISTURBANCE = {
    'disturbance.constant': [0.0, 0.0],
    'disturbance.amplitude': [0.0, 0.0],
}


def configured(
    preset: str,
    duration: float,
    law: Mapping[str, object] | None = None,
    arm: Mapping[str, object] | None = None,
) -> Any:
    """Return a preset with changes to the controller (`law`) and to the plant (`arm`)."""
    config = load_loop(preset, {'sim_plant': {'duration': duration}})
    return config._replace(
        controller=change(config.controller, law or {}),
        plant=change(config.plant, arm or {}),
    )


class Loop(NamedTuple):
    """A whole run; the first axis is the sample."""

    t: np.ndarray  # s
    xi1: np.ndarray  # (., 2) rad
    xi2: np.ndarray  # (., 2) rad/s
    torque: np.ndarray  # (., 2) N m
    disturbance: np.ndarray  # (., 2) N m, d^3 and learned friction
    estimate: np.ndarray  # (., m)
    lyapunov: np.ndarray | None  # (., 4), terms of (29)
    latched: np.ndarray  # (.,)
    changes: np.ndarray  # (.,) of the arm, detected so far
    P: np.ndarray  # (., 3) of the plant at that time
    controller: Any

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


def run(config: Any) -> Loop:
    """Run a configuration offline."""
    record = simulate(config.controller, config.plant, supervised=False)
    samples = sample_columns(record.samples, record.controller.settings)
    names = ('xi1', 'xi2', 'torque', 'disturbance', 'estimate')
    parts = [getattr(samples, name) for name in names]
    energy = energies(record.run())
    parts += [None if energy is None else energy.values]
    parts += [samples.latched[:, 0], samples.changes[:, 0], record.truths[:, :3]]
    return Loop(record.stamps * 1e-9, *parts, record.controller)


BOUND = 2e-3  # rad
WINDOW = 2.0 * np.pi  # s
OFF = {'learning.enabled': False}
CHANGED = 20.0  # s


def payload(m2, begin=CHANGED):
    """Return parameters of a plant whose tip mass becomes `m2` [kg]."""
    return {'events.begin': [begin], 'events.payload': [m2 - 0.5]}


def push(joint, torque, seconds, begin=CHANGED):
    """Return parameters of a plant with a torque [N m] on a joint for some seconds."""
    torques = [0.0, 0.0]
    torques[joint] = torque
    return {
        'events.begin': [begin],
        'events.duration': [seconds],
        'events.torque': torques,
    }


def several(*events):
    """Return parameters of a plant with all of these events, named without `events.`."""
    names = {name for event in events for name in event}
    return {
        f'events.{name}': [
            value
            for event in events
            for value in np.ravel(
                event.get(name, [0.0, 0.0] if name == 'torque' else 0.0)
            ).tolist()
        ]
        for name in sorted(names)
    }


ROWS = {
    **{f'payload to {m2} kg': payload(m2) for m2 in (0.6, 0.65, 0.7, 0.75, 0.8, 1.0)},
    'payload to 0.75 kg at 8 s': payload(0.75, begin=8.0),
    **{
        f'release from {m2} kg': several(
            {'begin': 10.0, 'duration': 10.0, 'payload': m2 - 0.5}
        )
        for m2 in (0.75, 1.0)
    },
    **{
        f'push {row}': push(*row)
        for row in [(1, 1.0, 3.0), (1, 2.0, 2.0), (0, 3.0, 3.0)]
    },
    **{
        f'payload to 0.75 kg within {ramp} s': payload(0.75) | {'events.ramp': [ramp]}
        for ramp in (0.5, 2.0)
    },
    'five payloads of 5 s': several(
        *({'begin': 10.0 * k, 'duration': 5.0, 'payload': 0.25} for k in range(1, 6))
    ),
    'payload, then pushes': several(
        {'begin': CHANGED, 'payload': 0.3},
        {'begin': CHANGED + 5.0, 'duration': 2.0, 'torque': [2.0, 0.0]},
        {'begin': CHANGED + 9.0, 'duration': 2.0, 'torque': [0.0, -1.0]},
    ),
}
"""Changes by name; a run ends at `end_of`, two windows after the last change."""


def end_of(row):
    """Return the time two windows after the last change of a row [s], in whole samples."""
    times = (
        np.array(row.get(f'events.{name}', 0.0))
        for name in ('begin', 'duration', 'ramp')
    )
    return round(float(np.max(sum(times))) + 2.0 * WINDOW, 3)


def run_preset(duration, plant=None, *, preset='recommended', law=None):
    """Run a preset with changed parameters of the plant, events among them, and of the law."""
    return run(configured(preset, duration, law, plant))
