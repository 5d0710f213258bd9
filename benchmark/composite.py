# SPDX-License-Identifier: Apache-2.0
"""Composite learning as published for a Panda, and this law, in a soft loop.

    python -m benchmark composite

The law of config/composite_panda.yaml (Shi and Pan) learns for 40 s in a stiff loop.
Within 10 s the loop then becomes soft (K_c to 0.05, Lambda to 0.3 of it), and another
motion begins, over which the error is measured for 20 s.  The proposed law runs on the
same arms with the same motions and noise; its stiffness is that of the published gains
in the geometric mean over the joints.  Learning continues in both.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import chain, product
from typing import NamedTuple

import numpy as np

from benchmark.harness import print_table
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.law_file import GROUP
from blf_dsc_controller.configuration.law_gains import SlotineLi
from blf_dsc_controller.configuration.nodes import CONTROLLER, LoopConfig, load_loop
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.factory.controller import begin, controller_of
from blf_dsc_controller.studies.laws import inertia_of_joints, linear_gains
from blf_dsc_controller.studies.monte_carlo import another_motion
from blf_dsc_controller.studies.runs import cores
from blf_dsc_controller.supervision.retuning import apply_bumpless
from sim_plant.plant import plant_of

PRESET = 'composite_panda'
LEARNS = 40.0  # s, in the stiff loop
SOFTENS = 10.0  # s
SETTLES = 10.0  # s of the other motion, until errors are counted
COUNTED = 20.0  # s
STEPS = 20  # in which the loop is softened
SOFT_KC, SOFT_LAMBDA = 0.05, 0.3  # of the stiff gains
ARMS = 5
_DIVERGED = 3.0  # rad

CASES = {
    'as panda.yaml': (0.3, 0.01, 2.0),
    'model identified before': (0.03, 0.001, 0.2),
}
"""Deviation of masses, of centres of mass [m], and payload [kg]."""
PUBLISHED = {False: (60.4, 57.2, 36.9), True: (79.6, 29.8, 15.3)}
"""With payload or not: no learning, an earlier method, theirs [mrad], on a real arm."""


class Law(NamedTuple):
    """A law of the comparison."""

    label: str
    changes: Mapping[str, object]
    proposed: bool = False


_NONE = {'learning.weight': 0.0, 'learning.adaptation_gain': [0.0] * 48}
_NEWTON = {
    'gains.update': 'newton',
    'learning.adaptation_gain': [0.5] * 48,
    'gains.learning_weight': 100.0,
}
LAWS = (
    Law('Slotine-Li, no learning', _NONE | {'gains.learning_weight': 0.0}),
    Law('Slotine-Li, composite, the preset', {}),
    Law('the same, with the Newton step of the proposed', _NEWTON),
    Law('proposed, no learning', _NONE, proposed=True),
    Law('proposed', {}, proposed=True),
)
_WITHOUT = {law.proposed: k for k, law in enumerate(LAWS) if 'no learning' in law.label}


def surface_gain(config: ControllerConfig) -> tuple[float, ...]:
    """Return Lambda of the law of Slotine and Li [1/s]."""
    gains: SlotineLi = getattr(config, GROUP)
    return gains.surface_gain


def stiffness(config: ControllerConfig) -> float:
    """Return K_c Lambda in N m/rad, its geometric mean over the joints."""
    each = np.multiply(config.feedback.gain, surface_gain(config))
    return float(np.exp(np.log(each).mean()))


def softened(config: ControllerConfig, share: float) -> ControllerConfig:
    """Return published gains that are `share` (0 to 1) of the way to the soft ones."""
    Kc = 1.0 - share * (1.0 - SOFT_KC)
    Lambda = 1.0 - share * (1.0 - SOFT_LAMBDA)
    return change(
        config,
        {
            'feedback.gain': [Kc * each for each in config.feedback.gain],
            'gains.surface_gain': [Lambda * each for each in surface_gain(config)],
        },
    )


def of_equal_stiffness(
    published: ControllerConfig, changes: Mapping[str, object], wanted: float
) -> ControllerConfig:
    """Return the proposed law, its linear stiffness k_p m that of `wanted` [N m/rad].

    `feedback.stiffness` scales all its rates, so k_p grows with the square.
    """
    reference = published.reference

    def at(part: float) -> ControllerConfig:
        given = {
            'feedback.stiffness': part,
            'reference.offset': list(reference.offset),
            'reference.amplitude': list(reference.amplitude),
            'reference.phase': list(reference.phase),
            'learning.window': published.learning.window,
            'barrier.bound': [0.002 / part**2] * len(published.joints),
            'barrier.initial_bound': [0.0] * len(published.joints),
        }
        return load_loop('panda_rigid', {CONTROLLER: given}).controller

    config = at(1.0)
    full = linear_gains(config)[0] * inertia_of_joints(config)
    part = float(np.sqrt(wanted / np.exp(np.log(full).mean())))
    return change(at(part), changes)


def loop_of(case: str, seed: int, *, loaded: bool) -> LoopConfig:
    """Return the published law on the arm of a seed."""
    masses, centres, payload = CASES[case]
    loop = load_loop(PRESET)
    plant: dict[str, object] = {
        'seed': seed,
        'truth.seed': loop.plant.truth.seed + seed,
        'truth.mass_deviation': masses,
        'truth.centre_deviation': centres,
    }
    if loaded:
        plant |= {
            'events.begin': [0.0],
            'events.duration': [0.0],
            'events.payload': [payload],
        }
    return loop._replace(
        controller=another_motion(loop.controller, seed),
        plant=change(loop.plant, plant),
    )


def soft_error(key: tuple[int, bool, int], case: str) -> float:
    """Return the rms of the error's norm [rad] in the soft phase; inf if it diverges."""
    law = LAWS[key[0]]
    loop = loop_of(case, key[2], loaded=key[1])
    other = another_motion(loop.controller, 100 + key[2])

    def config_at(share: float, motion: ControllerConfig) -> ControllerConfig:
        gains = softened(motion, share)
        if law.proposed:
            return of_equal_stiffness(motion, law.changes, stiffness(gains))
        return change(gains, law.changes)

    config = config_at(0.0, loop.controller)
    controller = controller_of(config)
    plant = plant_of(loop.plant)
    T = config.sample_time
    begin(controller, config, *plant.measure().reshape(3, -1)[:2])
    softening = {
        round((LEARNS + SOFTENS * k / STEPS) / T): k / STEPS
        for k in range(1, STEPS + 1)
    }
    turn = round((LEARNS + SOFTENS) / T) + 1
    first = turn + round(SETTLES / T)
    squares = []
    for k in range(first + round(COUNTED / T)):
        measurement = plant.measure().copy()
        q, dq, _ = measurement.reshape(3, -1)
        if k in softening:
            new = config_at(softening[k], loop.controller)
            apply_bumpless(controller, new, k * T, measurement)
        if k == turn:
            begin(controller, config_at(1.0, other), q, dq, k * T)
        torque = controller.update(k * T, T, measurement)
        e = plant.truth()[-2 * q.size : -q.size] - controller.sample.qr
        if not np.abs(e).max() < _DIVERGED:
            return float('inf')
        if k >= first:
            squares.append(e @ e)
        plant.step(torque)
    return float(np.sqrt(np.mean(squares)))


