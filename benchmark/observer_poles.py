# SPDX-License-Identifier: Apache-2.0
"""How fast the load observer may be: random elastic arms that change, with poles of several speeds.

    python -m benchmark observer-poles [N] [--keep FILE]

The first N arms of `monte_carlo_elastic_changes_panda` and `_fr3` run supervised, with learning
and `disturbance.observer_bandwidth` L.  Errors are from 5 s on; the rms is that of their norm.

    rms, worst        over that of the same arm with the L of BEFORE, in the median and the worst
    largest error     of a joint [mrad], in the median, of nine in ten arms, and the worst
    slower            arms in which the observer became slower in a joint, since that shook
    softened          arms whose feedback was softened, since that did not help
    stop              arms that stopped

`--keep` appends each run to a file, from which the same command goes on.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmark.harness import print_table
from benchmark.kept import Results
from benchmark.options import positive
from benchmark.studies import load_study
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.messages.journal import EventType
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.studies.monte_carlo import Study, draw, plant_with

ROBOTS = 'panda', 'fr3'
BEFORE = 60.0  # rad/s
BANDWIDTHS = (0.0, BEFORE, 100.0, 150.0, 200.0, 300.0)  # rad/s
SETTLED = 5.0  # s

HEADS = (
    *('arm', 'L [rad/s]', 'arms', 'rms, worst', 'largest error [mrad]'),
    *('slower', 'softened', 'stop'),
)


class Outcome(NamedTuple):
    """What becomes of an arm."""

    rms: float  # rad, of the norm; NaN: it stops before SETTLED
    largest: float  # rad
    slower: bool
    softened: bool
    stops: bool


def outcome(study: Study, number: int, bandwidth: float) -> Outcome:
    """Run an arm of a study with an observer of that bandwidth [rad/s]."""
    law = change(study.controller, {'disturbance.observer_bandwidth': bandwidth})
    with np.errstate(all='ignore'):
        record = simulate(law, plant_with(study, draw(study, number)))
    run = record.run()
    late = np.asarray(run.error)[np.asarray(run.time) >= SETTLED]
    types = {event.type for event in record.journal.pending}
    return Outcome(
        float(np.sqrt((late**2).sum(axis=1).mean())) if late.size else np.nan,
        float(np.abs(late).max()) if late.size else np.nan,
        EventType.TORQUE_SENSORS in types,
        EventType.OSCILLATION in types,
        bool(run.stops),
    )


_Key = tuple[str, float, int]  # robot, L and number


def outcomes(count: int, path: Path | None) -> dict[_Key, Outcome]:
    """Return the runs that a file has, and those that are missing, which it gets."""
    kept: Results[_Key, Outcome] = Results(
        path, lambda key: (key[0], key[1], key[2]), lambda values: Outcome(*values)
    )
    studies = {
        robot: load_study(f'monte_carlo_elastic_changes_{robot}') for robot in ROBOTS
    }
    for number, robot, L in itertools.product(range(count), ROBOTS, BANDWIDTHS):
        kept.get((robot, L, number), partial(outcome, studies[robot], number, L))
    return kept.results


def row(
    robot: str, bandwidth: float, found: Sequence[Outcome], before: Sequence[Outcome]
) -> list[str]:
    """Return the cells of the arms of a robot, of which `before` are those at BEFORE."""
    ratio = [a.rms / b.rms for a, b in zip(found, before, strict=True)]
    largest = 1e3 * np.array([each.largest for each in found])
    parts = np.nanquantile(largest, (0.5, 0.9, 1.0))
    return [
        robot,
        f'{bandwidth:g}',
        f'{len(found)}',
        f'{np.nanmedian(ratio):.2f}, {np.nanmax(ratio):.2f}',
        ', '.join(f'{each:.1f}' for each in parts),
        *(f'{sum(of)}' for of in list(zip(*found, strict=True))[2:]),
    ]


def rows(found: dict[_Key, Outcome]) -> Iterator[list[str]]:
    """Yield a row for each robot and bandwidth, of the arms that ran with all of them."""
    for robot in ROBOTS:
        numbers = [
            sorted(number for name, of, number in found if (name, of) == (robot, L))
            for L in BANDWIDTHS
        ]
        shared = sorted(set(numbers[0]).intersection(*numbers[1:]))
        of = {L: [found[robot, L, number] for number in shared] for L in BANDWIDTHS}
        for L in BANDWIDTHS if shared else ():
            yield row(robot, L, of[L], of[BEFORE])


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument('arms', type=positive, nargs='?', default=80, help='of each')
    parser.add_argument('--keep', type=Path, help='file of the runs that are made')


def main(given: argparse.Namespace) -> None:
    """Print the table."""
    print_table(list(HEADS), rows(outcomes(given.arms, given.keep)))
