# SPDX-License-Identifier: Apache-2.0
"""Identification and weighing of simulated arms, each in one table; real ones: `league.py`.

    python -m benchmark identification arms --runs 100
    python -m benchmark identification weighing --runs 100

arms        Panda, UR5e and random chains of six joints, with links, centres of mass, rotors and
            friction drawn at random, identified from positions and efforts alone: encoders of 20
            bits and 1 % noise of torque, for half a minute at 1 kHz and at 100 Hz.
weighing    What arms hold, weighed while they move. Each run has links up to 30 % heavier or
            lighter than the URDF's, centres of mass 1 cm off, drives and friction of its own, and a
            random motion of three tones that does not repeat. 2 kg are picked up after 10 to 14 s.
            The drives of `fr3` compensate gravity and friction by a wrong model.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable
from contextlib import suppress
from typing import Any

import numpy as np
import random_arm
from random_arm import (
    PERIOD,
    is_covered,
    measured,
    recording_of,
    reference_of,
    shake,
    truth_of,
)

from benchmark.harness import print_table
from benchmark.options import add_configs, add_runs
from blf_dsc_controller.arms.inertia import pseudo_inertia
from blf_dsc_controller.configuration.nodes import (
    CONTROLLER,
    PLANT,
    LoopConfig,
    load_loop,
)
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.identification.identified import Identified
from blf_dsc_controller.identification.identify import identify_arm
from blf_dsc_controller.identification.recording import Recording
from blf_dsc_controller.identification.values import base_matrix
from blf_dsc_controller.identification.windows import rows_of
from blf_dsc_controller.law.samples import sample_columns
from blf_dsc_controller.reference.approach import MotionError
from blf_dsc_controller.run import Floats
from blf_dsc_controller.simulation.loop import simulate

DURATION = 30.0
"""Length of a recording [s]."""

_UNSEEN = 10.0  # s
_EVERY = (1, 10)  # samples of 1 ms from state to state
_LOAD = 2.0  # kg
_AFTER = (1.0, 2.0, 3.0)  # s, from the pick-up to a reading
_HEADS = {
    'arms': (
        'rate',
        'torque error on unseen motion: URDF',
        'identified',
        '95 % intervals',
        'time',
    ),
    'weighing': (
        *('arm', 'nothing held [g]', *(f'2 kg after {t:g} s [g]' for t in _AFTER)),
        *('centre after 3 s [mm]', 'within 95 % intervals: mass', 'centre'),
    ),
}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument('what', choices=_HEADS)
    add_configs(parser, 'panda', 'ur5e', 'fr3')
    add_runs(parser, 100, 'arms, or runs of each arm')


def main(options: argparse.Namespace) -> None:
    """Print the table."""
    rows: Iterable[tuple[str, ...]] = (
        _weighed(name, options.runs) for name in options.config
    )
    if options.what == 'arms':
        rows = _identified(options.runs)
    print_table(_HEADS[options.what], rows)


def _identified(arms: int) -> list[tuple[str, ...]]:
    # (arms, rates, columns)
    results = np.array([_of_arm(seed) for seed in range(arms)])
    print(
        f'{arms} arms, {np.sum(results[:, :, 4] == 0.0)} results with unphysical bodies'
    )
    return [
        (
            f'{1.0 / (every * PERIOD):.0f} Hz',
            *(
                f'{np.median(e):.2f} % (95 of 100: {np.percentile(e, 95):.2f})'
                for e in rate[:2]
            ),
            f'{100.0 * rate[2].mean():.1f} % hold the truth',
            f'{np.median(rate[3]):.2f} s',
        )
        for every, rate in zip(_EVERY, np.transpose(results, (1, 2, 0)), strict=True)
    ]


def random_robot(seed: int) -> Robot:
    """Return a Panda, a UR5e or a random chain, by turns."""
    if seed % 3 == 2:
        return Robot(urdf=random_arm.random_urdf(6, seed)[0], tip='tip', payload=1.0)
    file, tip = (('panda.urdf', 'panda_hand_tcp'), ('ur5e.urdf', 'tool0'))[seed % 3]
    return Robot(urdf=(random_arm.CONFIG / file).read_text(), tip=tip)


def _of_arm(seed: int) -> list[tuple[float, ...]]:
    """Return for each rate the errors [%] before and after, coverage, time and whether physical."""
    robot = random_robot(seed)
    chain = robot.chain(())
    joints = tuple(joint.name for joint in chain.joints)
    truth = truth_of(chain, seed)
    motion = measured(
        shake(chain, truth, reference_of(chain, 2 * seed), DURATION), seed
    )
    unseen = shake(chain, truth, reference_of(chain, 2 * seed + 1), _UNSEEN)
    rows: list[tuple[float, ...]] = []
    for every in _EVERY:
        begin = time.perf_counter()
        found = identify_arm(
            recording_of(motion[::every], joints, every * PERIOD), robot
        )
        seconds = time.perf_counter() - begin
        errors = _errors(found, recording_of(unseen, joints))
        covered = float(np.mean(is_covered(found, truth)))
        rows.append((*errors, covered, seconds, float(_is_physical(found))))
    return rows


def _is_physical(found: Identified) -> bool:
    return all(
        np.linalg.eigvalsh(pseudo_inertia(body))[0] > 0.0 for body in found.parts.bodies
    )


def _errors(found: Identified, unseen: Recording) -> tuple[float, float]:
    rows = rows_of(unseen, found.parameters.model)
    rows = rows.with_sliding(found.distances)
    G = base_matrix(found.parameters, len(unseen.joints))
    u = rows.u(0.5 * PERIOD)  # torques are held for a period
    errors = []
    for values in (found.prior, found.values):
        loaded = rows.with_load((G @ values)[: found.parameters.model.p])
        left = loaded.matrix() @ (G @ values)[:-1] - u
        errors.append(100.0 * float(np.linalg.norm(left) / np.linalg.norm(u)))
    return errors[0], errors[1]


def _weighed(name: str, runs: int) -> tuple[str, ...]:
    """Return the row of an arm."""
    # (runs, readings, 8)
    loads = np.array([_weigh(name, seed) for seed in range(runs)])
    off = loads[:, :, 0] - (0.0, *(_LOAD,) * len(_AFTER))
    known = np.isfinite(off)
    cells = []
    for k, is_known in enumerate(known.T):
        errors = 1e3 * np.percentile(np.abs(off[is_known, k]), (50.0, 95.0, 100.0))
        unknown = f', {np.sum(~is_known)} unknown' if not is_known.all() else ''
        half = 1e3 * np.median(loads[is_known, k, 4])
        cells.append(
            f'{", ".join(f"{each:.0f}" for each in errors)} (± {half:.0f}{unknown})'
        )
    centre = loads[known[:, -1], -1, 1:4]
    interval = loads[known[:, -1], -1, 5:]
    middle = 1e3 * np.median(np.abs(centre))
    half = 1e3 * np.median(interval)
    cells.append(f'{middle:.1f} (± {half:.1f})')
    inside = np.abs(off[known]) < loads[:, :, 4][known], np.abs(centre) < interval
    return name, *cells, *(f'{100.0 * np.mean(part):.1f} %' for part in inside)


def _weigh(name: str, seed: int) -> Floats:
    """Return what is held (readings, 8) before the pick-up and after it."""
    random = np.random.default_rng(seed)
    begin = round(random.uniform(10.0, 14.0), 3)
    record = None
    while record is None:
        config = _random_loop(name, seed, begin, random)
        with suppress(MotionError):  # no approach keeps the limits: another motion
            record = simulate(config.controller, config.plant, supervised=False)
    load = sample_columns(record.samples, record.controller.settings).load
    times = np.array((begin, *(begin + t for t in _AFTER)))
    return np.asarray(load[np.round(times / config.controller.sample_time).astype(int)])


def _random_loop(
    name: str, seed: int, begin: float, random: np.random.Generator
) -> LoopConfig:
    preset = load_loop(name)
    friction = preset.plant.disturbance
    reference = preset.controller.reference
    n = len(preset.controller.joints)
    tones = len(reference.frequency)

    def varied(values: tuple[float, ...], least: float, most: float) -> list[float]:
        return [
            float(v)
            for v in np.array(values) * random.uniform(least, most, len(values))
        ]

    amplitude = np.array(reference.amplitude).reshape(n, tones)
    amplitude = np.array([random.permutation(row) for row in amplitude])
    plant: dict[str, Any] = {
        'duration': begin + _AFTER[-1] + 0.1,
        'seed': seed,
        'truth.seed': int(random.integers(100_000)),
        'truth.mass_deviation': 0.3,
        'truth.centre_deviation': 0.01,
        'truth.rotor_factor': float(random.uniform(0.5, 1.3)),
        'disturbance.viscous': varied(friction.viscous, 0.5, 1.5),
        'disturbance.coulomb': varied(friction.coulomb, 0.5, 1.5),
        'sensor.incomplete_states': 0,
        'events.begin': [begin],
        'events.duration': [60.0],
        'events.payload': [_LOAD],
    }
    if name == 'fr3':
        plant['drive.seed'] = int(random.integers(100_000))
    controller = {
        'reference.amplitude': varied(tuple(amplitude.ravel()), -1.0, 1.0),
        'reference.frequency': varied(reference.frequency, 0.6, 1.2),
        'reference.phase': random.uniform(0.0, 6.0, tones).tolist(),
    }
    return load_loop(name, {PLANT: plant, CONTROLLER: controller})
