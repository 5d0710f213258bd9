# SPDX-License-Identifier: Apache-2.0
"""The arms of `soft-arms`, each commissioned before it moves, against the same goals.

    python -m benchmark measured-arms [--truths N] [--arms NAME...]

Each of the N true arms is measured with its own friction, gears and motors, which commissioning
does not know: in three postures, in one with its rated payload, and by the slow motion that shows
torque ripple.  It moves with the gains that leave a modulus margin of 0.5.  Columns are those of
`soft-arms`, and the laws

    this law           with the torque ripple that was found
    without ripple     with the same gains, but no list of it
    without learning   a PID over the URDF's model along the reference, with the same gains, and the
                       load observer where the arm has sensors
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor

from benchmark.harness import print_table
from benchmark.load_observer import without_learning
from benchmark.options import positive
from benchmark.random_arms import THIS
from benchmark.soft_arms import (
    ALL,
    HEADS,
    NO_LEARNING,
    Figures,
    drawn,
    gains_of,
    goal_row,
    loop_with,
    outcome,
    rows_of,
)
from blf_dsc_controller.arms.known_gears import MARGIN
from blf_dsc_controller.commissioning import simulated
from blf_dsc_controller.commissioning.commissioned import Commissioned, commissioned
from blf_dsc_controller.commissioning.commissioning import Commissioning
from blf_dsc_controller.commissioning.ripple import ripples_in
from blf_dsc_controller.configuration.nodes import LoopConfig
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.studies.runs import cores

ARMS = ('ur5e', 'ur5e_motor', 'ur5e_soft', 'panda', 'panda_no_loop', 'fr3')
NO_RIPPLE = 'without ripple'
LAWS = (THIS, NO_RIPPLE, NO_LEARNING)


def commissioned_arm(name: str, number: int) -> tuple[Commissioned, LoopConfig]:
    """Return what is found of a true arm, without its ripple, and its loop."""
    arm = ALL[name]
    true = arm._replace(plant={**arm.plant, **drawn(arm, number)})
    loop = loop_with(true, gains_of(name), truth=number)
    runs = [run for _, run in simulated.runs_of(Commissioning(loop.controller), loop)]
    measured = [run for run in runs if not isinstance(run, BlfDscError)]
    return commissioned(loop.controller, measured, MARGIN), loop


def figures_of(name: str, number: int) -> dict[str, Figures]:
    """Return what becomes of a true arm with each law."""
    found, loop = commissioned_arm(name, number)
    slow = simulated.slow_run(found.slow_motion, loop.plant)
    learning = found._replace(ripples=ripples_in([slow])).config
    controllers = {
        THIS: learning,
        NO_RIPPLE: found.config,
        NO_LEARNING: without_learning(learning),
    }
    return {
        law: outcome(each, loop.plant, weighs=law == THIS)
        for law, each in controllers.items()
    }


def rows(names: list[str], truths: int) -> Iterator[list[str]]:
    """Compute the rows of each arm."""
    with ProcessPoolExecutor(cores()) as pool:
        for name in names:
            numbers = range(1, truths + 1)
            found = list(pool.map(figures_of, itertools.repeat(name), numbers))
            others = [each[NO_LEARNING] for each in found]
            yield goal_row(name)
            for law in LAWS:
                yield from rows_of(name, law, [each[law] for each in found], others)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    about = 'arms of each kind (5)'
    parser.add_argument('--truths', type=positive, default=5, help=about)
    parser.add_argument('--arms', nargs='+', choices=ARMS, default=list(ARMS))


def main(options: argparse.Namespace) -> None:
    """Print the table."""
    print_table(HEADS, rows(options.arms, options.truths))
