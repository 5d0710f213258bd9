# SPDX-License-Identifier: Apache-2.0
"""Common cases of the law's tests: Section IV in a sampled loop, and random ones of any size."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import plants
from plain_law import R, dynamics
from symbols import replaced

from blf_dsc_controller import ControllerConfig
from blf_dsc_controller.configuration.law_file import load_law
from blf_dsc_controller.configuration.law_traits import gains_of
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.law import barrier
from blf_dsc_controller.law.blf_dsc import BlfDsc
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.state import (
    Settings,
)
from blf_dsc_controller.reference import terms as reference

REFERENCE = reference.pack(
    2, [reference.sinusoids_term((1.9935, 1.3961), (0.3, 0.3), (1.0,), (0.0,))]
)
JOINTS = ('shoulder', 'elbow')
P = np.array([1.0, 0.32, 0.4])


def recommended(
    *, bias: bool = True, frequencies: Sequence[float] = (), **changes: Any
) -> Settings:
    """Return the settings of the default configuration with changes (`symbols`), and their knee.

    Change detection is off, since the paper has none: test_law_consistency.py covers
    it.
    """
    columns: dict[str, Any] = {'two_link.bias': bias}
    if frequencies:
        columns['two_link.frequencies'] = list(frequencies)
    config = build(ControllerConfig, columns)
    settings = replaced(settings_of_config(config), **{'change_detection': 0} | changes)
    of = settings.barrier
    barriers = zip(of.bound, of.weight, of.slope_limit, strict=True)
    return replaced(settings, knee=np.array([barrier.knee(*each) for each in barriers]))


def quick(**changes: Any) -> Settings:
    """Return settings that learn within seconds: a window of 1 s, which is less excited."""
    return recommended(
        **{'window': 1000, 'learning_start': 1.2, 'sigma': 1e-6} | changes
    )


def controller(settings: Settings) -> Controller:
    """Return a controller that tracks the paper's reference."""
    return Controller(BlfDsc(), settings, REFERENCE)


def as_printed(settings: Settings, **gains: float) -> Controller:
    """Return the same with the law file `paper`, with the filter (8) in its memory."""
    law = load_law('paper')
    given = dataclasses.asdict(gains_of('paper')()) | gains
    return Controller(law(**given), settings._replace(memory=4), REFERENCE)


def energies(law: Controller, t: float) -> np.ndarray:
    """Return the terms (4,) of (29) [J] of the last sample, with 0.1 + 0.1 sin t N m."""
    settings, sample, s = law.settings, law.sample, law.signals
    barriers = (
        barrier.joint_potential(
            settings.barrier, s.barrier, sample.xi1[i], sample.bound[i], i
        )
        for i in range(2)
    )
    M, _, _ = dynamics(P, R, s.q, s.dq)
    tau_dist = 0.1 + 0.1 * np.sin(t)
    return np.array(
        [
            sum(barriers),
            0.5 * sample.xi2 @ M @ sample.xi2,
            weighted(P - sample.estimate[:3], settings.adaptation.adaptation_gain[:3]),
            weighted(tau_dist - sample.disturbance, settings.disturbance.gain),
        ]
    )


def weighted(error: np.ndarray, gain: np.ndarray) -> float:
    """Half the sum of squares over the gains, of what is adapted."""
    return float(0.5 * np.sum(error[gain > 0.0] ** 2 / gain[gain > 0.0]))


def plant(**changes: Any) -> Any:
    """Return Section IV's arm at its start, with disturbance 0.1 + 0.1 sin t on each joint."""
    return plants.plant(**{'constant': (0.1, 0.1), 'amplitude': (0.1, 0.1)} | changes)


class Sample(NamedTuple):
    """One sample of a loop, whose torque is computed but not yet applied to the plant."""

    k: int
    t: float  # s
    measurement: np.ndarray  # (6,) view


def closed_loop(law: Controller, arm: Any, duration: float) -> Iterator[Sample]:
    """Run the loop for `duration` [s], yielding each sample so that the test can inspect it."""
    dt = arm.period_ns * 1e-9
    for k in range(round(duration / dt)):
        t = k * arm.period_ns * 1e-9
        measurement = arm.measure()
        law.update(t, dt, measurement)
        yield Sample(k, t, measurement)
        arm.step(law.signals.torque)
