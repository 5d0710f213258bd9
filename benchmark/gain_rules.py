# SPDX-License-Identifier: Apache-2.0
"""Gains that a commissioning measures, and gains by rules that need no measurement.

    python -m benchmark gain-rules [ARMS] [STUDY ...]

The arms and runs are those of `commissioning`, with a bound that only an arm that shakes would
leave.  Each runs for 60 s with the gains of

    commissioned       the measured arm, with a modulus margin of 0.5
    half, a quarter    a bandwidth w of each joint of so much of its first antiresonance sqrt(K / M)
    0.4, 0.2 of least  so much of the least antiresonance of all joints, for all of them
    preset             the configuration that it was measured with

A bandwidth w gives a joint the stiffness J w^2 and the damping 0.8 J w.  The rules know the
true gears K and motors; M and J are the largest inertias of the model over all postures with the
rated payload, without the motors, and with what a torque loop leaves of them.

    held             arms that neither stop nor oscillate
    motion, pick-up  median of the largest errors [mrad] of these
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor

import numpy as np

from benchmark.commissioning import (
    LONG,
    STUDIES,
    drawn_joints,
    largest_errors,
    measured_of,
    without_bound,
)
from benchmark.harness import print_table
from benchmark.studies import load_study
from blf_dsc_controller.arms.joint_gains import damped_arm
from blf_dsc_controller.arms.known_gears import MARGIN
from blf_dsc_controller.commissioning.chosen import as_parameters, with_gains
from blf_dsc_controller.commissioning.commissioned import commissioned
from blf_dsc_controller.configuration.controller import ControllerConfig, design_of
from blf_dsc_controller.studies.runs import cores

RULES = {  # share of the antiresonance, and whether of the least one
    'half': (0.5, False),
    'a quarter': (0.25, False),
    '0.4 of least': (0.4, True),
    '0.2 of least': (0.2, True),
}
ALL = ('commissioned', *RULES, 'preset')


def by_rule(
    config: ControllerConfig, name: str, number: int, rule: str
) -> ControllerConfig:
    """Return a configuration with the gains by a rule that knows gears and motors."""
    joints, _ = drawn_joints(load_study(name), number)
    arm, _ = design_of(config)
    links = arm.over_postures().inertia - arm.rotors
    antiresonance = np.sqrt(np.asarray(joints.stiffness) / links)
    share, of_least = RULES[rule]
    w = share * (antiresonance.min() if of_least else antiresonance)
    loop = joints.torque_loop
    J = links + joints.motors / (1.0 + (loop.gain if loop else 0.0))
    gains = damped_arm(0.8 * J * w, J)
    return with_gains(config, as_parameters(gains.stiffness, gains.damping))


def errors_of(name: str, number: int) -> list[tuple[float, float, float]]:
    """Return the largest errors [mrad] of an arm with the gains of each rule; nan: it stops."""
    config, measured, plant = measured_of(name, number)
    found = commissioned(config, measured, MARGIN)
    configs = (
        found.config,
        *(by_rule(config, name, number, rule) for rule in RULES),
        config,
    )
    return [largest_errors(without_bound(each), plant, LONG) for each in configs]


def rows(names: tuple[str, ...], count: int) -> Iterator[list[str]]:
    """Compute a row for each study and rule."""
    with ProcessPoolExecutor(cores()) as pool:
        for name in names:
            found = np.array(
                list(pool.map(errors_of, itertools.repeat(name), range(count)))
            )
            for rule, errors in zip(ALL, np.moveaxis(found, 1, 0), strict=True):
                held = errors[~np.isnan(errors[:, 0])]
                medians = np.median(held, axis=0)[:2] if len(held) else ()
                motion, pick_up = [f'{each:.2g}' for each in medians] or '--'
                first = name.rpartition('_')[2], rule, f'{len(held)} of {count}'
                yield [*first, motion, pick_up]


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument('words', nargs='*', metavar='WORD', help='see above')


def main(options: argparse.Namespace) -> None:
    """Print a table."""
    many, *given = options.words or ['2']
    names = tuple(given) or STUDIES
    print_table(['arm', 'gains', 'held', 'motion', 'pick-up'], rows(names, int(many)))
