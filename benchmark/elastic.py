# SPDX-License-Identifier: Apache-2.0
"""Arms whose gears give way: where the gains of the presets hold, and what they cost.

    python -m benchmark elastic

Each arm runs the motion of its preset for 20 s and picks up its rated payload at 8 s, with
every gear as stiff as the head of the column says.  Its links are off by 30 % (FR3: 10 %).
A cell has the largest error [mrad] before the pick-up, at it, and from 4 s after it on; or when
and why the arm stopped.  The laws are

    preset       the gains of the preset
    rigid        the gains of rigid gears: feedback through the inertia matrix
    maker        stiffness and damping that the maker of the arm publishes, over the model of
                 the URDF, without integral and learning: plausible arms are those on which
                 these hold
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
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
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.studies.runs import cores

STIFFNESS = (1e5, 3e4, 1e4, 5e3)  # N m/rad
SECONDS = 20.0
PICK_UP = 8.0  # s
SETTLED = 4.0  # s, after the pick-up
FREE = 0.3  # rad, a bound that no law leaves unless it shakes

_Changes = Mapping[str, object]
NO_LOOP: _Changes = {'actuator.loop_gain': 0.0, 'actuator.loop_damping': 0.0}


class Arm(NamedTuple):
    """A row: a preset, and what differs from it."""

    label: str
    preset: str
    changes: _Changes
    stiffness: tuple[float, ...]  # of the maker, N m/rad
    damping: tuple[float, ...]  # likewise, N m s/rad


FRANKA = (600.0,) * 4 + (250.0, 150.0, 50.0), (30.0,) * 4 + (10.0, 10.0, 5.0)
UR = (900.0,) * 3 + (500.0,) * 3, (60.0,) * 3 + (44.7,) * 3
ARMS = (
    Arm('FR3, direct, torque loop', 'fr3_direct', {}, *FRANKA),
    Arm('FR3, driver, torque loop', 'fr3', {}, *FRANKA),
    Arm('Panda, torque loop', 'panda', {}, *FRANKA),
    Arm('Panda, link', 'panda', NO_LOOP, *FRANKA),
    Arm('Panda, motor', 'panda', {**NO_LOOP, 'sensor.side': 'motor'}, *FRANKA),
    Arm('UR5e, 1 kHz, link', 'ur5e', {}, *UR),
    Arm('UR5e, 1 kHz, motor', 'ur5e', {'sensor.side': 'motor'}, *UR),
    Arm('UR5e, 500 Hz, link', 'ur5e_driver', {}, *UR),
)


def loop_of(arm: Arm, stiffness: float, law: str) -> LoopConfig:
    """Return the loop of an arm with gears of a stiffness [N m/rad]."""
    loop = load_loop(arm.preset)
    n = len(loop.controller.joints)
    plant = {
        'duration': SECONDS,
        'joint.stiffness': [stiffness] * n,
        'events.begin': [PICK_UP],
        'events.duration': [0.0],
        'events.payload': [loop.controller.robot.payload],
        **arm.changes,
    }
    controller = law_of(arm, law) | {'barrier.bound': [FREE] * n}
    if 'actuator.loop_gain' in arm.changes:
        controller['robot.torque_loop'] = plant['robot.torque_loop'] = False
    return load_loop(arm.preset, {PLANT: plant, CONTROLLER: controller})


def law_of(arm: Arm, law: str) -> dict[str, object]:
    """Return the parameters of a law of the table."""
    given = {'feedback.joint_stiffness': None, 'feedback.joint_damping': None}
    if law == 'rigid':
        return given | {'feedback.inertia': 'whole'}
    if law == 'preset':
        return {}
    k, d = (np.array(each) for each in (arm.stiffness, arm.damping))
    zeros = [0.0] * len(k)
    return {
        'feedback.joint_stiffness': k.tolist(),
        'feedback.joint_damping': d.tolist(),
        'surface.gain': zeros,
        'surface.mu': (0.99 * k / d).tolist(),
        'barrier.weight': (0.01 * k).tolist(),
        'disturbance.gain': zeros,
        'disturbance.observer_bandwidth': 0.0,
        'learning.weight': 0.0,
    }


def cell(arm: Arm, stiffness: float, law: str) -> str:
    """Return what happens to an arm."""
    loop = loop_of(arm, stiffness, law)
    if law == 'maker':
        count = len(loop.controller.learning.initial_estimate)
        still = {'learning.adaptation_gain': [0.0] * count}
        loop = loop._replace(controller=change(loop.controller, still))
    run = simulate(loop.controller, loop.plant).run()
    if run.stops:
        stop = run.stops[0]
        return f'{1e-9 * stop.stamp:.2f} s: {stop.reason}'
    errors = 1e3 * np.abs(np.asarray(run.error)).max(axis=1)
    spans = (4.0, PICK_UP), (PICK_UP, PICK_UP + SETTLED), (PICK_UP + SETTLED, SECONDS)
    of_spans = (errors[(run.time >= a) & (run.time < b)].max() for a, b in spans)
    return ', '.join(f'{each:.3g}' for each in of_spans)


def table() -> Iterator[list[str]]:
    """Compute the rows: each law on each arm."""
    laws = ('preset', 'rigid', 'maker')
    with ProcessPoolExecutor(cores()) as pool:
        for arm, law in product(ARMS, laws):
            cells = [pool.submit(cell, arm, K, law) for K in STIFFNESS]
            yield [arm.label, law, *(each.result() for each in cells)]


def main(_options: argparse.Namespace) -> None:
    """Print the table."""
    heads = ['arm', 'law', *(f'{K:.0e} N m/rad' for K in STIFFNESS)]
    print_table(heads, table())
