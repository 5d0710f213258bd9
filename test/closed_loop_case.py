# SPDX-License-Identifier: Apache-2.0
"""Common case of the law's tests: Section IV with the recommended gains, in a sampled loop."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import plants
from plants import START

from blf_dsc_controller.arms.two_link import TwoLink
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.law import barrier
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.factory import settings_of_config
from blf_dsc_controller.law.settings import Settings
from blf_dsc_controller.reference import terms as reference
from sim_plant.plant import Plant
from sim_plant.sensors import DIFFERENCED, MEASURED

T = 1e-3
P = np.array([1.0, 0.32, 0.4])
R = 9.8  # 1/s^2, g / l1
MODEL = TwoLink(R)
REFERENCE = reference.pack(
    2, [reference.sinusoids_term((1.9935, 1.3961), (0.3, 0.3), (1.0,), (0.0,))]
)
JOINTS = ('shoulder', 'elbow')
QUIET = (0.0, 0.0)


def recommended(*, bias: bool = True, **changes) -> Settings:
    """Return the settings of the default configuration with changes, and the knee for them.

    Change detection is off, since the paper has none: test_law_consistency.py covers it.
    """
    config = ControllerConfig()
    config = replace(config, learning=replace(config.learning, bias=bias))
    settings = settings_of_config(config)._replace(**{'change_detection': 0} | changes)
    barriers = zip(settings.bound, settings.weight, settings.slope_limit, strict=True)
    return settings._replace(knee=np.array([barrier.knee(*each) for each in barriers]))


def quick(**changes) -> Settings:
    """Return settings that learn within seconds: a window of 1 s, which is less excited."""
    return recommended(**{'window': 1000, 'learning_start': 1.2, 'sigma': 1e-6} | changes)


def controller(settings: Settings) -> Controller:
    """Return a controller that tracks the paper's reference."""
    return Controller(settings, REFERENCE)


def plant(
    *,
    sample_time: float = T,
    noise: float = 0.0,
    differenced: bool = False,
    delay: int = 0,
    torque_limit: tuple[float, float] = QUIET,
    constant: tuple[float, float] = (0.1, 0.1),
    amplitude: tuple[float, float] = (0.1, 0.1),
    viscous: float = 0.0,
    start: tuple[float, float] = START,
    seed: int = 0,
) -> Plant:
    """Return Section IV's arm at its start, with disturbance 0.1 + 0.1 sin t on each joint."""
    return plants.plant(
        period_ns=round(sample_time * 1e9),
        position_noise=noise,
        velocity_source=DIFFERENCED if differenced else MEASURED,
        load=plants.disturbance(constant=constant, amplitude=amplitude, viscous=viscous),
        torque_limit=torque_limit,
        delay=delay,
        start=start,
        seed=seed,
    )


class Sample(NamedTuple):
    """One sample of a loop, whose torque is computed but not yet applied to the plant."""

    k: int
    t: float  # s
    measurement: np.ndarray  # (6,) view


def closed_loop(law: Controller, arm: Plant, duration: float) -> Iterator[Sample]:
    """Run the loop for `duration` [s], yielding each sample so that the test can inspect it."""
    dt = arm.period_ns * 1e-9
    for k in range(round(duration / dt)):
        t = k * arm.period_ns * 1e-9
        measurement = arm.measure()
        law.update(t, dt, measurement)
        yield Sample(k, t, measurement)
        arm.step(law.signals.torque)


class Record(NamedTuple):
    """A whole run; the first axis is the sample."""

    t: np.ndarray  # s
    xi1: np.ndarray  # (., 2) rad
    torque: np.ndarray  # (., 2) N m
    estimate: np.ndarray  # (., m)

    @property
    def parameter_error(self) -> np.ndarray:
        """|P^ - P| / |P| of each sample."""
        return np.linalg.norm(self.estimate[:, :3] - P, axis=1) / np.linalg.norm(P)


def record(law: Controller, arm: Plant, duration: float) -> Record:
    """Run a loop and record what the tests need."""
    signals, state = law.signals, law.state
    rows = [
        (sample.t, signals.xi1.copy(), signals.torque.copy(), state.estimate.copy())
        for sample in closed_loop(law, arm, duration)
    ]
    return Record(*map(np.array, zip(*rows, strict=True)))


@cache
def recommended_minute() -> Record:
    """Return 60 noise-free seconds of the recommended configuration, run once for all tests."""
    return record(controller(recommended()), plant(), 60.0)
