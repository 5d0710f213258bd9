# SPDX-License-Identifier: Apache-2.0
"""The figures of doc/arms.md for the presets `panda` and `ur5e`: `make expect`.

Largest errors of any joint, the worst of several truths, each with its own noise; the law
continues outside its bound.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from blf_dsc_controller.configuration.nodes import LoopConfig, load_loop
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.simulation.loop import START, Record, simulate
from blf_dsc_controller.studies.runs import another_motion, torque_error, torque_rows
from blf_dsc_controller.supervision.guard import Guard

PRESETS = ('panda', 'ur5e')
MOMENTS = np.arange(6.0, 11.0, 0.5)  # s, over one period of the motion
CALM = {'actuator.time_constant': 0.0, 'actuator.ripple': 0.0, 'actuator.torque_noise': 0.0}
CALM |= {'disturbance.stribeck': 0.0}
IDEAL = CALM | {'sensor.resolution': 0.0, 'sensor.velocity': 'measured', 'actuator.delay': 0}
EXAMPLE = Path(__file__).parents[1] / 'examples/mujoco_plant'


def loop_of(
    name: str, seed: int, pick_up: float, kg: float, changes: Mapping[str, Any]
) -> LoopConfig:
    """Return the loop of a preset whose arm, with this truth, picks up `kg` 2 s before the end."""
    loop = load_loop(name)
    plant = {
        'duration': pick_up + 2.0,
        'seed': seed,
        'truth.seed': seed,
        'events.begin': [pick_up],
        'events.duration': [0.0],
        'events.payload': [kg],
        **changes,
    }
    law = change(loop.controller, {'safety.error_ratio': 0.0})
    return loop._replace(controller=law, plant=change(loop.plant, plant))


def simulated(
    name: str, seed: int, pick_up: float, kg: float, changes: Mapping[str, Any] | None = None
) -> tuple[Record, np.ndarray]:
    """Run such a loop; also return the largest true joint error of each sample (k,) [mrad]."""
    loop = loop_of(name, seed, pick_up, kg, changes or {})
    record = simulate(loop.controller, loop.plant, supervised=False)
    return record, 1e3 * np.abs(record.true_errors()).max(axis=1)


def in_mujoco(name: str, seed: int, changes: Mapping[str, Any]) -> np.ndarray:
    """Return the largest measured joint error of each sample (k,) [mrad]; 2 kg at 15 s."""
    sys.path.insert(0, str(EXAMPLE))
    example = importlib.import_module('mujoco_plant')
    loop = loop_of(name, seed, 15.0, 2.0, changes)
    arm, guard = example.MujocoArm(loop.plant), Guard(loop.controller, lambda: 0, lambda: 0)
    guard.activate()
    errors = np.zeros(17_000)
    for k in range(errors.size):
        arm.step(guard.update(START + k * 1_000_000, arm.measure()))
        errors[k] = 1e3 * np.abs(guard.controller.sample.xi1).max()
    return errors


def model_error(record: Record, unseen: np.ndarray, row: int) -> float:
    """Return the torque error [%] of the learned model at a sample, on rows of H (k, p)."""
    p = unseen.shape[1]
    return 100.0 * torque_error(unseen, record.sample(row).estimate[:p], record.truths[row, :p])


def figures(name: str, seed: int) -> dict[str, float]:
    """Return the figures of one truth."""
    unseen = torque_rows(another_motion(load_loop(name).controller, 1))
    record, errors = simulated(name, seed, 20.0, 2.0)
    _, ideal = simulated(name, seed, 13.0, 0.0, IDEAL)
    found = {
        'first 3 s [mrad]': errors[:3000].max(),
        'from 8 s on [mrad]': errors[8000:20_000].max(),
        '2 kg picked up at 20 s [mrad]': errors[20_000:].max(),
        'another motion, after 10 s [%]': model_error(record, unseen, 10_000),
        'another motion, 1 s after the pick-up [%]': model_error(record, unseen, 21_000),
        'ideal sensors and drives, from 10 s on [mrad]': ideal[10_000:].max(),
        '3 kg from the start [mrad]': simulated(name, seed, 0.0, 3.0)[1].max(),
        '2 kg at any moment [mrad]': max(simulated(name, seed, t, 2.0)[1].max() for t in MOMENTS),
    }
    for words, changes in (('MuJoCo', {}), ('MuJoCo without lag, ripple, noise', CALM)):
        errors = in_mujoco(name, seed, changes)
        found[f'{words}, from 8 s on [mrad]'] = errors[8000:15_000].max()
        found[f'{words}, pick-up [mrad]'] = errors[15_000:].max()
    return found


def main() -> None:
    """Print the worst case of each figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--truths', type=int, default=5)
    truths = range(parser.parse_args().truths)
    for name in PRESETS:
        runs = [figures(name, seed) for seed in truths]
        print(f'{name}, worst of {len(truths)} truths')
        for what in runs[0]:
            print(f'{max(run[what] for run in runs):8.3g}  {what}')


if __name__ == '__main__':
    main()
