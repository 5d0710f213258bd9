# SPDX-License-Identifier: Apache-2.0
"""Periods of torque ripple that `identify` finds in 20 s of motion, and those that are not there.

    python -m benchmark ripple --arms 10
    python -m benchmark ripple --arms 10 --references

Presets with wrong URDFs, friction and noise follow random motions by a PD, recorded at 250 Hz.
Drives have a ripple of 0.8 % of their rated torque for each N, or none.  Amplitudes are
over the true ones.

`--references`: random arms with elastic joints (`monte_carlo_elastic_*`) follow the reference of
their study, or the slow motion that does not repeat which a commissioning names, with the ripple of
their drives and without.  A list is right if each N is within 3 %.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from random_arm import Reference, recording_of, reference_of

from benchmark.harness import print_table
from benchmark.studies import load_study
from blf_dsc_controller.commissioning.slow_motion import slow_frequencies
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import PLANT, load_loop
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.identification.identify import ripples_left
from blf_dsc_controller.identification.problem import problem_of
from blf_dsc_controller.identification.recording import Recording, resampled
from blf_dsc_controller.identification.regression import fitted
from blf_dsc_controller.identification.ripple import Ripples, listed_cycles
from blf_dsc_controller.run import Floats, Run
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.studies.monte_carlo import draw, plant_with
from sim_plant.plant import plant_of

_SECONDS = 20.0
_EVERY = 4  # samples of 1 ms
_SHARE = 0.008  # of the rated torque
_RAMP = 2.0  # s, in which the motion begins
_MOST_EFFORT = 100.0  # N m, that scales the PD
_GAINS = 8.0, 0.48  # 1/rad and s/rad, times the effort
_RIGHT = 0.03  # of N
_STUDIES = 'ur5e', 'panda', 'fr3'
_FIRST = 3  # number of a random arm
_LENGTHS = 15.0, 30.0, 60.0  # s


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
    parser.add_argument(
        '--references', action='store_true', help='of random arms, in a closed loop'
    )


def main(options: argparse.Namespace) -> None:
    """Print the table."""
    if options.references:
        _print_references(options.arms)
        return
    rows = []
    for case in [_CASES[k] for k in options.cases or range(len(_CASES))]:
        found, right, wrong = [], 0, 0
        joints = amount = 0
        ratios: list[float] = []
        for seed in range(options.arms):
            config = config_of(case.preset, seed)
            n = len(config.joints)
            true = [case.cycles[i % len(case.cycles)] for i in range(n)]
            reference = reference_of(config.robot.chain(config.joints), seed)
            ripples = found_of(config, true, reference, case.pace)
            amplitudes = amplitudes_of(config)
            joints += sum(map(len, true))
            amount += n
            for own, cycles, amplitude in zip(ripples, true, amplitudes, strict=True):
                for each in own.found:
                    is_right = any(abs(each.cycles / N - 1.0) < _RIGHT for N in cycles)
                    right += is_right
                    wrong += not is_right
                    if is_right:
                        ratios.append(each.amplitude / amplitude)
            found.append(str(list(listed_cycles(ripples))))
        span = f'{min(ratios):.2f} to {max(ratios):.2f}' if ratios else ''
        rows.append((
            case.name, f'{right} of {joints}', f'{wrong} in {amount} joints', span,
            '; '.join(f'{found.count(each)} times {each}' for each in sorted({*found})),
        ))  # fmt: skip
    print_table(('case', 'found', 'wrong', 'amplitude', 'ripple_cycles'), rows)


def _print_references(arms: int) -> None:
    """Print what is found of random arms along their references."""
    rows = []
    for name in _STUDIES:
        study = load_study(f'monte_carlo_elastic_{name}')
        slow = change(
            study.controller,
            {'reference.frequency': list(slow_frequencies(study.controller))},
        )
        for motion, controller in (('own', study.controller), ('slow', slow)):
            lists: dict[tuple[float, bool], list[Sequence[float]]] = {}
            for number in range(_FIRST, _FIRST + arms):
                plant = plant_with(study, draw(study, number))
                true = plant.actuator.ripple_cycles
                for has in (True, False):
                    run = _alone(controller, plant, has_ripple=has)
                    for seconds in _LENGTHS:
                        found = listed_cycles(found_along(run, controller, seconds))
                        lists.setdefault((seconds, has), []).append(found)
            for seconds in _LENGTHS:
                right = [
                    bool(each) and all(abs(N / true - 1.0) < _RIGHT for N in each)
                    for each in lists[seconds, True]
                ]
                named = sum(map(bool, lists[seconds, True])) - sum(right)
                wrong = sum(map(bool, lists[seconds, False]))
                rows.append((
                    name, motion, f'{seconds:g}', f'{sum(right)} of {arms}', f'{named}',
                    f'{wrong} of {arms}',
                ))  # fmt: skip
    print_table(
        ('arms', 'motion', 'for [s]', 'right', 'wrong', 'wrong without ripple'), rows
    )


def _alone(
    controller: ControllerConfig, plant: PlantConfig, *, has_ripple: bool
) -> Run:
    """Return a run of an arm without events, with the ripple of its drives or none."""
    values: dict[str, object] = {
        'duration': max(_LENGTHS),
        'events.begin': (),
        'events.duration': (),
        'events.payload': (),
        'truth.rotor_factor': 1.0,  # motors are drawn, which leaves nothing to scale
    }
    if not has_ripple:
        values['actuator.ripple'] = 0.0
    return simulate(controller, change(plant, values)).run()


def found_along(
    run: Run, controller: ControllerConfig, seconds: float = np.inf
) -> Sequence[Ripples]:
    """Return what is found in the first seconds of a run, in which the arm carries nothing."""
    rows = np.flatnonzero(run.time <= seconds)[::_EVERY]
    turning = np.zeros(len(run.joints), dtype=bool)
    recording = resampled(
        run.joints, run.stamp[rows], run.position[rows], run.torque[rows], '', turning
    )
    return found_in(recording, controller.robot)


def config_of(preset: str, seed: int, **events: Sequence[float]) -> PlantConfig:
    """Return an arm without a ripple of its own; `events` are a load."""
    plant: dict[str, object] = {'actuator.ripple': 0.0, 'truth.seed': seed}
    for name in ('begin', 'duration', 'payload'):
        plant[f'events.{name}'] = tuple(events.get(name, ()))
    return load_loop(preset, {PLANT: plant}).plant


def found_of(
    config: PlantConfig,
    cycles: Sequence[Sequence[float]],
    reference: Reference,
    pace: float = 1.0,
    load: float | None = None,
) -> Sequence[Ripples]:
    """Return what is found of an arm with N `cycles` of each joint; a load comes at that time [s].

    Friction is fitted as viscous and Coulomb friction: terms are not selected, which takes long.
    So it is in `found_in`.
    """
    states = moved(config, cycles, reference, pace)[::_EVERY]
    recording = recording_of(states, config.joints, _EVERY * config.sample_time)
    return found_in(recording, config.robot, load)


def found_in(
    recording: Recording, robot: Robot, load: float | None = None
) -> Sequence[Ripples]:
    """Return what is found in a recording; a load comes at that time [s]."""
    problem = problem_of(recording, robot, 'torque', load, find_signs=False)
    prior = problem.prior.only([])
    fit = fitted(problem.rows, problem.windows.moving, problem.G, prior)
    return ripples_left(problem, np.zeros(len(recording.joints)), fit)


def amplitudes_of(config: PlantConfig) -> Floats:
    """Return the amplitude (n,) [N m] of each ripple."""
    return _SHARE * np.array(config.actuator.torque_limit)


def moved(
    config: PlantConfig,
    cycles: Sequence[Sequence[float]],
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
    amplitudes = amplitudes_of(config)
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
