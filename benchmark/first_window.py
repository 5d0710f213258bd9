# SPDX-License-Identifier: Apache-2.0
"""Changes of the arm while the window is not full: figures of STUDIES.md.

    python -m benchmark first-window

Cycles      1.5 kg in the hand for half of each cycle, from the first one on.
Weighing    What the arm says it holds, in these cycles.
Pick-ups    Random arms and friction, with one load that stays.
Sine        A disturbance that lasts, far above the unmodelled torque.
No change   The largest mean of e^T C^-1 e / n over 0.1 s, until the first window is full.

The error of the model is that of its torques along the motion, at the end of a run.
Without `learning.change_detection` windows may be mixtures of two arms.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from benchmark.harness import print_table
from blf_dsc_controller.analysis.metrics import Metrics, measure
from blf_dsc_controller.configuration.nodes import (
    CONTROLLER,
    PLANT,
    LoopConfig,
    load_loop,
)
from blf_dsc_controller.factory.controller import begin, controller_of
from blf_dsc_controller.law.samples import sample_columns
from blf_dsc_controller.law.weighing import DEVIATION, MASS
from blf_dsc_controller.run import Floats
from blf_dsc_controller.simulation.loop import Record, simulate
from sim_plant.plant import plant_of

ARMS = {'Panda': 'panda_rigid', 'UR5e': 'ur5e_rigid'}
DURATION = 30.0  # s

PERIODS = (3.0, 5.0, 6.0)  # s, of a cycle
FIRST = 1.0  # s, of the first pick-up
CARRIED = 1.5  # kg
LAWS: dict[str, dict[str, Any]] = {
    'detected': {},
    'not detected': {'learning.change_detection': False},
    'no learning': {'learning.weight': 0.0},
}
WEIGHED_IN = 6.0  # s, a cycle of which loads are shown
READINGS = ((0, 1.5), (1, 2.0))
"""Pick-up by number, and seconds after it."""

LOADS = (0.7, 1.5)  # kg, one of them in a run
RUNS = 15  # of each arm with each load
PICK_UP, END = 3.0, 12.0  # s
FRICTION = (0.2, 2.0)  # times the assumed one
SEEN = 1.0  # s after a pick-up; what is found later is a false detection

SINE = (3.0, 3.0)  # N m, rad/s
SHAKEN = {'every joint': slice(None), 'the first joint': slice(1)}
FILLS = 7.0  # s, in which the first window is full


class Cycle(NamedTuple):
    """Loads in the hand, for half of each cycle."""

    period: float  # s

    def pick_ups(self) -> Floats:
        """Return the times of the pick-ups [s]."""
        return np.arange(FIRST, DURATION, self.period)

    def changes(self) -> int:
        """Return how often the arm changes before the end of a run."""
        put_downs = self.pick_ups() + 0.5 * self.period
        return self.pick_ups().size + int(np.sum(put_downs < DURATION))

    def events(self) -> dict[str, list[float]]:
        """Return the parameters of the plant."""
        return carried(self.pick_ups().tolist(), 0.5 * self.period, CARRIED)


def carried(begin: list[float], seconds: float, mass: float) -> dict[str, list[float]]:
    """Return parameters of a plant whose tip holds a mass [kg] from each of these times on."""
    return {
        'events.begin': begin,
        'events.duration': [seconds] * len(begin),
        'events.payload': [mass] * len(begin),
    }


NOTHING = carried([], 0.0, 0.0)


def loop_of(
    preset: str,
    plant: Mapping[str, Any],
    controller: Mapping[str, Any] | None = None,
    duration: float = DURATION,
) -> LoopConfig:
    """Return a preset with changes to its plant and its controller."""
    changes = {PLANT: {'duration': duration, **plant}, CONTROLLER: controller or {}}
    return load_loop(preset, changes)


def recorded(loop: LoopConfig) -> Record:
    """Run a loop."""
    return simulate(loop.controller, loop.plant)


def measured(loop: LoopConfig) -> Metrics:
    """Return the metrics of a run."""
    return measure(recorded(loop).run())


def percent(part: float) -> str:
    """Return a fraction in %, with two digits."""
    return f'{100.0 * part:.2g} %'


def milliradians(of: Metrics) -> str:
    """Return the rms error of all joints [mrad]."""
    return f'{1e3 * np.sqrt(np.mean(np.square(of.rms_error))):.2f}'


def joined(values: Iterable[str]) -> str:
    """Return several values as one cell."""
    return '; '.join(values)


def cycle_row(name: str) -> list[str]:
    """Return changes, errors of the model and rms errors of an arm, a value for each cycle."""
    cycles = [Cycle(period) for period in PERIODS]
    found = {
        law: [measured(loop_of(ARMS[name], each.events(), given)) for each in cycles]
        for law, given in LAWS.items()
    }
    pairs = zip(found['detected'], cycles, strict=True)
    changes = (f'{len(each.model_changes)} of {c.changes()}' for each, c in pairs)
    models = [
        joined(percent(each.parameter_error.end) for each in found[law])
        for law in ('detected', 'not detected')
    ]
    errors = [
        joined(milliradians(each) for each in of_law) for of_law in found.values()
    ]
    return [name, joined(changes), *models, *errors]


def weighed_row(name: str) -> list[str]:
    """Return what an arm says it holds, some time after the pick-ups of the cycles."""
    cycle = Cycle(WEIGHED_IN)
    record = recorded(loop_of(ARMS[name], cycle.events()))
    loads = sample_columns(record.samples, record.controller.settings).load
    cells = [name]
    for number, after in READINGS:
        at = round((cycle.pick_ups()[number] + after) / record.config.sample_time)
        mass, half = loads[at, [MASS, DEVIATION]]
        cells.append(f'{mass:.2f} ± {half:.2g} kg')
    return cells


def random_plant(preset: str, seed: int, mass: float) -> dict[str, Any]:
    """Return parameters of an arm of its own, with friction of its own and one pick-up."""
    friction = load_loop(preset).plant.disturbance
    random = np.random.default_rng(seed)

    def varied(values: tuple[float, ...]) -> list[float]:
        factors = random.uniform(*FRICTION, len(values)).tolist()
        return [a * b for a, b in zip(factors, values, strict=True)]

    return {
        'seed': seed,
        'truth.seed': 1000 + seed,
        'disturbance.viscous': varied(friction.viscous),
        'disturbance.coulomb': varied(friction.coulomb),
        **carried([PICK_UP], END, mass),
    }


def pick_up_row(name: str, mass: float) -> list[str]:
    """Return how soon a pick-up is found in random runs, and what else is."""
    delays = []
    false = missed = 0
    for seed in range(RUNS):
        plant = random_plant(ARMS[name], seed, mass)
        changes = np.array(
            measured(loop_of(ARMS[name], plant, duration=END)).model_changes
        )
        is_found = (changes >= PICK_UP) & (changes < PICK_UP + SEEN)
        delays += (changes[is_found][:1] - PICK_UP).tolist()
        missed += not is_found.any()
        false += changes.size - min(1, int(is_found.sum()))
    times = f'{min(delays):.2f} to {max(delays):.2f} s' if delays else '-'
    return [name, f'{mass:g} kg', f'{RUNS}', times, f'{missed}', f'{false}']


def sine_row(name: str, shaken: str) -> list[str]:
    """Return how often a sine restarts the window, and the errors."""
    amplitude, frequency = SINE
    n = len(load_loop(ARMS[name]).controller.joints)
    amplitudes = np.zeros(n)
    amplitudes[SHAKEN[shaken]] = amplitude
    sine = {
        'disturbance.amplitude': amplitudes.tolist(),
        'disturbance.frequency': [frequency] * n,
    }
    learning, without = (
        measured(loop_of(ARMS[name], NOTHING | sine, LAWS[law]))
        for law in ('detected', 'no learning')
    )
    return [
        name,
        shaken,
        f'{len(learning.model_changes)}',
        percent(learning.parameter_error.end),
        milliradians(learning),
        milliradians(without),
    ]


def calm_row(name: str) -> list[str]:
    """Return the largest mean of e^T C^-1 e / n over s^2 of arms that do not change."""
    largest = 0.0
    for seed in range(RUNS):
        plant = random_plant(ARMS[name], seed, 0.0) | NOTHING
        loop = loop_of(ARMS[name], plant, duration=FILLS)
        largest = max(largest, largest_square(loop))
    return [name, f'{RUNS}', f'{largest:.1f}']


def largest_square(loop: LoopConfig) -> float:
    """Return the largest mean of e^T C^-1 e / n over 0.1 s in a run, in s^2."""
    config = loop.controller
    T = config.sample_time
    plant, controller = plant_of(loop.plant), controller_of(config)
    begin(controller, config, *plant.measure().reshape(3, -1)[:2])
    statistics = controller.state.change.innovation
    largest = 0.0
    for k in range(round(loop.plant.duration / T)):
        torque = controller.update(k * T, T, plant.measure())
        if statistics.noise[0] > 0.0:
            largest = max(largest, statistics.recent[0] / statistics.noise[0])
        plant.step(torque)
    return largest


def tables() -> Iterator[tuple[list[str], Iterator[list[str]]]]:
    """Yield heads and rows of each table."""
    cycles = '; '.join(f'{period:g}' for period in PERIODS)
    yield (
        [
            f'arm, cycles of {cycles} s',
            'changes found',
            'error of the model',
            'not detected',
            *(f'rms [mrad]: {law}' for law in LAWS),
        ],
        (cycle_row(name) for name in ARMS),
    )
    yield (
        ['arm', *(f'{after:g} s after pick-up {k + 1}' for k, after in READINGS)],
        (weighed_row(name) for name in ARMS),
    )
    yield (
        ['arm', 'load', 'runs', 'found after', 'missed', 'false detections'],
        (pick_up_row(name, mass) for name in ARMS for mass in LOADS),
    )
    yield (
        [
            f'arm, {SINE[0]:g} N m at {SINE[1]:g} rad/s',
            'on',
            'restarts',
            'error of the model',
            'rms [mrad]',
            'no learning',
        ],
        (sine_row(name, shaken) for name in ARMS for shaken in SHAKEN),
    )
    yield (
        ['arm', 'runs', 'largest mean, in s^2'],
        (calm_row(name) for name in ARMS),
    )


def main(_options: argparse.Namespace) -> None:
    """Print the tables."""
    for heads, rows in tables():
        print_table(heads, rows)
        print()
