# SPDX-License-Identifier: Apache-2.0
"""Loads weighed while gears lose a share of the torque they carry, or get warm.

    python -m benchmark load-friction [--runs 6] [--arms ur5e panda ...] [--each]

Arms are those of `nothing_changes`, with links, friction and Stribeck friction of their own.  They
follow the motion of the preset, trapezoids, or pick and place, and pick up a load half-way.  Each
draw is run with each kind of friction:

    as assumed     viscous, Coulomb and Stribeck friction, which do not change
    lose 8, 15 %   more Coulomb friction, by a share of the torque in the gear
    falls, 40 %    viscous and Coulomb friction fall by 40 %, with a time constant of 10 s
    both           gears lose 12 %, and friction falls by 30 %

Outside are the readings whose 95 % interval does not hold the truth, of all that come each tenth
of a second; worst is the largest error over half of the interval.  *Certain* are those that
`load.tell_drive` declares.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from benchmark.harness import print_table
from benchmark.nothing_changes import (
    HELD,
    INTERVAL,
    PICK_UP,
    TIME,
    WEIGHED,
    Found,
    certain,
    found,
    loop_of,
    outside,
    recorded,
    share,
)
from benchmark.options import add_arms
from blf_dsc_controller.run import Floats

ARMS = ('ur5e', 'panda', 'fr3', 'ur5e_driver', 'ur5e_rigid', 'panda_rigid')
FEW = ARMS[:2]
MOTIONS = ('preset', 'trapezoids', 'pick')
LOADS = (2.0, 1.0, 3.0)  # kg
KINDS: dict[str, dict[str, float]] = {
    'as assumed': {},
    'lose 8 %': {'load_share': 0.08},
    'lose 15 %': {'load_share': 0.15},
    'falls, 40 %': {'warm_factor': 0.6, 'warm_time': 10.0},
    'both': {'load_share': 0.12, 'warm_factor': 0.7, 'warm_time': 10.0},
}


class Weighed(NamedTuple):
    """An arm with a motion, a load [kg] and a kind of friction, and what its run says."""

    arm: str
    motion: str
    seed: int
    load: float
    kind: str
    run: Found


def draws(arms: Sequence[str], runs: int) -> Iterator[Weighed]:
    """Yield so many draws with each kind of friction, arms and motions in turn."""
    for k in range(runs):
        turn = k // len(arms)
        arm, motion = arms[k % len(arms)], MOTIONS[turn % len(MOTIONS)]
        seed = 1 + turn // len(MOTIONS)
        load = LOADS[(seed - 1) % len(LOADS)]
        for kind, friction in KINDS.items():
            record = recorded(loop_of(arm, seed, load, **friction), motion, seed)
            yield Weighed(arm, motion, seed, load, kind, found(record, load))


def readings_of(runs: Iterable[Weighed], *, held: bool) -> Floats:
    """Return the readings (k, 4) after the pick-up, or before."""
    readings = np.concatenate([each.run.readings for each in runs])
    chosen: Floats = readings[(readings[:, TIME] > PICK_UP) == held]
    return chosen


def worst(readings: Floats) -> str:
    """Return the largest error over half of the interval."""
    if not readings.size:
        return '-'
    return f'{np.max(np.abs(readings[:, WEIGHED] - readings[:, HELD]) / readings[:, INTERVAL]):.1f}'


def after(runs: Iterable[Weighed], seconds: float) -> str:
    """Return medians of error and half interval [g] so long after the pick-up."""
    found = []
    for each in runs:
        of = each.run.readings
        found.append(of[of[:, TIME] >= PICK_UP + seconds][:1])
    readings = np.concatenate(found)
    if not readings.size:
        return '-'
    error = np.median(np.abs(readings[:, WEIGHED] - readings[:, HELD]))
    return f'{1e3 * error:.0f} (± {1e3 * np.median(readings[:, INTERVAL]):.0f})'


def row(name: str, runs: list[Weighed]) -> list[str]:
    """Return what some runs say."""
    empty, held = (readings_of(runs, held=held) for held in (False, True))
    told = np.concatenate((empty, held))
    told = told[certain(told)]
    return [
        name,
        f'{len(runs)}',
        share(outside(empty)),
        worst(empty),
        f'{1e3 * np.median(empty[:, 3]):.0f}' if empty.size else '-',
        share(outside(held)),
        worst(held),
        after(runs, 3.0),
        after(runs, 12.0),
        share(outside(told)),
        worst(told),
        f'{sum(each.run.changes.size for each in runs)}',
    ]


_HEAD = (
    *('friction', 'runs', 'empty: outside', 'worst', '± [g]', 'load: outside', 'worst'),
    *('error after 3 s [g]', 'after 12 s', 'certain: outside', 'worst', 'changes'),
)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_arms(parser, ARMS, 6, 'draws')
    parser.set_defaults(arms=list(FEW))


def main(options: argparse.Namespace) -> None:
    """Print the table, of all arms and of each."""
    done: list[Weighed] = []
    for each in draws(options.arms, options.runs):
        done.append(each)
        if options.each:
            name = f'{each.arm} {each.motion} {each.seed} {each.kind}'
            print(f'{each.load:.2f} kg', row(name, [each]), flush=True)
    rows = [row(kind, [d for d in done if d.kind == kind]) for kind in KINDS]
    for arm in options.arms:
        of = [d for d in done if d.arm == arm]
        rows += [
            row(f'{arm}, {k}', [d for d in of if d.kind == k]) for k in KINDS if of
        ]
    print_table(_HEAD, rows)
