# SPDX-License-Identifier: Apache-2.0
"""The random arms of `random-arms`, so many of them that what is rare is seen.

    python -m benchmark many-arms [N] [--robots NAME...] [--draws DRAW...] [--keep FILE]

Only this law runs on all of them.  The gains that the maker publishes run where it does not
hold: an arm that they hold on is plausible, and counts as a failure.  The errors are those of
the arms that hold: the median, the 99th percentile, and the worst.

It goes round the robots and draws arm by arm.  After an interrupt, `--keep` goes on from the
arms that its file has, and `many-arms 0` prints the tables of what is there.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmark.harness import print_table
from benchmark.random_arms import (
    DRAWS,
    HEADS,
    ROBOTS,
    STOCK,
    THIS,
    Kept,
    Key,
    Result,
    failures,
    stops,
    study_of,
)


def make(runs: int, robots: Sequence[str], draws: Sequence[str], kept: Kept) -> None:
    """Run this law on the arms, and the published gains where it does not hold."""
    studies = {both: study_of(*both) for both in itertools.product(robots, draws)}
    for number, (both, study) in itertools.product(range(runs), studies.items()):
        key = Key(*both, number, THIS)
        if not kept.of(key, study).holds:
            kept.of(key._replace(law=STOCK), study)


def rows(kept: Kept) -> Iterator[list[str]]:
    """Compute the rows: what becomes of the arms of each robot and draw."""
    for both in _groups(kept):
        own = _own(kept, *both)
        yield [*both, *_counts(list(own), kept), *_errors(list(own.values()))]


def _counts(keys: Sequence[Key], kept: Kept) -> list[str]:
    """Return how many arms there are, hold, shake, stop, break a bound, and fail."""
    found = [kept.results[key] for key in keys]
    stop = [not np.isnan(each.stopped) for each in found]
    shake = [
        each.oscillates and not ends for each, ends in zip(found, stop, strict=True)
    ]
    broken = [each.holds and each.ratio >= 1.0 for each in found]
    failed = [
        not kept.results[key].holds and kept.results[key._replace(law=STOCK)].holds
        for key in keys
    ]
    hold = [each.holds for each in found]
    return [
        f'{len(found)}',
        *(f'{sum(e)}' for e in (hold, shake, stop, broken, failed)),
    ]


def _errors(found: Sequence[Result]) -> list[str]:
    """Return the errors of the arms that hold."""
    holding = [(e.motion, e.pick_up, e.settled) for e in found if e.holds]
    if not holding:
        return ['-'] * 3
    values = 1e3 * np.quantile(holding, (0.5, 0.99, 1.0), axis=0).T
    return [' / '.join(f'{value:.2g}' for value in each) for each in values]


def _groups(kept: Kept) -> list[tuple[str, str]]:
    """Return the robots and draws of the runs of this law."""
    return sorted({(key.robot, key.draw) for key in kept.results if key.law == THIS})


def _own(kept: Kept, robot: str, draw: str) -> dict[Key, Result]:
    """Return the results of this law on the arms of a robot and draw."""
    return {
        key: result
        for key, result in kept.results.items()
        if key[:2] == (robot, draw) and key.law == THIS
    }


HEAD = (
    'robot',
    'draw',
    'arms',
    'hold',
    'shake',
    'stop',
    'hold, beyond the bound',
    'not held, plausible',
    *(f'{each} [mrad]' for each in ('motion', 'pick-up', 'settled')),
)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument('runs', type=int, nargs='?', default=1000, help='arms of each')
    parser.add_argument('--robots', nargs='+', choices=ROBOTS, default=list(ROBOTS))
    parser.add_argument('--draws', nargs='+', choices=DRAWS, default=['study'])
    parser.add_argument('--keep', type=Path, help='file of the runs that are made')


def main(given: argparse.Namespace) -> None:
    """Print the tables."""
    kept = Kept(given.keep)
    make(given.runs, given.robots, given.draws, kept)
    print_table(HEAD, rows(kept))
    for name, table in (('stops', stops), ('failures', failures)):
        print()
        print_table(HEADS[name], table(kept))
