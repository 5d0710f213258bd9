# SPDX-License-Identifier: Apache-2.0
"""Tuning of the laws of two links, all by the same procedure, objective and budget.

    python -m benchmark tuning proposed      # the gains of config/paper_tuned.yaml
    python -m benchmark tuning comparison    # of config/comparison.yaml
    python -m benchmark tuning slotine_li    # of config/slotine_li.yaml

Common to all: the arm, its disturbance, reference, start, P^(0), sample time and torque
limit; two runs of 30 s, with ideal and with realistic sensors (preset noisy); the
objective; the number of gains (slotine_li has fewer) and the ranges of shared ones; the
optimiser, its seed and budget.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

from blf_dsc_controller.analysis.metrics import Metrics, measure
from blf_dsc_controller.configuration.nodes import PLANT, LoopConfig, load_loop
from blf_dsc_controller.configuration.schema import Value, change, format_value
from blf_dsc_controller.run import Floats
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.studies.tuning import (
    HOPELESS,
    Gain,
    bounded,
    parameters_at,
    search,
    value_at,
)

POPULATION = 96
GENERATIONS = 12
DURATION = 30.0  # s
ROUGHEST = 2.0  # N m, largest acceptable rms change of a torque from sample to sample

PLANTS = ('recommended', 'noisy')
"""Presets whose plants a law is tuned on."""


class Task(NamedTuple):
    """A law to tune: its preset, fixed parameters and tuned gains."""

    preset: str
    fixed: Mapping[str, Value]
    gains: tuple[Gain, ...]


_SHARED = (
    Gain('two_link.feedback_gain', 5.0, 200.0, joint=0),
    Gain('two_link.feedback_gain', 2.0, 100.0, joint=1),
    Gain('two_link.adaptation_gain', 0.01, 30.0),
)
_SURFACE_OF_35 = Gain('gains.surface_gain', 10.0, 300.0)
_PROPOSED = (
    *_SHARED,
    Gain('two_link.surface_gain', 10.0, 600.0),
    Gain('two_link.mu', 1.0, 100.0),
    Gain('disturbance.gain', 0.1, 300.0),
    Gain('two_link.learning_weight', 0.1, 100.0),
)
_COMPARISON = (
    *_SHARED,
    _SURFACE_OF_35,
    Gain('gains.position_gain', 0.1, 1e4),
    Gain('gains.robust_gain', 1e-3, 5.0),
    Gain('gains.leakage', 1e-5, 1.0),
)
_NONE = {'disturbance.gain': (0.0, 0.0)}
TASKS = {
    'proposed': Task('paper', {}, _PROPOSED),
    'comparison': Task('recommended', {'law': 'backstepping', **_NONE}, _COMPARISON),
    'slotine_li': Task(
        'recommended', {'law': 'slotine_li', **_NONE}, (*_SHARED, _SURFACE_OF_35)
    ),
}


def cost_of(metrics: Metrics, sample_time: float) -> float:
    """Return the cost of one run in decades of largest, rms and parameter error.

    Each decade beyond the bound, and each of torque rougher than `ROUGHEST`, costs ten
    more.
    """
    largest = np.log10(metrics.max_error_ratio)
    typical = np.log10(np.linalg.norm(metrics.rms_error))
    learned = np.log10(metrics.parameter_error.tail + 1e-12)
    rough = np.log10(max(metrics.torque_rate) * sample_time / ROUGHEST)
    value = largest + typical + learned + 10.0 * (max(largest, 0.0) + max(rough, 0.0))
    return float(value) if np.isfinite(value) else HOPELESS


def objective(exponents: Floats, task: Task, loops: Sequence[LoopConfig]) -> float:
    """Return the mean of `cost_of` over the plants."""
    values = []
    for loop in loops:
        gains = parameters_at(loop.controller, task.gains, map(value_at, exponents))
        config = change(loop.controller, gains)
        with np.errstate(all='ignore'):
            metrics = measure(simulate(config, loop.plant, supervised=False).run())
            values.append(cost_of(metrics, config.sample_time))
    return bounded(float(np.mean(values)))


def loops_of(task: Task) -> list[LoopConfig]:
    """Return loops of the task's controller with each plant, for the tuning."""
    law = change(load_loop(task.preset).controller, task.fixed)
    loops = (load_loop(name, {PLANT: {'duration': DURATION}}) for name in PLANTS)
    return [loop._replace(controller=law) for loop in loops]


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument('law', choices=TASKS)


def main(options: argparse.Namespace) -> None:
    """Tune a law and print its gains, as they stand in its preset."""
    task = TASKS[options.law]
    loops = loops_of(task)
    with tqdm(total=POPULATION * (GENERATIONS + 1), desc='tuning', unit='run') as bar:

        def cost(exponents: Floats) -> float:
            bar.update()
            return objective(exponents, task, loops)

        found = search(cost, task.gains, POPULATION, GENERATIONS)
    print(
        f'# {found.nfev} evaluations, objective {found.fun:.3f} (decades of error; less is better)'
    )
    gains = map(value_at, found.x)
    for name, entry in parameters_at(loops[0].controller, task.gains, gains).items():
        print(f'{name}: {format_value(entry)}')
