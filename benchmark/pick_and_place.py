# SPDX-License-Identifier: Apache-2.0
"""What the same box costs that comes again: 2 kg, picked up and put down twenty times in a run.

    python -m benchmark pick-and-place [PRESET ...] [--cycles 20]

The box is held for 5 s of every 10, in full motion.  A cell has the median and the largest of the
errors from the second cycle on at pick-up, and at putting down [mrad]: each is the largest of any
joint within 4 s.  The law is told nothing; or then to expect at each pick-up the load that it has
weighed before, and none at putting down; or to expect 2 kg where nothing or 4 kg are.
"""

from __future__ import annotations

import argparse
import functools
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np

from benchmark.harness import print_table
from blf_dsc_controller.configuration.nodes import PLANT, load_loop
from blf_dsc_controller.control.arm_controller import ArmController
from blf_dsc_controller.studies.runs import cores
from sim_plant.plant import plant_of

PRESETS = ('fr3_direct', 'panda', 'ur5e')
BOX = 2.0  # kg
CYCLE, HELD = 10.0, 5.0  # s
AFTER = 4.0  # s, in which the error of a change shows

ROWS: dict[str, tuple[float, dict[str, Any]]] = {
    'unknown': (BOX, {}),
    'remembered': (BOX, {'remember': True}),
    'nothing there, told 2 kg': (0.0, {'mass': BOX}),
    '4 kg there, told 2 kg': (2.0 * BOX, {'mass': BOX}),
    '4 kg there, unknown': (2.0 * BOX, {}),
}
"""What is there [kg], and what the law is told to expect."""


def cell(cycles: int, row: str, preset: str) -> str:
    """Return a cell of the table; or why the arm stops."""
    mass, told = ROWS[row]
    begin = [CYCLE * (1 + k) for k in range(cycles)]
    events = {'begin': begin, 'duration': [HELD] * cycles, 'payload': [mass] * cycles}
    given = {f'events.{name}': value for name, value in events.items()}
    loop = load_loop(preset, {PLANT: given})
    law, arm = ArmController(loop.controller), plant_of(loop.plant)
    T = loop.controller.sample_time
    period, held = round(CYCLE / T), round(HELD / T)
    words = {0: told, held: {'mass': 0.0}} if told else {}
    errors = []
    for k in range((cycles + 1) * period):
        if k >= 2 * period and k % period in words:
            law.expect_load(**words[k % period], interval=0.0)
        torque = law.update(1.0 + k * T, *arm.measure().reshape(3, -1))
        if torque is None or law.reason:
            return f'stops in cycle {k // period}: {law.reason}'
        arm.step(torque)
        errors.append(1e3 * np.abs(law.error).max())
    halves = np.array(errors[2 * period :]).reshape(-1, 2, held)
    worst = halves[..., : round(AFTER / T)].max(axis=2)
    return '; '.join(f'{np.median(each):.2g}, {each.max():.2g}' for each in worst.T)


def table(presets: list[str], cycles: int) -> Iterator[list[str]]:
    """Compute the rows of the table."""
    with ProcessPoolExecutor(cores()) as pool:
        for row in ROWS:
            yield [row, *pool.map(functools.partial(cell, cycles, row), presets)]


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument('presets', nargs='*', metavar='PRESET', default=list(PRESETS))
    parser.add_argument('--cycles', type=int, default=20)


def main(options: argparse.Namespace) -> None:
    """Print the table."""
    print_table(['', *options.presets], table(options.presets, options.cycles))
