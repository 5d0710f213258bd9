# SPDX-License-Identifier: Apache-2.0
"""Laws on arms whose URDF is wrong, and what learning is worth to a soft one.

    python -m benchmark arms --out arms

The first table is that of `blf_dsc arms` with all of its laws.  The second has errors
against the stiffness of the loop: a stiff one hides an unknown load, a soft one shows it.
Its runs are the same at parts of the bandwidth that the delay allows
(`feedback.stiffness`): the law with and without learning, and computed torque with the
linear gains of the law.  The bound grows as the errors do, with the inverse square of the
stiffness.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
from tqdm import tqdm

from benchmark.options import add_configs, add_out
from blf_dsc_controller.analysis.figures import Picture
from blf_dsc_controller.analysis.output import aligned, write_json
from blf_dsc_controller.analysis.panels import BLUE, MUTED, ORANGE
from blf_dsc_controller.cli import studies
from blf_dsc_controller.compiled.announcement import announced_compilation
from blf_dsc_controller.configuration.nodes import CONTROLLER, LoopConfig, load_loop
from blf_dsc_controller.progress import print_notice
from blf_dsc_controller.studies import laws
from blf_dsc_controller.studies.monte_carlo import UNSEEN, torque_rows
from blf_dsc_controller.studies.runs import cores

PARTS = (1.0, 0.5, 0.25, 0.125)
"""Values of `feedback.stiffness`."""
LAWS = {'proposed': BLUE, 'no_learning': ORANGE, 'computed_torque': MUTED}
SHOWN = {'before': '8 to 15 s', 'with the load': 'from 20 s'}
"""Intervals of `laws.INTERVALS` that are compared."""

_TICKS = (0.1, 1.0, 10.0, 100.0)  # mrad

Errors = dict[str, dict[str, list[float]]]
"""Largest error [rad] of the worst run, by law and interval, for each of PARTS."""


def soft_trial(name: str, seed: int, part: float) -> LoopConfig:
    """Return the loop of `laws.trial` at a part of the bandwidth, with its bound."""
    bound = load_loop(name).controller.barrier.bound
    wider = [each / part**2 for each in bound]
    soft = {'feedback.stiffness': part, 'barrier.bound': wider}
    return laws.trial(name, seed, {CONTROLLER: soft})


def largest_errors(key: tuple[str, float, int], arm: str) -> tuple[float, ...]:
    """Return the largest error [rad] in each of SHOWN for a law, a part and a seed."""
    law, part, seed = key
    loop = soft_trial(arm, seed, part)
    unseen = torque_rows(laws.trial(arm, UNSEEN).controller)
    figures = laws.run(law, loop, {}, unseen)
    by_interval = dict(zip(laws.INTERVALS, figures.errors, strict=True))
    return tuple(by_interval[name] for name in SHOWN.values())


def compare(folder: Path, arms: Sequence[str]) -> dict[str, Errors]:
    """Run everything, write stiffness.json and stiffness.png, return the errors."""
    found: dict[str, Errors] = {}
    seeds = range(1, laws.TRUTHS + 1)
    keys = list(product(LAWS, PARTS, seeds))
    with ProcessPoolExecutor(cores()) as pool:
        for arm in arms:
            runs = pool.map(partial(largest_errors, arm=arm), keys)
            values = np.array(list(tqdm(runs, total=len(keys), unit='run')))
            shape = (len(LAWS), len(PARTS), len(seeds), len(SHOWN))
            worst = values.reshape(shape).max(axis=2)
            found[arm] = {
                law: dict(zip(SHOWN, of_law.T.tolist(), strict=True))
                for law, of_law in zip(LAWS, worst, strict=True)
            }
    write_json(found, folder / 'stiffness.json')
    draw(found, folder / 'stiffness.png')
    return found


def format_errors(errors: Errors) -> str:
    """Return a table of errors [mrad] on one arm, a line for each law, interval."""
    rows = [['worst [mrad] at a stiffness of', *(f'{part:g}' for part in PARTS)]]
    for interval, (law, of_law) in product(SHOWN, errors.items()):
        label = f'{interval}: {laws.LAWS[law].label}'
        rows.append([label, *(f'{1e3 * value:.2f}' for value in of_law[interval])])
    return aligned(rows)


def draw(found: dict[str, Errors], path: Path) -> None:
    """Draw the errors of each arm against the stiffness."""
    title = 'What learning is worth to a soft arm'
    picture = Picture(1, len(found), title, (5.2, 4.2), share_time=False)
    for axes, (arm, errors) in zip(picture.axes[0], found.items(), strict=True):
        for interval, (law, of_law) in product(SHOWN, errors.items()):
            is_before = interval == 'before'
            axes.loglog(
                PARTS,
                1e3 * np.array(of_law[interval]),
                '--' if is_before else '-',
                color=LAWS[law],
                label=None if is_before else laws.LAWS[law].label,
            )
        axes.set_title(f'{arm}: with 2 kg (before: dashed)', loc='left', fontsize=11.5)
        axes.set_ylim(0.05, 200.0)
        axes.set_xticks(PARTS, [f'{part:g}' for part in PARTS])
        axes.set_xticks([], minor=True)
        axes.set_yticks(_TICKS, [f'{tick:g}' for tick in _TICKS])
        axes.set_xlabel('feedback.stiffness')
        axes.set_ylabel('largest error [mrad]')
    picture.axes[0, 0].legend(frameon=False, fontsize=9, loc='lower left')
    picture.save(path)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_configs(parser, 'panda_rigid', 'ur5e_rigid')
    add_out(parser, 'arms')


def main(options: argparse.Namespace) -> None:
    """Compare all laws, then at parts of the bandwidth; print both tables."""
    studies.arms(argparse.Namespace(**vars(options), laws=[]))
    with announced_compilation(print_notice):
        soft = compare(options.out, options.config)
    for arm, errors in soft.items():
        print(f'{arm}: parts of the bandwidth')
        print(format_errors(errors))
    print(f'wrote {options.out}: stiffness.json, stiffness.png')
