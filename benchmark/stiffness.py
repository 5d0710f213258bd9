# SPDX-License-Identifier: Apache-2.0
"""Stiffness of gears that `identify` finds in 15 s of positions of motors and of links.

    python -m benchmark stiffness

Presets follow a random motion by a PD, recorded at 200 Hz.  `fr3_direct` has torque sensors behind
its gears; the efforts of the others are those of the motors, in front of gears with friction.  A
cell has the stiffness over the true one, and the ends of its 95 % interval, of each joint.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from random_arm import recording_of, reference_of

from benchmark.harness import print_table
from blf_dsc_controller.configuration.nodes import PLANT, load_loop
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.identification.identify import identify_arm
from blf_dsc_controller.identification.stiffness import Compliance
from blf_dsc_controller.run import Floats
from sim_plant.plant import plant_of

_SECONDS = 15.0
_EVERY = 5  # samples of 1 ms
_SEED = 5
_RAMP = 2.0  # s, in which the motion begins
_MOST_EFFORT = 100.0  # N m, that scales the PD
_GAINS = 8.0, 0.48  # 1/rad and s/rad, times the effort
_WORN = {
    'joint.hysteresis': [2.0, 2.0, 2.0, 0.4, 0.4, 0.4],
    'joint.backlash': [1e-4] * 6,
}
_CASES: dict[str, tuple[str, int, Mapping[str, Any]]] = {
    'FR3, encoders of 20 bits': ('fr3_direct', 20, {'actuator.reflex_rate': 0.0}),
    'FR3, encoders of 10 bits': ('fr3_direct', 10, {'actuator.reflex_rate': 0.0}),
    'UR5e, 20 bits': ('ur5e', 20, {}),
    'UR5e with play of 0.1 mrad and hysteresis': ('ur5e', 20, _WORN),
    'OpenArm, play of 1 mrad': ('openarm', 20, {}),
}


def main(_options: argparse.Namespace) -> None:
    """Print the table."""
    rows = []
    for case, (name, bits, plant) in _CASES.items():
        events: dict[str, list[float]] = {
            f'events.{each}': [] for each in ('begin', 'duration', 'payload')
        }
        config = load_loop(name, {PLANT: {**events, **plant}}).plant
        found = _found(config, bits)
        rows.append((case, *_cells(found, np.array(config.joint.stiffness))))
    heads = [f'joint {k}' for k in range(1, 8)]
    print_table(('arm', *heads), [(*row, *('',) * (8 - len(row))) for row in rows])


def _cells(found: Compliance, truth: Floats) -> list[str]:
    return [
        f'{value:.3g} ({least:.3g} to {most:.3g})' if is_known else 'not known'
        for is_known, (value, least, most) in zip(
            found.is_known, (found.stiffness / truth).T, strict=True
        )
    ]


def _found(config: PlantConfig, bits: int) -> Compliance:
    """Return what is found of an arm that moves, by encoders of so many bits."""
    states, motors = _moved(config)
    step = 2.0 * np.pi / 2**bits
    states[:, 0], motors = (
        np.round(each / step) * step for each in (states[:, 0], motors)
    )
    recording = recording_of(
        states[::_EVERY], config.joints, _EVERY * config.sample_time
    )
    twist = motors - states[:, 0]
    found = identify_arm(recording._replace(twist=twist[::_EVERY]), config.robot)
    if found.compliance is None:
        raise AssertionError('a recording with both positions')
    return found.compliance


def _moved(config: PlantConfig) -> tuple[Floats, Floats]:
    """Return states (k, 3, n) and positions of motors (k, n) [rad] of a PD on a random motion."""
    chain = config.robot.chain(config.joints)
    T = config.sample_time
    motion = reference_of(chain, _SEED).at(np.arange(round(_SECONDS / T)) * T)
    start = motion[0, 0]
    initial = replace(config.initial, position=tuple(start.tolist()))
    plant = plant_of(replace(config, initial=initial))
    efforts = np.array([min(joint.effort, _MOST_EFFORT) for joint in chain.joints])
    n = efforts.size
    states = np.zeros((len(motion), 3, n))
    motors = np.zeros((len(motion), n))
    for k, (position, velocity, _) in enumerate(motion):
        _, dq, effort = plant.measure().reshape(3, -1)
        q = plant.truth()[-2 * n : -n]
        states[k] = q, dq, effort
        motors[k] = plant.motors[0]
        share = min(1.0, k * T / _RAMP)
        error = start + share * (position - start) - q
        p, d = _GAINS
        plant.step(efforts * (p * error + d * (share * velocity - dq)))
    return states, motors
