# SPDX-License-Identifier: Apache-2.0
"""Whether the 95 % intervals of `identify` hold where the arm is not as its model says.

    python -m benchmark intervals --runs 12
    python -m benchmark intervals --runs 3 --kinds gains 'elastic joints'

The arms are those of `identification.py arms`.  Each moves for 20 s, and for 20 s with a load of
1 to 3 kg whose centre is up to 5 cm from the tip; states are recorded at 100 Hz.  A row has one
kind of truth, which is random for each joint: laws of friction of `test/friction_laws.py`, gears
that give way behind encoders at the motors (100 to 500 N m/rad per N m of the joint's limit),
gains of the torque sensors that are up to 20 % off, and positions in steps of 0.38 mrad, as in
the frames of Damiao's motors.  A cell has the share of intervals that hold the truth, and their
median half width: of base parameters relative to what the URDF leaves open, of the others
relative to the value.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from friction_laws import with_friction
from random_arm import (
    PERIOD,
    Truth,
    errors_and_deviations,
    measured,
    recording_of,
    reference_of,
    shake,
    shake_elastic,
    truth_of,
)

from benchmark import identification
from benchmark.harness import print_table
from benchmark.options import add_runs
from blf_dsc_controller.arms.inertia import inertia_of
from blf_dsc_controller.arms.urdf import Chain
from blf_dsc_controller.identification.identified import Identified
from blf_dsc_controller.identification.identify import identify_arm
from blf_dsc_controller.identification.recording import joined
from blf_dsc_controller.identification.values import ROTOR_INERTIA
from blf_dsc_controller.numerics.intervals import TWO_SIDED
from blf_dsc_controller.run import Floats

_SECONDS = 20.0  # of each motion
_EVERY = 10  # samples of 1 ms
_COARSE = 25.0 / (
    2**16 - 1
)  # rad: 16 bits over 25 rad, as in the frames of Damiao's motors
_COLUMNS = ('base parameters', 'viscous', 'Coulomb friction', 'rotors', 'payload')


class Kind(NamedTuple):
    """A kind of truth."""

    law: str = 'Coulomb'
    every: int = _EVERY
    is_elastic: bool = False
    gain: float = 0.0  # largest relative error
    encoder: float = 2.0 * np.pi / 2**20  # rad


KINDS = {
    'as modelled': Kind(),
    '125 Hz': Kind(every=8),
    'asymmetric friction': Kind('asymmetric'),
    'Stribeck': Kind('Stribeck'),
    'Dahl and Stribeck': Kind('elastic'),
    'Stribeck, rational': Kind('rational'),
    'load-dependent friction': Kind('load'),
    'elastic joints': Kind(is_elastic=True),
    'gains': Kind(gain=0.2),
    'coarse encoders': Kind(encoder=_COARSE),
    'coarse, elastic': Kind(is_elastic=True, encoder=_COARSE),
}
"""Rows of the table."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_runs(parser, 12, 'arms')
    parser.add_argument('--seed', type=int, default=0, help='of the first arm')
    parser.add_argument('--kinds', nargs='+', choices=KINDS, default=list(KINDS))


def main(options: argparse.Namespace) -> None:
    """Print the table."""
    results: dict[str, list[list[Floats]]] = {kind: [] for kind in options.kinds}
    seconds: dict[str, list[float]] = {kind: [] for kind in options.kinds}
    for seed in range(options.seed, options.seed + options.runs):
        arm = Arm(seed)
        for kind, found in results.items():
            begin = time.process_time()
            identified = arm.identified(KINDS[kind])
            seconds[kind].append(time.process_time() - begin)
            found.append(list(_compared(identified, arm)))
    rows = []
    for kind, found in results.items():
        cells = [_cell(np.hstack(column)) for column in zip(*found, strict=True)]
        rows.append((kind, *cells, f'{np.median(seconds[kind]):.1f} s'))
    print_table(('truth', *_COLUMNS, 'processor time'), rows)


class Arm:
    """A random arm, without friction in motion, with and without a load."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._robot = identification.random_robot(seed)
        chain = self._robot.chain(())
        self._joints = tuple(joint.name for joint in chain.joints)
        self.truth = truth_of(chain, seed)
        random = np.random.default_rng(1000 + seed)
        # kg, m
        self.load = np.append(random.uniform(1.0, 3.0), random.uniform(-0.05, 0.05, 3))
        zero = np.zeros(len(self._joints))
        empty = self.truth._replace(viscous=zero, coulomb=zero)
        truths = (empty, _loaded(chain, empty, self.load))
        efforts = np.array([min(joint.effort, 100.0) for joint in chain.joints])
        stiffness = 100.0 * efforts * 5.0 ** random.uniform(0.0, 1.0, efforts.size)
        self._gain = random.uniform(-1.0, 1.0, efforts.size)
        motions = [reference_of(chain, 2 * seed + k) for k in range(2)]
        self._rigid = [
            shake(chain, truth, motion, _SECONDS)
            for truth, motion in zip(truths, motions, strict=True)
        ]
        self._elastic = [
            shake_elastic(chain, truth, stiffness, motion, _SECONDS)
            for truth, motion in zip(truths, motions, strict=True)
        ]

    def identified(self, kind: Kind) -> Identified:
        """Return what `identify` finds."""
        recordings = []
        for k, motion in enumerate(self._elastic if kind.is_elastic else self._rigid):
            friction = self.truth.viscous, self.truth.coulomb
            states = with_friction(kind.law, motion, *friction, self._seed)
            states[:, 2] *= 1.0 + kind.gain * self._gain
            seen = measured(states, self._seed + 77 * k, kind.encoder)[:: kind.every]
            period = kind.every * PERIOD
            recordings.append(recording_of(seen, self._joints, period))
        together, (boundary,) = joined(*recordings)
        return identify_arm(together, self._robot, picked_up=boundary)


def _loaded(chain: Chain, truth: Truth, load: Floats) -> Truth:
    """Return the truth with a load (mass, centre in the tip)."""
    T = chain.tip_placement.copy()
    T[:3, 3] += T[:3, :3] @ load[1:]
    bodies = truth.inertias.copy()
    bodies[-1] += load[0] * inertia_of(T @ np.diag((2e-4, 2e-4, 2e-4, 1.0)) @ T.T)
    return truth._replace(inertias=bodies)


def _compared(found: Identified, arm: Arm) -> Iterator[Floats]:
    """Yield for each of _COLUMNS whether intervals hold, and their half widths (2, .)."""
    truth = arm.truth
    errors, deviations, before = errors_and_deviations(found, truth)
    n = len(truth.rotors)
    ends = np.cumsum((found.parameters.model.p, n))
    scales = (before[: ends[0]], truth.viscous, truth.coulomb)
    for error, deviation, scale in zip(
        np.split(errors, ends), np.split(deviations, ends), scales, strict=True
    ):
        yield _held(error, deviation, scale)
    rotors = found.parts.terms[ROTOR_INERTIA], found.deviations.terms[ROTOR_INERTIA]
    yield _held(rotors[0] - truth.rotors, rotors[1], truth.rotors)
    value, deviation = found.load
    held, half = _held(value - arm.load, deviation, np.ones(4))
    yield np.array((held, np.full(4, half[0] / arm.load[0])))


def _held(error: Floats, deviation: Floats, scale: Floats) -> Floats:
    half = TWO_SIDED * deviation
    return np.array((np.abs(error) < half, half / scale))


def _cell(found: Floats) -> str:
    held, half = found
    return f'{100.0 * held.mean():.0f} % (± {100.0 * np.median(half):.2g} %)'
