# SPDX-License-Identifier: Apache-2.0
"""Random arms with elastic joints: commissioned by simulated runs, then put to work.

    python -m benchmark commissioning [ARMS] [STUDY ...] [--unknown]

The arms are those of the studies `monte_carlo_elastic_*`: gears, motors, friction, links,
delays and tables are drawn independently of what controller and commissioning assume.  Each is
measured in three postures, and in one with its rated payload.  With the gains that follow it
runs the motion of its preset for 60 s, and picks up its load at 8 s.

    held       no stop, and no oscillation, in 60 s, with a bound that only an arm that oscillates
               would leave
    in bound   of these, those that keep the bound of the file that was written
    pick-up    largest error [mrad] within 4 s of it, in the median of those that hold; in
               brackets with the gains of the preset, where these hold
    bears      the largest of 1, 1.5, 2.5 and 4 by which all gains can be multiplied until the
               arm stops or oscillates within 16 s: the number of arms for each of them

`--unknown` commissions the same arms by files that have nothing but the URDF, what drivers know
of their robot, and the motion: the friction, the motors, the gears and the gains that the
presets have are left out.  With what is written each runs its motion for 16 s

    hidden     joints whose inertia friction hides
    bound      the largest error over the bound that is written; or why the arm stopped
    motion     the largest error [mrad] from 3 s on until the pick-up
    pick-up    likewise from the pick-up at 8 s on
    bears      as above
"""

from __future__ import annotations

import argparse
import itertools
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import NamedTuple

import numpy as np

from benchmark.harness import print_table
from benchmark.studies import FREE, load_study
from blf_dsc_controller.arms.known_gears import MARGIN
from blf_dsc_controller.commissioning import simulated
from blf_dsc_controller.commissioning.commissioned import Commissioned, commissioned
from blf_dsc_controller.commissioning.commissioning import Commissioning
from blf_dsc_controller.commissioning.measurement import Measured
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import LoopConfig
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import build, change, flatten
from blf_dsc_controller.configuration.side_nodes import RecorderConfig
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.studies.monte_carlo import draw, plant_with
from blf_dsc_controller.studies.runs import cores

STUDIES = (
    'monte_carlo_elastic_fr3',
    'monte_carlo_elastic_panda',
    'monte_carlo_elastic_ur5e',
)
LONG, SHORT = 60.0, 16.0  # s
BEGIN = 3.0  # s, from which errors in motion are counted
PICK_UP, LOADED = 8.0, 4.0  # s, and for how long after it errors are counted
FACTORS = (1.5, 2.5, 4.0)


class Outcome(NamedTuple):
    """What became of one arm."""

    refusal: str  # why there are no gains; empty if there are
    held: bool
    kept: bool  # its bound
    pick_up: float  # mrad
    before: float  # mrad, with the gains of the preset; NaN: they do not hold
    bears: float  # factor on the gains


def worked(
    controller: ControllerConfig, plant: PlantConfig, seconds: float
) -> tuple[bool, float]:
    """Return whether an arm holds, and its largest error [mrad] at the pick-up."""
    run = simulate(controller, change(plant, {'duration': seconds})).run()
    if run.error is None or run.stops or run.oscillations:
        return False, np.nan
    errors = 1e3 * np.abs(run.error).max(axis=1)
    loaded = (run.time >= PICK_UP) & (run.time < PICK_UP + LOADED)
    return True, float(errors[loaded].max())


def without_bound(controller: ControllerConfig) -> ControllerConfig:
    """Return a controller with bounds that only an arm that shakes would leave."""
    n = len(controller.joints)
    free = {'barrier.bound': [FREE] * n}
    return change(controller, free)


def refused(why: str) -> Outcome:
    """Return the outcome of an arm for which there are no gains."""
    return Outcome(why, False, False, np.nan, np.nan, 0.0)  # noqa: FBT003


def borne(controller: ControllerConfig, plant: PlantConfig) -> float:
    """Return the largest factor on the gains with which an arm holds."""
    most = 1.0
    for factor in FACTORS:
        if not worked(scaled(controller, factor), plant, SHORT)[0]:
            break
        most = factor
    return most


def scaled(controller: ControllerConfig, factor: float) -> ControllerConfig:
    """Return a controller with all gains multiplied."""
    integral = factor * np.array(controller.disturbance.gain)
    stiff = {
        'feedback.stiffness': factor * controller.feedback.stiffness,
        'disturbance.gain': integral.tolist(),
    }
    return change(controller, stiff)


def outcome(name: str, number: int) -> Outcome:
    """Return what becomes of an arm of a study."""
    try:
        found, plant = commissioning_of(name, number)
    except BlfDscError as error:
        return refused(str(error))
    if found.choice.margin.value < MARGIN:
        text = f'no gains have the margin: {found.choice.margin.value:.2f}'
        return refused(text)
    free = without_bound(found.config)
    held, pick_up = worked(free, plant, LONG)
    kept, _ = worked(found.config, plant, LONG)
    _, before = worked(without_bound(found.before), plant, SHORT)
    return Outcome('', held, kept, pick_up, before, borne(free, plant))