Errors = dict[tuple[int, bool], np.ndarray]
"""Rms [mrad] of each arm, by law and whether it is loaded."""


def compare(case: str) -> Errors:
    """Run every law on every arm, with and without the payload."""
    pairs = list(product(range(len(LAWS)), (False, True)))
    keys = [(law, loaded, seed) for law, loaded in pairs for seed in range(1, ARMS + 1)]
    soft_error(keys[0], case)  # compiles what the workers load
    with ProcessPoolExecutor(cores()) as pool:
        found = np.array(list(pool.map(partial(soft_error, case=case), keys)))
    return dict(zip(pairs, 1e3 * found.reshape(len(pairs), -1), strict=True))


def rows_of(case: str, errors: Errors) -> list[list[str]]:
    """Return median and range of each law, and the ratio to its own law without learning."""
    found = []
    for law, loaded in errors:
        of_law = errors[law, loaded]
        ratio = of_law / errors[_WITHOUT[LAWS[law].proposed], loaded]  # arm by arm
        first = errors[0, loaded]
        found.append(
            [
                case,
                f'{CASES[case][2]:g} kg' if loaded else 'none',
                LAWS[law].label,
                f'{np.median(of_law):.1f} ({of_law.min():.1f} to {of_law.max():.1f})',
                f'{np.median(ratio):.2f} ({ratio.min():.2f} to {ratio.max():.2f})',
                f'{np.median(of_law / first):.2f}',
            ]
        )
    return sorted(found, key=lambda row: row[1] != 'none')


def published_rows() -> list[list[str]]:
    """Return the published figures of the real arm."""
    labels = 'no learning', 'an earlier method', 'composite, as published'
    return [
        ['real arm', 'yes' if loaded else 'none', label, f'{value}', f'{part:.2f}', '']
        for loaded, values in PUBLISHED.items()
        for label, value in zip(labels, values, strict=True)
        for part in (value / values[0],)
    ]


def main(_options: argparse.Namespace) -> None:
    """Print the table."""
    heads = ['arm', 'payload', 'law', 'rms [mrad]', 'to no learning', 'to the first']
    studied = (row for case in CASES for row in rows_of(case, compare(case)))
    print_table(heads, chain(studied, published_rows()))
