# SPDX-License-Identifier: Apache-2.0
"""What random arms hold, weighed while they move: errors, and how often intervals are right.

    .venv/bin/python benchmark/weighing.py --runs 100

Each run has links up to 30 % heavier or lighter than the URDF's, centres of mass 1 cm off, drives
and friction of its own, and a random motion of three tones that does not repeat.  2 kg are picked
up after 10 to 14 s.  The drives of `fr3` compensate gravity and friction by a wrong model.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np

from blf_dsc_controller.configuration.nodes import (
    CONTROLLER,
    PLANT,
    LoopConfig,
    load_loop,
    locate,
)
from blf_dsc_controller.law.factory import begin, controller_of
from blf_dsc_controller.law.telemetry import columns_of
from blf_dsc_controller.reference.limits import MotionError
from blf_dsc_controller.run import Floats
from blf_dsc_controller.simulation.loop import simulate

_LOAD = 2.0  # kg
_AFTER = (1.0, 2.0, 3.0)  # s, from the pick-up to a reading


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--config', nargs='+', default=['panda', 'ur5e', 'fr3'])
    parser.add_argument('--runs', type=int, default=100)
    options = parser.parse_args()
    heads = ['arm', 'nothing held [g]', *(f'2 kg after {t:g} s [g]' for t in _AFTER)]
    heads += ['centre after 3 s [mm]', 'within 95 % intervals: mass', 'centre']
    heads += ['law [us]', 'weighing: of 100 samples 90, 9, 1 [us]']
    print(f'| {" | ".join(heads)} |')
    print('| --- ' * len(heads) + '|')
    for name in options.config:
        runs = [_weighed(name, seed) for seed in range(options.runs)]
        print(f'{_row(name, np.array(runs))} {_times(name)} |', flush=True)


def _row(name: str, loads: Floats) -> str:
    """Return the row of loads (runs, readings, 8): the first one without a load."""
    true = np.array((0.0, *(_LOAD,) * len(_AFTER)))
    off = loads[:, :, 0] - true
    known = np.isfinite(off)
    cells = []
    for k in range(true.size):
        errors = 1e3 * np.abs(off[known[:, k], k])
        unknown = f', {np.sum(~known[:, k])} unknown' if not known[:, k].all() else ''
        half = 1e3 * np.median(loads[known[:, k], k, 4])
        cells.append(
            f'{np.median(errors):.0f}, {np.percentile(errors, 95):.0f}, {errors.max():.0f} '
            f'(± {half:.0f}{unknown})'
        )
    centre = loads[:, -1, 1:4]
    found = np.isfinite(centre[:, 0])
    middle, half = (1e3 * np.median(np.abs(x)) for x in (centre[found], loads[found, -1, 5:]))
    cells.append(f'{middle:.1f} (± {half:.1f})')
    inside = np.abs(off[known]) < loads[:, :, 4][known]
    inside_centre = np.abs(centre[found]) < loads[found, -1, 5:]
    cells += [f'{100.0 * np.mean(part):.1f} %' for part in (inside, inside_centre)]
    return f'| {name} | {" | ".join(cells)} |'


def _weighed(name: str, seed: int) -> Floats:
    """Return what is held (readings, 8) before the pick-up and after it."""
    random = np.random.default_rng(seed)
    begin = round(random.uniform(10.0, 14.0), 3)
    while True:
        config = _random_loop(name, seed, begin, random)
        try:
            record = simulate(config.controller, config.plant, supervised=False)
        except MotionError:
            continue
        break
    load = columns_of(record.samples, record.controller.settings).load
    times = np.array((begin, *(begin + t for t in _AFTER)))
    return np.asarray(load[np.round(times / config.controller.sample_time).astype(int)])


def _times(name: str) -> str:
    """Return median times: the law; the weighing without a row, with one, and with a solution."""
    config = load_loop(locate(name), {PLANT: {'duration': 8.0}})
    record = simulate(config.controller, config.plant, supervised=False)
    controller, T = controller_of(config.controller), config.controller.sample_time
    n = controller.settings.n
    begin(controller, config.controller, *record.measurements[0, : 2 * n].reshape(2, n))
    times = np.zeros((len(record.stamps), 2))
    for k, measurement in enumerate(record.measurements):
        before = time.perf_counter()
        controller.update(k * T, T, measurement)
        between = time.perf_counter()
        controller.weigh(T)
        times[k] = between - before, time.perf_counter() - between
    law, weighing = 1e6 * times.T
    each = ', '.join(f'{value:.1f}' for value in np.percentile(weighing, (50.0, 95.0, 99.5)))
    return f'{np.median(law):.1f} | {each}'


def _random_loop(name: str, seed: int, begin: float, random: np.random.Generator) -> LoopConfig:
    preset = load_loop(locate(name), {})
    friction, reference = preset.plant.disturbance, preset.controller.reference
    n = len(preset.controller.joints)
    tones = len(reference.frequency)

    def varied(values: tuple[float, ...], least: float, most: float) -> list[float]:
        return [float(v) for v in np.array(values) * random.uniform(least, most, len(values))]

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
    return load_loop(locate(name), {PLANT: plant, CONTROLLER: controller})


if __name__ == '__main__':
    main()
