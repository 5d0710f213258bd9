# SPDX-License-Identifier: Apache-2.0
"""The load observer's pole by commissioning: random elastic arms with it, and with one for all.

    python -m benchmark chosen-poles [ARMS] [--keep FILE]

The arms of `monte_carlo_elastic_panda` and `_fr3` are commissioned, as by `commissioning`.  With
the gains that follow each runs for 30 s, and picks up its load at 8 s, with each pole: that
for all arms, and the one that its commissioning chose.

    L               chosen: the least, the median, the largest [rad/s]
    motion          largest error from 3 s on until the pick-up [mrad]: the median, the worst
    pick-up         likewise within 4 s of it
    later           likewise after these
    slower          arms in which the observer became slower in a joint, since that shook
    softened        arms whose feedback was softened
    stop            arms that stopped

`--keep` appends each run to a file, from which the same command goes on.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator, Sequence
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmark.commissioning import (
    BEGIN,
    LOADED,
    PICK_UP,
    commissioning_of,
    without_bound,
)
from benchmark.harness import print_table
from benchmark.kept import Results
from benchmark.options import positive
from blf_dsc_controller.commissioning.commissioned import Commissioned
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.messages.journal import EventType
from blf_dsc_controller.simulation.loop import simulate

ROBOTS = 'panda', 'fr3'
CHOSEN = 'chosen'
POLES = '60', '150', CHOSEN
DURATION = 30.0  # s
HEADS = (
    *('arm', 'L [rad/s]', 'arms', 'motion [mrad]', 'pick-up', 'later'),
    *('slower', 'softened', 'stop'),
)


class Outcome(NamedTuple):
    """What becomes of an arm with a pole of its observer."""

    pole: float  # rad/s
    motion: float  # rad
    pick_up: float  # rad
    later: float  # rad
    slower: bool
    softened: bool
    stops: bool


@cache
def commissioned(robot: str, number: int) -> tuple[Commissioned, PlantConfig]:
    """Return an arm with its gains."""
    return commissioning_of(f'monte_carlo_elastic_{robot}', number)


def outcome(robot: str, number: int, pole: str) -> Outcome:
    """Run an arm with a pole."""
    found, plant = commissioned(robot, number)
    config = without_bound(found.config)
    if pole != CHOSEN:
        config = change(config, {'disturbance.observer_bandwidth': float(pole)})
    with np.errstate(all='ignore'):
        record = simulate(config, change(plant, {'duration': DURATION}))
    run = record.run()
    largest = np.abs(np.asarray(run.error)).max(axis=1)
    ends = (BEGIN, PICK_UP, PICK_UP + LOADED, np.inf)
    motion, pick_up, later = (
        float(largest[(run.time >= begin) & (run.time < end)].max(initial=0.0))
        for begin, end in itertools.pairwise(ends)
    )
    types = {event.type for event in record.journal.pending}
    return Outcome(
        config.disturbance.observer_bandwidth,
        motion,
        pick_up,
        later,
        EventType.TORQUE_SENSORS in types,
        EventType.OSCILLATION in types,
        bool(run.stops),
    )


_Key = tuple[str, str, int]  # robot, pole and number


def outcomes(count: int, path: Path | None) -> dict[_Key, Outcome]:
    """Return the runs that a file has, and those that are missing, which it gets."""
    kept: Results[_Key, Outcome] = Results(
        path, lambda key: (key[0], key[1], key[2]), lambda values: Outcome(*values)
    )
    for number, robot, pole in itertools.product(range(count), ROBOTS, POLES):
        kept.get((robot, pole, number), partial(outcome, robot, number, pole))
    return kept.results


def row(robot: str, pole: str, found: Sequence[Outcome]) -> list[str]:
    """Return the cells of the arms of a robot with a pole."""
    poles, *errors = np.array([each[:4] for each in found]).T
    named = pole
    if pole == CHOSEN:
        named = f'chosen: {poles.min():g}, {np.median(poles):g}, {poles.max():g}'
    return [
        robot,
        named,
        f'{len(found)}',
        *(f'{1e3 * np.median(each):.2g}, {1e3 * each.max():.2g}' for each in errors),
        *(f'{sum(of)}' for of in list(zip(*found, strict=True))[4:]),
    ]


def rows(found: dict[_Key, Outcome]) -> Iterator[list[str]]:
    """Yield a row for each robot and pole."""
    for robot, pole in itertools.product(ROBOTS, POLES):
        of = [each for key, each in found.items() if key[:2] == (robot, pole)]
        if of:
            yield row(robot, pole, of)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument('arms', type=positive, nargs='?', default=40, help='of each')
    parser.add_argument('--keep', type=Path, help='file of the runs that are made')


def main(given: argparse.Namespace) -> None:
    """Print the table."""
    print_table(list(HEADS), rows(outcomes(given.arms, given.keep)))
