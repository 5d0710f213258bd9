# SPDX-License-Identifier: Apache-2.0
"""Random elastic arms that change, each with and without learning.

    python -m benchmark soft-pairs [N] [--robots NAME...] [--commissioned] [--keep FILE]

The studies are `monte_carlo_elastic_changes_*`: gears, motors, links, delays and tables are drawn
independently of the controller, friction falls with the speed and grows with the load, and four
events change load, friction and what pushes.  Each arm runs supervised, with learning, without
it, and without it with other noise.  The rms is that of the error's norm from 5 s on, with
learning over without, of arms that go to the end both times.  An arm that stops has not kept
its bound.

With `--commissioned`, each arm is measured first, and has the gains that follow.  One that
gets none has not kept its bound.

It goes round the robots arm by arm.  After an interrupt, `--keep` goes on from the arms that
its file has, and `soft-pairs 0` prints the table of what is there.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from math import isinf
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmark.commissioning import runs_of
from benchmark.harness import print_table
from benchmark.kept import Results
from benchmark.studies import load_study
from blf_dsc_controller.commissioning.commissioned import commissioned
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.studies.monte_carlo import Study, draw, plant_with
from blf_dsc_controller.studies.runs import KEPT, VIOLATED, figures_of

ROBOTS = 'panda', 'ur5e', 'fr3'
ALLOWED = 1.1  # rms with learning over without
STOPPED = 'stopped'


class Pair(NamedTuple):
    """What becomes of an arm with learning, without it, and with other noise."""

    robot: str
    number: int
    kept: tuple[bool, ...]  # the bound
    ends: tuple[bool, ...]  # with finite numbers
    rms: tuple[float, ...]  # rad, of the norm


def pair_in(value: list[Any]) -> Pair:
    """Return the pair that a file has."""
    robot, number, *figures = value
    return Pair(robot, number, *map(tuple, figures))


def measured(study: Study, number: int) -> Study | None:
    """Return a study with the gains that an arm of it gets; None: it gets none."""
    controller = study.controller
    plant = plant_with(study, draw(study, number))
    try:
        found = commissioned(controller, runs_of(controller, plant))
        return replace(study, controller=found.config)
    except BlfDscError:
        return None


def pair_of(robot: str, study: Study, number: int, *, measures: bool = False) -> Pair:
    """Run an arm of a study in the supervised loop, with each law; perhaps commission it first."""
    drawn = draw(study, number)
    own = measured(study, number) if measures else study
    if own is None:
        return Pair(robot, number, (False,) * 3, (False,) * 3, (np.nan,) * 3)
    outcomes, rms = [], []
    for prefix, config in own.laws().items():
        plant = plant_with(study, drawn, prefix)
        with np.errstate(all='ignore'):
            record = simulate(config, plant)
            found = figures_of(study, record, plant)
        each = [found[f'rms_error_rad.{name}'] for name in study.plant.joints]
        goes_on = isinf(record.stopped)
        outcomes.append(str(found['outcome']) if goes_on else STOPPED)
        rms.append(float(np.linalg.norm(each)))
    return Pair(
        robot,
        number,
        tuple(each == KEPT for each in outcomes),
        tuple(each in (KEPT, VIOLATED) for each in outcomes),
        tuple(rms),
    )


def pairs(
    runs: int, robots: Sequence[str], path: Path | None, *, measures: bool = False
) -> Iterator[Pair]:
    """Yield the arms that a file has, and those that are missing, which it gets."""
    kept: Results[tuple[str, int], Pair] = Results(
        path, lambda key: (key[0], key[1]), pair_in
    )
    yield from kept.results.values()
    studies = {
        name: load_study(f'monte_carlo_elastic_changes_{name}') for name in robots
    }
    known = set(kept.results)
    for number, (name, study) in itertools.product(range(runs), studies.items()):
        if (name, number) not in known:
            run = partial(pair_of, name, study, number, measures=measures)
            yield kept.get((name, number), run)


def row(robot: str, found: Sequence[Pair]) -> list[str]:
    """Return what becomes of the arms of a robot."""
    kept = np.array([each.kept for each in found])
    with_, without, noise = kept.T
    both = [each for each in found if all(each.ends)]
    return [
        robot,
        f'{len(found)}',
        f'{with_.sum()} / {without.sum()}',
        *(
            f'{(a & ~b).sum()} / {(b & ~a).sum()}'
            for a, b in ((without, with_), (without, noise))
        ),
        f'{len(both)}',
        *(ratios(both) if both else ['-'] * 3),
    ]


def ratios(found: Sequence[Pair]) -> list[str]:
    """Return how the rms of some arms with learning, and with other noise, is to that without."""
    rms = np.array([each.rms for each in found])
    ratio, chance = rms[:, 0] / rms[:, 1], rms[:, 2] / rms[:, 1]
    worst = int(ratio.argmax())
    return [
        f'{np.median(ratio):.2f}, {ratio[worst]:.2f} ({found[worst].number})',
        f'{(ratio > 1.0).sum()}, {(ratio > ALLOWED).sum()}',
        f'{chance.max():.2f}',
    ]


HEADS = (
    'robot',
    'arms',
    'bound kept with / without learning',
    'broken only with / only without',
    'broken only with / only without other noise',
    'go to the end',
    'rms with over without: median, largest (arm)',
    'above 1, above 1.1',
    'of other noise: largest',
)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument('runs', type=int, nargs='?', default=1000, help='arms of each')
    parser.add_argument('--robots', nargs='+', choices=ROBOTS, default=list(ROBOTS))
    parser.add_argument(
        '--commissioned', action='store_true', help='measure each arm first'
    )
    parser.add_argument('--keep', type=Path, help='file of the runs that are made')


def main(given: argparse.Namespace) -> None:
    """Print the table."""
    found = list(
        pairs(given.runs, given.robots, given.keep, measures=given.commissioned)
    )
    names = sorted({each.robot for each in found})
    of = {name: [each for each in found if each.robot == name] for name in names}
    print_table(HEADS, (row(*each) for each in of.items()))