def commissioning_of(
    name: str,
    number: int,
    known: Callable[[ControllerConfig], ControllerConfig] = lambda config: config,
) -> tuple[Commissioned, PlantConfig]:
    """Return what is found of an arm of a study, and its plant.

    `known` returns what is known of the arm, by the configuration of the study.
    """
    study = load_study(name)
    controller = known(study.controller)
    # motors are drawn, which leaves nothing to scale
    plant = change(plant_with(study, draw(study, number)), {'truth.rotor_factor': 1.0})
    return commissioned(controller, runs_of(controller, plant), MARGIN), plant


def runs_of(controller: ControllerConfig, plant: PlantConfig) -> list[Measured]:
    """Return the runs of a commissioning of an arm that go to the end."""
    loop = LoopConfig(plant, controller, RecorderConfig())
    runs = [run for _, run in simulated.runs_of(Commissioning(controller), loop)]
    return [run for run in runs if not isinstance(run, BlfDscError)]


_STATED = (
    'sample_time',
    'joints',
    'robot.urdf',
    'robot.tip',
    'robot.gravity',
    'robot.effort',
    'robot.drive_',
    'torque.rate_limit',
    'torque.first_step',
    'reference.',
)


def by_urdf_alone(config: ControllerConfig) -> ControllerConfig:
    """Return a configuration that has the URDF, the facts of a driver, and the motion."""
    stated = {
        name: value
        for name, value in flatten(config).items()
        if name.startswith(_STATED)
    }
    return build(ControllerConfig, stated)


def unknown(name: str, number: int) -> list[str]:
    """Return the row of `unknown` for an arm."""
    first = [name.rpartition('_')[2], f'{number}']
    try:
        found, plant = commissioning_of(name, number, known=by_urdf_alone)
        config = found.config
    except BlfDscError as error:
        return [*first, str(error), '', '', '', '']
    run = simulate(config, change(plant, {'duration': SHORT})).run()
    hidden = f'{np.isnan(found.findings.inertia).sum()}'
    bears = f'{borne(without_bound(config), plant):g}'
    if run.error is None or run.stops:
        text = run.stops[0].text if run.stops else 'no sample'
        return [*first, hidden, f'stop: {text}', '', '', bears]
    errors = np.abs(run.error)
    moving = (run.time >= BEGIN) & (run.time < PICK_UP)
    used = f'{float((errors / np.array(config.barrier.bound)).max()):.2f}'
    if run.oscillations:
        used += ', oscillates'
    largest_errors = [
        f'{1e3 * float(errors[rows].max()):.2g}'
        for rows in (moving, run.time >= PICK_UP)
    ]
    return [*first, hidden, used, *largest_errors, bears]


def rows(names: tuple[str, ...], count: int) -> Iterator[list[str]]:
    """Compute the row of each study."""
    with ProcessPoolExecutor(cores()) as pool:
        for name in names:
            found = list(pool.map(outcome, itertools.repeat(name), range(count)))
            chosen = [each for each in found if not each.refusal]
            for text, times in Counter(e.refusal for e in found if e.refusal).items():
                print(f'{name}: {times} times: {text}')
            for k, each in enumerate(found):
                if not (each.refusal or each.held):
                    print(f'{name}: run {k} does not hold')
            bears = Counter(each.bears for each in chosen)
            pick_up = np.nanmedian([each.pick_up for each in chosen])
            before = np.nanmedian([each.before for each in chosen])
            yield [
                name.rpartition('_')[2],
                f'{count}',
                f'{len(chosen)}',
                f'{sum(each.held for each in chosen)}',
                f'{sum(each.held and each.kept for each in chosen)}',
                f'{pick_up:.2g} ({before:.2g})',
                ', '.join(f'{bears[factor]}' for factor in (1.0, *FACTORS)),
            ]


def unknown_rows(names: tuple[str, ...], count: int) -> Iterator[list[str]]:
    """Compute the row of each arm of which the URDF alone is known."""
    arms = itertools.product(names, range(count))
    with ProcessPoolExecutor(cores()) as pool:
        yield from pool.map(unknown, *zip(*arms, strict=True))


HEADS = (
    *('arm', 'arms', 'with gains', 'held', 'in bound', 'pick-up'),
    'bears 1, 1.5, 2.5, 4',
)
UNKNOWN = 'arm', 'number', 'hidden', 'bound', 'motion', 'pick-up', 'bears'


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument('arms', type=int, nargs='?', default=20, help='of each study')
    parser.add_argument('studies', nargs='*', metavar='STUDY', default=list(STUDIES))
    parser.add_argument(
        '--unknown', action='store_true', help='of arms of which the URDF is known'
    )


def main(options: argparse.Namespace) -> None:
    """Print a table."""
    names = tuple(options.studies)
    if options.unknown:
        print_table(UNKNOWN, unknown_rows(names, options.arms))
        return
    print_table(HEADS, rows(names, options.arms))
