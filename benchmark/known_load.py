# SPDX-License-Identifier: Apache-2.0
"""What it would be worth to know a load at once, on an arm without joint torque sensors.

    python -m benchmark known-load [--arm ur5e] [--integrals 1 4]

An arm of `soft_arms` picks up 2 kg at 8 s.  A row has this law with a multiple of its integral
gain, which is told the load, exactly, some time after the pick-up: what is learned gets it, and
d^3 returns to what it was before, as if it had not followed.  Largest error of a joint [mrad] from
the pick-up on, from 0.2 s after it on, and from 0.5 s on; and rms of the error's norm [mrad] in
0.5 s, in 1.5 s, and from then to 3.5 s.  `found after` is when the law itself finds that the arm
has changed.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator

import numpy as np

from benchmark import soft_arms
from benchmark.harness import print_table
from benchmark.load_observer import LATER, PICK_UP, WEIGHT
from blf_dsc_controller.configuration.nodes import LoopConfig
from blf_dsc_controller.configuration.robot import parameters_of
from blf_dsc_controller.factory.controller import begin, controller_of
from blf_dsc_controller.law.state import State
from sim_plant.plant import plant_of

DELAYS = (None, 0.3, 0.15, 0.1, 0.05, 0.02)  # s; None: the load is never told
TRUTH = 1


def loop_of(arm: str, integral: float) -> LoopConfig:
    """Return an arm of `soft_arms` with a multiple of the integral gain that follows for it."""
    of, gains = soft_arms.ARMS[arm], soft_arms.gains_of(arm)
    usual = soft_arms.loop_with(of, gains).controller.disturbance.gain
    changed = {**gains, 'disturbance.gain': [integral * each for each in usual]}
    return soft_arms.loop_with(of, changed, truth=TRUTH)


def declare(state: State, load: np.ndarray, disturbance: np.ndarray) -> None:
    """Add the parameters of a load to what is learned, and return d^3 (n,) to `disturbance`."""
    for values in (state.estimate, state.latch.anchor):
        values[: load.size] += load
    state.disturbance[:] = disturbance


def pick_up(loop: LoopConfig, delay: float | None) -> tuple[np.ndarray, float]:
    """Run a pick-up; return errors (k, n) [rad], and when the law found a change [s], both from it.

    The load is declared `delay` [s] after it; None: never.
    """
    config, dt = loop.controller, loop.controller.sample_time
    controller, plant = controller_of(config), plant_of(loop.plant)
    robot, n = config.robot, len(config.joints)
    load = WEIGHT * parameters_of(robot, robot.chain(config.joints)).load
    begin(controller, config, *np.reshape(plant.measure(), (3, n))[:2])
    state, before, found = controller.state, np.zeros(n), np.nan
    picked = round(PICK_UP / dt)
    declared = None if delay is None else picked + round(delay / dt)
    errors = np.zeros((picked + round(LATER / dt), n))
    for k, error in enumerate(errors):
        if k == picked:
            before = state.disturbance.copy()
        if k == declared:
            declare(state, load, before)
        torque = controller.update(k * dt, dt, np.array(plant.measure()))
        error[:] = controller.sample.xi1
        if np.isnan(found) and k > picked and state.change.changes[0] > 0.0:
            found = k * dt - PICK_UP
        controller.perceive(dt)
        plant.step(torque)
    return errors[picked:], found


def rows(arm: str, integrals: list[float]) -> Iterator[list[str]]:
    """Compute the rows: each delay with each integral gain."""
    dt = soft_arms.loop_with(soft_arms.ARMS[arm], {}).controller.sample_time
    for integral, delay in itertools.product(integrals, DELAYS):
        errors, found = pick_up(loop_of(arm, integral), delay)
        errors = 1e3 * errors
        t = dt * np.arange(len(errors))
        norm = np.sqrt((errors**2).sum(axis=1))
        spans = (0.0, 0.5), (0.0, 1.5), (1.5, LATER)
        yield [
            f'{integral:g}',
            'never' if delay is None else f'{delay:g} s',
            f'{found:.2f} s',
            *(f'{np.abs(errors[t >= begin]).max():.1f}' for begin in (0.0, 0.2, 0.5)),
            *(
                f'{np.sqrt((norm[(t >= a) & (t < b)] ** 2).mean()):.1f}'
                for a, b in spans
            ),
        ]


_HEADS = (
    *('integral', 'told after', 'found after', 'pick-up', 'from 0.2 s', 'from 0.5 s'),
    *('rms, 0 to 0.5 s', '0 to 1.5 s', '1.5 to 3.5 s'),
)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument('--arm', choices=soft_arms.ARMS, default='ur5e')
    parser.add_argument('--integrals', nargs='+', type=float, default=[1.0, 4.0])


def main(given: argparse.Namespace) -> None:
    """Print the table."""
    print_table(_HEADS, rows(given.arm, given.integrals))
