# SPDX-License-Identifier: Apache-2.0
"""What the same box costs that comes again: 2 kg, picked up and put down twenty times in a run.

    python -m benchmark pick-and-place [PRESET ...] [--cycles 20] --out pick_and_place

The box is held for 5 s of every 10, in full motion.  A cell has the median and the largest of the
errors from the second cycle on at pick-up, and at putting down [mrad]: each is the largest of any
joint within 4 s.  The law is told nothing; or then to expect at each pick-up the load that it has
weighed before, and none at putting down; or to expect 2 kg where nothing or 4 kg are.
`pick_and_place.png` shows the errors of each cycle.
"""

from __future__ import annotations

import argparse
import functools
import itertools
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmark.harness import print_table
from benchmark.options import add_out
from blf_dsc_controller.analysis.figures import Picture
from blf_dsc_controller.cli.result_folder import make_folder
from blf_dsc_controller.configuration.nodes import PLANT, load_loop
from blf_dsc_controller.control.arm_controller import ArmController
from blf_dsc_controller.studies.runs import cores
from sim_plant.plant import plant_of

PRESETS = ('fr3_direct', 'panda', 'ur5e')
BOX = 2.0  # kg
CYCLE, HELD = 10.0, 5.0  # s
AFTER = 4.0  # s, in which the error of a change shows

_TICKS = 0.3, 1.0, 3.0, 10.0, 30.0  # mrad

ROWS: dict[str, tuple[float, dict[str, Any]]] = {
    'unknown': (BOX, {}),
    'remembered': (BOX, {'remember': True}),
    'nothing there, told 2 kg': (0.0, {'mass': BOX}),
    '4 kg there, told 2 kg': (2.0 * BOX, {'mass': BOX}),
    '4 kg there, unknown': (2.0 * BOX, {}),
}
"""What is there [kg], and what the law is told to expect."""


class Errors(NamedTuple):
    """Largest errors (cycles, 2) [mrad] at pick-up and at putting down; NaN after a stop."""

    worst: NDArray[np.float64]
    stop: str  # why the arm stopped, or empty

    @property
    def text(self) -> str:
        """A cell of the table: median and largest from the second cycle on."""
        later = self.worst[1:].T
        return self.stop or '; '.join(
            f'{np.median(each):.2g}, {each.max():.2g}' for each in later
        )


def run(cycles: int, case: tuple[str, str]) -> Errors:
    """Return the errors of a row and a preset."""
    row, preset = case
    mass, told = ROWS[row]
    begin = [CYCLE * (1 + k) for k in range(cycles)]
    events = {'begin': begin, 'duration': [HELD] * cycles, 'payload': [mass] * cycles}
    given = {f'events.{name}': value for name, value in events.items()}
    loop = load_loop(preset, {PLANT: given})
    law, arm = ArmController(loop.controller), plant_of(loop.plant)
    T = loop.controller.sample_time
    period, held = round(CYCLE / T), round(HELD / T)
    words = {0: told, held: {'mass': 0.0}} if told else {}
    errors = np.full((cycles + 1) * period, np.nan)
    stop = ''
    for k in range(errors.size):
        if k >= 2 * period and k % period in words:
            law.expect_load(**words[k % period], interval=0.0)
        torque = law.update(1.0 + k * T, *arm.measure().reshape(3, -1))
        if torque is None or law.reason:
            stop = f'stops in cycle {k // period}: {law.reason}'
            break
        arm.step(torque)
        errors[k] = 1e3 * np.abs(law.error).max()
    halves = errors[period:].reshape(cycles, 2, held)
    return Errors(halves[..., : round(AFTER / T)].max(axis=2), stop)


def draw(found: dict[tuple[str, str], Errors], presets: list[str], path: Path) -> None:
    """Draw the errors of each cycle: a column for each preset, pick-up above putting down."""
    title = 'The same box again and again: largest error of each cycle'
    picture = Picture(2, len(presets), title, (4.4, 2.9), share_time=False)
    for (row, preset), errors in found.items():
        column = picture.axes[:, presets.index(preset)]
        for axes, worst in zip(column, errors.worst.T, strict=True):
            axes.semilogy(np.arange(1, worst.size + 1), worst, 'o-', ms=3, label=row)
    for preset, column in zip(presets, picture.axes.T, strict=True):
        for axes, what in zip(column, ('pick-up', 'putting down'), strict=True):
            axes.set_title(f'{preset}: {what}', loc='left', fontsize=11.5)
            axes.set_ylim(0.2, 50.0)
            axes.set_yticks(_TICKS, [f'{tick:g}' for tick in _TICKS])
            axes.set_ylabel('error [mrad]')
        column[-1].set_xlabel('cycle')
    picture.axes[0, -1].legend(frameon=False, fontsize=9, loc='lower right')
    picture.save(path)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument('presets', nargs='*', metavar='PRESET', default=list(PRESETS))
    parser.add_argument('--cycles', type=int, default=20)
    add_out(parser, 'pick_and_place')


def main(options: argparse.Namespace) -> None:
    """Print the table, and draw the picture."""
    make_folder(options.out)
    cases = list(itertools.product(ROWS, options.presets))
    with ProcessPoolExecutor(cores()) as pool:
        errors = pool.map(functools.partial(run, options.cycles), cases)
        found = dict(zip(cases, errors, strict=True))
    rows = (
        [row, *(found[row, preset].text for preset in options.presets)] for row in ROWS
    )
    print_table(['', *options.presets], rows)
    draw(found, options.presets, options.out / 'pick_and_place.png')
