# SPDX-License-Identifier: Apache-2.0
"""Errors of the presets with and without learning, all else equal.

    python -m benchmark presets [PRESET ...]
    python -m benchmark presets fr3_direct panda ur5e --arms 10
    python -m benchmark presets fr3_direct panda ur5e --picture doc/pick_up.png

Each runs for 60 s; by default those with elastic gears, which pick up 2 kg at 20 s, in full motion,
and put them down at 45 s.  A cell has the largest error of any joint [mrad], with learning /
without: a PID over the URDF's model along the reference, with the load observer where the arm
has joint torque sensors.  The next rows are of a law that is told both as they happen, and of one
that is told 2 kg and holds nothing.  The last row is the load with its 95 % interval, 5 s after the
pick-up.

With `--arms` that many arms of each preset, which differ in masses, centres and noise, run until
the load is put down: a cell has the median of the errors and, in brackets, that of the worst arm.

With `--picture` nothing is printed, but the errors around the pick-up are drawn.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

from benchmark.harness import print_table
from blf_dsc_controller.analysis.figures import Picture, head
from blf_dsc_controller.analysis.panels import BLUE, INK, ORANGE
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import PLANT, load_loop
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.control.arm_controller import ArmController
from blf_dsc_controller.law.samples import sample_columns
from blf_dsc_controller.simulation.loop import Record, simulate
from blf_dsc_controller.studies.runs import cores
from sim_plant.plant import plant_of

PRESETS = ('fr3_direct', 'fr3', 'panda', 'ur5e', 'ur5e_driver')
SPANS = {  # s
    'first 3 s': (0.0, 3.0),
    '4 to 20 s': (4.0, 20.0),
    '15 to 20 s': (15.0, 20.0),
    'at the pick-up': (20.0, 24.0),
    'with the load, 24 to 45 s': (24.0, 45.0),
    'put down': (45.0, 49.0),
}
TOLD = ('pick-up, told', 'put down, told', 'nothing there, told 2 kg')
LOAD = 2.0  # kg
AFTER = 4000  # samples, in which the errors of a change show
SECONDS = 60.0
WEIGHED = 25.0  # s
DRAWN = (15.0, 30.0)  # s


def without_learning(controller: ControllerConfig) -> ControllerConfig:
    """Return a controller that keeps its estimate at first: a PID over the model of the URDF."""
    still = {'learning.enabled': False}
    return change(controller, still)


def told(controller: ControllerConfig, plant: PlantConfig) -> list[str]:
    """Return the errors [mrad] at pick-up and putting down of an arm whose law is told of both."""
    law, arm = ArmController(controller), plant_of(plant)
    said = {SPANS['at the pick-up'][0]: LOAD, SPANS['put down'][0]: 0.0}
    errors = []
    for k in range(round(SPANS['put down'][1] / controller.sample_time)):
        t = k * controller.sample_time
        if t in said:
            law.expect_load(said[t], interval=0.0)
        torque = law.update(1.0 + t, *arm.measure().reshape(3, -1))
        if torque is None or law.reason:
            return [f'stops: {law.reason}', '']
        arm.step(torque)
        errors.append(1e3 * np.abs(law.error).max())
    begins = [round(t / controller.sample_time) for t in said]
    return [f'{max(errors[at : at + AFTER]):.2g}' for at in begins]


def weight_of(record: Record) -> str:
    """Return the load that an arm has found at WEIGHED, with its 95 % interval."""
    sample = sample_columns(record.samples, record.controller.settings)
    at = int(np.searchsorted(1e-9 * record.stamps, WEIGHED))
    mass, half = sample.load[at, 0], sample.load[at, 4]
    return f'{mass:.3f} ± {half:.3f} kg'


def column(preset: str) -> list[str]:
    """Return the column of a preset."""
    loop = load_loop(preset, {PLANT: {'duration': SECONDS}})
    records = [
        simulate(controller, loop.plant)
        for controller in (loop.controller, without_learning(loop.controller))
    ]
    runs = [record.run() for record in records]
    for run in runs:
        if run.stops or run.oscillations:
            return [f'does not hold: {run.stops or run.oscillations}']
    errors = [1e3 * np.abs(np.asarray(run.error)).max(axis=1) for run in runs]
    time = runs[0].time
    cells = [
        ' / '.join(
            f'{each[(time >= begin) & (time < end)].max():.2g}' for each in errors
        )
        for begin, end in SPANS.values()
    ]
    empty = change(loop.plant, {'events.payload': [0.0]})
    wrong, _ = told(loop.controller, empty)
    known = told(loop.controller, loop.plant)
    return [*cells, *known, wrong, weight_of(records[0])]


def two(error: float) -> str:
    """Return an error [mrad] with two digits."""
    return f'{error:#.2g}'.rstrip('.')


def errors_of(controller: ControllerConfig, plant: PlantConfig) -> list[float]:
    """Return the largest error [mrad] in each span; NaN: the arm stops."""
    run = simulate(controller, plant).run()
    if run.stops or run.oscillations:
        return [np.nan] * len(SPANS)
    error = 1e3 * np.abs(np.asarray(run.error)).max(axis=1)
    spans = (error[(run.time >= a) & (run.time < b)] for a, b in SPANS.values())
    return [float(each.max(initial=0.0)) for each in spans]


def errors_of_arm(given: tuple[str, int]) -> list[list[float]]:
    """Return the errors of an arm of a preset, with this seed, with and without learning."""
    preset, seed = given
    arm = {'duration': SPANS['put down'][0], 'seed': seed, 'truth.seed': seed}
    loop = load_loop(preset, {PLANT: arm})
    laws = loop.controller, without_learning(loop.controller)
    return [errors_of(law, loop.plant) for law in laws]


def rows_of_arms(presets: list[str], arms: int) -> Iterator[list[str]]:
    """Compute the rows of the table of the medians and of the worst of this many arms."""
    given = [(preset, seed) for preset in presets for seed in range(1, arms + 1)]
    with ProcessPoolExecutor(cores()) as pool:
        found = np.array(list(pool.map(errors_of_arm, given)))
    found = found.reshape(len(presets), arms, 2, len(SPANS))
    medians, worst = np.median(found, axis=1), found.max(axis=1)
    for k, span in enumerate(list(SPANS)[:-1]):
        cells = [
            ' / '.join(f'{two(m)} ({two(w)})' for m, w in zip(*both, strict=True))
            for both in zip(medians[:, :, k], worst[:, :, k], strict=True)
        ]
        yield [span, *cells]


def rows(presets: list[str]) -> Iterator[list[str]]:
    """Compute the rows of the table."""
    with ProcessPoolExecutor(cores()) as pool:
        columns = list(pool.map(column, presets))
    for name, *cells in zip((*SPANS, *TOLD, 'weighed'), *columns, strict=True):
        yield [name, *cells]


def draw(presets: list[str], path: Path) -> None:
    """Draw the largest error of any joint around the pick-up, with and without learning."""
    title = 'Largest tracking error of any joint, with and without learning'
    picture = Picture(len(presets), 1, title, (9.5, 2.0))
    for axes, preset in zip(picture.axes[:, 0], presets, strict=True):
        loop = load_loop(preset, {PLANT: {'duration': DRAWN[1]}})
        for label, colour, controller in (
            ('without learning', ORANGE, without_learning(loop.controller)),
            ('with learning', BLUE, loop.controller),
        ):
            run = simulate(controller, loop.plant).run()
            shown = run.time >= DRAWN[0]
            error = 1e3 * np.abs(np.asarray(run.error)[shown]).max(axis=1)
            axes.plot(run.time[shown], error, color=colour, lw=0.9, label=label)
        at = SPANS['at the pick-up'][0]
        axes.axvline(at, color=INK, ls=':', lw=1.3, label=f'{LOAD:g} kg are picked up')
        axes.set_ylim(bottom=0.0)
        axes.set_ylabel('[mrad]')
        head(axes, f'{preset}, bound {1e3 * min(loop.controller.barrier.bound):g} mrad')
    picture.save(path)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument('presets', nargs='*', metavar='PRESET', default=list(PRESETS))
    about = 'medians of this many arms of each preset'
    parser.add_argument('--arms', type=int, default=0, help=about)
    about = 'only draw the errors around the pick-up into this PNG'
    parser.add_argument('--picture', type=Path, help=about)


def main(options: argparse.Namespace) -> None:
    """Print the table, or draw its errors."""
    if options.picture:
        draw(options.presets, options.picture)
        return
    found = (
        rows_of_arms(options.presets, options.arms)
        if options.arms
        else rows(options.presets)
    )
    print_table(['', *options.presets], found)
