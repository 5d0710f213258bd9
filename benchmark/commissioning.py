# SPDX-License-Identifier: Apache-2.0
"""Random arms with elastic joints: commissioned by simulated runs, then put to work.

    python benchmark/commissioning.py [ARMS] [STUDY ...]

The arms are those of the studies `monte_carlo_elastic_*`: gears, motors, friction, links,
delays and tables are drawn independently of what controller and commissioning assume.  Each is
measured in three postures, and in one with its rated payload.  With the gains that follow it
runs the motion of its preset for 60 s, and picks up its load at 8 s.

    held       no stop, and no oscillation, in 60 s, with a bound that only an arm that shakes
               would leave
    in bound   of these, those that keep the bound of the file that was written
    pick-up    largest error [mrad] within 4 s of it, in the median of those that hold; in
               brackets with the gains of the preset, where these hold
    bears      the largest of 1, 1.5, 2.5 and 4 by which all gains can be multiplied until the
               arm stops or oscillates within 16 s: the number of arms for each of them
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from itertools import repeat
from typing import NamedTuple

import numpy as np
from harness import print_table

from blf_dsc_controller.commissioning import simulated
from blf_dsc_controller.commissioning.commissioning import (
    commissioned,
)
from blf_dsc_controller.commissioning.own_loop import Commissioning
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import LoopConfig, RecorderConfig
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.studies.monte_carlo import draw, load_study, plant_with
from blf_dsc_controller.studies.runs import cores

STUDIES = (
    'monte_carlo_elastic_fr3',
    'monte_carlo_elastic_panda',
    'monte_carlo_elastic_ur5e',
)
MARGIN = 0.5
LONG, SHORT = 60.0, 16.0  # s
PICK_UP, LOADED = 8.0, 4.0  # s, and for how long after it errors are counted
FACTORS = (1.5, 2.5, 4.0)
FREE = 0.3  # rad, a bound that no law leaves unless it shakes


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
    free = {'barrier.bound': [FREE] * n, 'barrier.initial_bound': [0.0] * n}
    return change(controller, free)


def refused(why: str) -> Outcome:
    """Return the outcome of an arm for which there are no gains."""
    return Outcome(why, False, False, np.nan, np.nan, 0.0)  # noqa: FBT003


def borne(controller: ControllerConfig, plant: PlantConfig) -> float:
    """Return the largest factor on the gains with which an arm holds."""
    largest = 1.0
    for factor in FACTORS:
        gains = {
            'feedback.gain': controller.feedback.gain,
            'barrier.weight': controller.barrier.weight,
            'barrier.slope_limit': controller.barrier.slope_limit,
            'disturbance.gain': controller.disturbance.gain,
        }
        stiff = {
            name: (factor * np.array(values)).tolist() for name, values in gains.items()
        }
        if not worked(change(controller, stiff), plant, SHORT)[0]:
            break
        largest = factor
    return largest


def outcome(name: str, number: int) -> Outcome:
    """Return what becomes of an arm of a study."""
    study = load_study(name)
    plant = plant_with(study, draw(study, number))
    loop = LoopConfig(plant, study.controller, RecorderConfig())
    try:
        measuring = Commissioning(study.controller)
        runs = [run for _, run in simulated.runs_of(measuring, loop)]
        measured = [run for run in runs if not isinstance(run, BlfDscError)]
        found = commissioned(study.controller, measured, MARGIN)
    except BlfDscError as error:
        return refused(str(error))
    if found.choice.margin.value < MARGIN:
        text = f'no gains have the margin: {found.choice.margin.value:.2f}'
        return refused(text)
    free = without_bound(found.config)
    held, pick_up = worked(free, plant, LONG)
    kept, _ = worked(found.config, plant, LONG)
    _, before = worked(without_bound(study.controller), plant, SHORT)
    return Outcome('', held, kept, pick_up, before, borne(free, plant))


def rows(names: tuple[str, ...], count: int) -> Iterator[list[str]]:
    """Compute the row of each study."""
    with ProcessPoolExecutor(cores()) as pool:
        for name in names:
            found = list(pool.map(outcome, repeat(name), range(count)))
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


if __name__ == '__main__':
    many, *given = [*sys.argv[1:], *['20'][len(sys.argv) - 1 :]]
    print_table(
        [
            'arm',
            'arms',
            'with gains',
            'held',
            'in bound',
            'pick-up',
            'bears 1, 1.5, 2.5, 4',
        ],
        rows(tuple(given) or STUDIES, int(many)),
    )
