# SPDX-License-Identifier: Apache-2.0
"""Margins of the default gains of arms from a URDF, and their errors at a pick-up.

    python -m benchmark margins

Margins are of the linear loop near the reference, of all joints together, in the worst
of some postures: how many times lighter or heavier the arm may be than M0, and how much
later torques may come.  Near the bound the same holds where the barrier is steepest.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from benchmark.harness import print_table
from blf_dsc_controller.arms.model import inertia_matrices
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import load, load_loop, locate
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.supervision.expected_errors import (
    expected_errors,
    linear_feedback,
    linear_loop,
)

ARMS = {'Panda': 'panda_rigid', 'UR5e': 'ur5e_rigid', 'FR3': 'fr3'}
SAMPLE_TIMES = {'1 kHz': 0.001, '500 Hz': 0.002, '250 Hz': 0.004}
POSTURES = 8
WEIGHT = 2.0  # kg, picked up
MOMENTS = np.arange(8.0, 13.0, 0.5)  # s, at which it is
WIDE = 0.05  # rad, a bound that is far away

HEADS = [
    'arm',
    'rate',
    'omega_b',
    'lighter',
    'heavier',
    'later',
    'lighter and later, barrier at its steepest',
    f'{WEIGHT:g} kg, linear',
    'simulated',
]

FACTORS = np.arange(1.0, 9.0, 0.01)
DELAYS = np.arange(0.0, 0.04, 1e-4)  # s


def controller_of(
    preset: str, T: float, payload: float | None = None
) -> ControllerConfig:
    """Return the configuration of the controller at a sample time T [s]."""
    given = {'sample_time': T}
    if payload is not None:
        given['robot.payload'] = payload
    return load(locate(preset), 'blf_dsc_controller', ControllerConfig, given)


class Loop:
    """The linear loop of all joints near the reference, in several postures."""

    def __init__(self, config: ControllerConfig, T: float) -> None:
        self.settings = settings_of_config(config)
        self.T = T
        self.lag = config.robot.lag
        limits = config.limits.position_lower, config.limits.position_upper
        shape = POSTURES, len(config.joints)
        q = np.random.default_rng(1).uniform(*limits, shape)
        P0 = np.array(config.learning.initial_estimate)
        self.M0 = inertia_matrices(self.settings.model, P0, q)

    def is_stable(
        self, stiffness: np.ndarray, inertia: float = 1.0, later: float = 0.0
    ) -> bool:
        """Return whether errors decay with M = inertia M0 and torques `later` [s] than known."""
        feedback = linear_feedback(self.settings, self.M0, stiffness)
        M = inertia * self.M0
        return linear_loop(
            self.settings, self.T, self.lag + later, M, feedback
        ).is_stable()

    def lighter(self, stiffness: np.ndarray) -> float:
        """Return how many times lighter than M0 the arm may be."""
        return last(FACTORS, lambda x: self.is_stable(stiffness, inertia=1.0 / x))

    def heavier(self, stiffness: np.ndarray) -> float:
        """Return how many times heavier than M0 the arm may be."""
        return last(FACTORS, lambda x: self.is_stable(stiffness, inertia=x))

    def later(self, stiffness: np.ndarray) -> float:
        """Return how much later [s] torques may come than the gains assume."""
        return last(DELAYS, lambda x: self.is_stable(stiffness, later=x))


def last(values: Iterable[float], holds: Callable[[float], bool]) -> float:
    """Return the last of the values before the first for which it does not hold."""
    found = float('nan')
    for value in values:
        if not holds(value):
            break
        found = value
    return found


def expected_pick_up(preset: str, T: float) -> float:
    """Return the largest error [rad] of the linear loop, worst along the motion of the preset."""
    config = controller_of(preset, T, WEIGHT)
    return float(expected_errors(config, settings_of_config(config)).pick_up.max())


def simulated_pick_up(preset: str, T: float) -> float:
    """Return the largest error [rad] of the simulated arm, with all imperfections."""
    n = len(controller_of(preset, T).joints)
    controller = {'sample_time': T, 'barrier.bound': [WIDE] * n}
    largest = 0.0
    for moment in MOMENTS.tolist():
        plant = {
            'sample_time': T,
            'duration': moment + 0.5,
            'events.begin': [moment],
            'events.duration': [1.0],
            'events.payload': [WEIGHT],
            'truth.rotor_factor': 1.0,
        }
        given = {'blf_dsc_controller': controller, 'sim_plant': plant}
        loop = load_loop(preset, given)
        run = simulate(loop.controller, loop.plant).run()
        error = np.abs(np.asarray(run.error)[run.time >= moment])
        largest = max(largest, float(error.max()))
    return largest


def row(preset: str, T: float) -> list[str]:
    """Return the cells of an arm at a sample time."""
    config = controller_of(preset, T)
    loop = Loop(config, T)
    soft, steep = loop.settings.barrier.weight, loop.settings.barrier.slope_limit
    rate = config.feedback.damping_rate / 0.6  # as in arms/tuning.py
    return [
        f'{rate:.0f} 1/s',
        f'{loop.lighter(soft):.2f}',
        f'{loop.heavier(soft):.1f}',
        f'{1e3 * loop.later(soft):.1f} ms',
        f'{loop.lighter(steep):.2f}, {1e3 * loop.later(steep):.1f} ms',
        f'{1e3 * expected_pick_up(preset, T):.1f} mrad',
        f'{1e3 * simulated_pick_up(preset, T):.1f} mrad',
    ]


def table() -> Iterator[list[str]]:
    """Compute the rows, one for each arm and sample rate."""
    for name, preset in ARMS.items():
        for label, T in SAMPLE_TIMES.items():
            yield [name, label, *row(preset, T)]


def main(_options: argparse.Namespace) -> None:
    """Print the table."""
    print_table(HEADS, table())
