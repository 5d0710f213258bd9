# SPDX-License-Identifier: Apache-2.0
"""Periods of torque ripple that `identify` finds in 20 s of motion, and those that are not there.

    python -m benchmark ripple --arms 10

Presets with wrong URDFs, friction and noise follow random motions by a PD, recorded at 250 Hz.
Drives have a ripple of 0.8 % of their rated torque for each N, or none.  Amplitudes are
over the true ones.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from random_arm import Reference, recording_of, reference_of

from benchmark.harness import print_table
from blf_dsc_controller.configuration.nodes import PLANT, load_loop
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.identification.identify import identify_arm
from blf_dsc_controller.identification.ripple import Ripples, listed_cycles
from blf_dsc_controller.run import Floats
from sim_plant.plant import plant_of

EVERY = 4
"""Samples of 1 ms between states of a recording."""

SHARE = 0.008
"""Amplitude of a ripple, of the rated torque."""

_SECONDS = 20.0
_RAMP = 2.0  # s, in which the motion begins
_MOST_EFFORT = 100.0  # N m, that scales the PD
_GAINS = 8.0, 0.48  # 1/rad and s/rad, times the effort
_RIGHT = 0.03  # of N


class Case(NamedTuple):
    """Drives and a motion."""

    name: str
    preset: str
    cycles: Sequence[Sequence[float]]  # N of each joint, in turns
    pace: float = 1.0  # of the motion


_CASES = (
    Case('UR5e, none', 'ur5e', [[]]),
    Case('Panda, none', 'panda', [[]]),
    Case('UR5e, 30', 'ur5e', [[30.0]]),
    Case('UR5e, 30, at a third of the speed', 'ur5e', [[30.0]], 0.33),
    Case('UR5e, 12.5', 'ur5e', [[12.5]]),
    Case('UR5e, 100', 'ur5e', [[100.0]]),
    Case('UR5e, 100, at a third of the speed', 'ur5e', [[100.0]], 0.33),
    Case('UR5e, 20 and 50', 'ur5e', [[20.0, 50.0]]),
    Case('UR5e, 20 or 50, by joint', 'ur5e', [[20.0], [50.0]]),
    Case('Panda, 30', 'panda', [[30.0]]),
)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the number of arms of each case, and which cases."""
    parser.add_argument('--arms', type=int, default=1, help='of each case')
    parser.add_argument('--cases', type=int, nargs='*', help='numbers from 0 (all)')


def main(options: argparse.Namespace) -> None:
    """Print the table."""
    rows = []
    for case in [_CASES[k] for k in options.cases or range(len(_CASES))]:
        found, right, wrong = [], 0, 0
        joints = amount = 0
        ratios: list[float] = []
        for seed in range(options.arms):
            ripples, true, amplitudes = found_of(case, seed)
            joints += sum(map(len, true))
            amount += len(true)
            for own, cycles, amplitude in zip(ripples, true, amplitudes, strict=True):
                for each in own.found:
                    is_right = any(abs(each.cycles / N - 1.0) < _RIGHT for N in cycles)
                    right += is_right
                    wrong += not is_right
                    if is_right:
                        ratios.append(each.amplitude / amplitude)
            found.append(list(listed_cycles(ripples)))
        span = f'{min(ratios):.2f} to {max(ratios):.2f}' if ratios else ''
        rows.append((
            case.name, f'{right} of {joints}', f'{wrong} in {amount} joints', span,
            '; '.join(map(str, found)),
        ))  # fmt: skip
        print(rows[-1], flush=True)
    print_table(('case', 'found', 'wrong', 'amplitude', 'ripple_cycles'), rows)


def found_of(
    case: Case, seed: int
) -> tuple[Sequence[Ripples], list[Sequence[float]], Floats]:
    """Return what is found, and the true N and amplitudes [N m] of each joint."""
    events: dict[str, list[float]] = {
        f'events.{each}': [] for each in ('begin', 'duration', 'payload')
    }
    plant = {'actuator.ripple': 0.0, 'truth.seed': seed, **events}
    config = load_loop(case.preset, {PLANT: plant}).plant
    n = len(config.joints)
    true = [case.cycles[i % len(case.cycles)] for i in range(n)]
    amplitudes = SHARE * np.array(config.actuator.torque_limit)
    reference = reference_of(config.robot.chain(config.joints), seed)
    states = moved(config, true, amplitudes, reference, case.pace)[::EVERY]
    recording = recording_of(states, config.joints, EVERY * config.sample_time)
    return identify_arm(recording, config.robot).ripples, true, amplitudes


def moved(
    config: PlantConfig,
    cycles: Sequence[Sequence[float]],
    amplitudes: Floats,
    reference: Reference,
    pace: float,
) -> Floats:
    """Return states (k, 3, n) of a PD on a motion, with ripples of N `cycles` at the motors."""
    chain = config.robot.chain(config.joints)
    T = config.sample_time
    times = np.arange(round(_SECONDS / T)) * T
    motion = reference.at(pace * times)
    start = motion[0, 0]
    initial = replace(config.initial, position=tuple(start.tolist()))
    plant = plant_of(replace(config, initial=initial))
    efforts = np.array([min(joint.effort, _MOST_EFFORT) for joint in chain.joints])
    n = efforts.size
    states = np.zeros((len(motion), 3, n))
    ripple = np.zeros(n)
    for k, (position, velocity, _) in enumerate(motion):
        q, dq, effort = plant.measure().reshape(3, -1)
        states[k] = q, dq, effort + ripple
        ripple = amplitudes * [
            sum(np.sin(N * at) for N in own) for own, at in zip(cycles, q, strict=True)
        ]
        share = min(1.0, k * T / _RAMP)
        error = start + share * (position - start) - q
        p, d = _GAINS
        plant.step(efforts * (p * error + d * (share * pace * velocity - dq)) - ripple)
    return states
