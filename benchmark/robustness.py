# SPDX-License-Identifier: Apache-2.0
"""What laws of equal gains bear: a torque that comes late, and drives that are lighter.

    python -m benchmark robustness

The presets `panda` and `ur5e` run for 6 s before anything is picked up.  The controller
is told the guessed rotor inertias as if they were known, so it measures none; nobody
tells it the later torque or the lighter drives.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from typing import NamedTuple

import numpy as np

from benchmark.harness import print_table
from blf_dsc_controller.configuration.nodes import (
    CONTROLLER,
    PLANT,
    LoopConfig,
    load_loop,
)
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.law.samples import sample_columns
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.studies.laws import LAWS, law_changes, roughness
from blf_dsc_controller.studies.runs import cores

PRESETS = ('panda_rigid', 'ur5e_rigid')
SECONDS = 6.0
SLOWER = 0.01  # s, a surface filter with which the torque is as smooth as the rivals'
_STARTED = 0.01  # s, from when on roughness counts

_Changes = Mapping[str, object]


class Rival(NamedTuple):
    """A law of the table: its name in `LAWS`, and what differs from its defaults."""

    label: str
    law: str
    changes: _Changes


RIVALS = (
    Rival('this law, without learning', 'no_learning', {}),
    Rival(
        f'the same, surface filter of {1e3 * SLOWER:.0f} ms',
        'no_learning',
        {'surface.time_constant': SLOWER},
    ),
    Rival('computed torque with integrator', 'computed_torque', {}),
    Rival('Slotine-Li with integrator', 'slotine_li', {}),
)
ARMS: Mapping[str, _Changes] = {
    'as stated': {},
    '1 ms later': {'actuator.delay': 2},
    '2 ms later': {'actuator.delay': 3},
    'drives 0.7': {'truth.rotor_factor': 0.7},
    'drives 0.6': {'truth.rotor_factor': 0.6},
}


def loop_of(preset: str, rival: Rival, arm: _Changes) -> LoopConfig:
    """Return the loop of a preset, with guessed rotor inertias that count as known."""
    law = load_loop(preset).controller
    guess = law.robot.rotors(law.robot.chain(law.joints))
    known = {'robot.rotor_inertia': guess.tolist()}
    plant = {'duration': SECONDS, 'events.begin': [10.0 * SECONDS]}
    loop = load_loop(
        preset, {CONTROLLER: {**known, **rival.changes}, PLANT: {**plant, **arm}}
    )
    changes = law_changes(LAWS[rival.law], loop.controller, {})
    return loop._replace(controller=change(loop.controller, changes))


def figures(preset: str, rival: Rival, arm: _Changes) -> tuple[float, float]:
    """Return the largest error [mrad] and the roughness, as a share of the torque limit [%]."""
    loop = loop_of(preset, rival, arm)
    with np.errstate(all='ignore'):  # a run that diverges has figures too
        record = simulate(loop.controller, loop.plant, supervised=False)
        error = 1e3 * np.abs(record.true_errors()).max()
        samples = sample_columns(record.samples, record.controller.settings)
        first = round(_STARTED / loop.controller.sample_time)
        rough = roughness(samples.torque[first:], loop.controller)
    return float(error), 100.0 * rough


def row(preset: str, rival: Rival) -> list[str]:
    """Return roughness and largest errors of a law on all arms."""
    each = [figures(preset, rival, arm) for arm in ARMS.values()]
    return [rival.label, f'{each[0][1]:.1f} %', *(f'{error:.2f}' for error, _ in each)]


def main(_options: argparse.Namespace) -> None:
    """Print a table for each preset."""
    row(PRESETS[0], RIVALS[0])  # compiles what the workers load
    with ProcessPoolExecutor(cores()) as pool:
        jobs = list(product(PRESETS, RIVALS))
        rows = list(pool.map(row, *zip(*jobs, strict=True)))
    for preset in PRESETS:
        chosen = [
            line for (of, _), line in zip(jobs, rows, strict=True) if of == preset
        ]
        print_table([f'{preset}: largest error [mrad]', 'roughness', *ARMS], chosen)
