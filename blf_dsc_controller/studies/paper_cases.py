# SPDX-License-Identifier: Apache-2.0
"""The paper's cases: laws side by side, variations for claims, sweeps, and all of their runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from tqdm.contrib.concurrent import process_map

from blf_dsc_controller.analysis.metrics import Metrics, measure
from blf_dsc_controller.configuration.nodes import LoopConfig, load_loop
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.run import Run
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.studies.runs import cores

DURATION = 60.0  # s
SWEEP_DURATION = 30.0  # s

SIDE_BY_SIDE = {
    'paper': "proposed, the paper's choices",
    'paper_tuned': 'proposed, tuned',
    'comparison': 'comparison, tuned',
    'comparison_detuned': 'comparison, low gains',
    'slotine_li': 'Slotine-Li, tuned',
    'recommended': 'recommended',
    'two_tone': 'two tones, columns',
    'model_based': 'all known (16)',
}
"""Labels of the laws that are compared, by their presets."""

SWEPT = ('recommended', 'paper_tuned', 'comparison', 'slotine_li')

P = (1.0, 0.32, 0.4)  # kg m^2
START = (2.2935, 1.6961)  # rad, qr(0)
BOUND = 0.002  # rad

Changes = Mapping[str, object]


class Case(NamedTuple):
    """A preset with changes to the law and to the plant."""

    preset: str
    law: Mapping[str, object] = {}
    plant: Mapping[str, object] = {}
    duration: float = DURATION

    def loop(self) -> LoopConfig:
        """Return the configuration of the case."""
        loop, plant = load_loop(self.preset), {'duration': self.duration, **self.plant}
        return loop._replace(
            controller=change(loop.controller, self.law), plant=change(loop.plant, plant)
        )


_QUIET = {'disturbance.constant': [0.0, 0.0], 'disturbance.amplitude': [0.0, 0.0]}
_PUSHED = {'disturbance.constant': [8.0, 0.1]}  # 8 N m against joint 1
_AT_REST = {'reference.amplitude': [0.0, 0.0], 'reference.offset': list(START)}
_LEAKY = {  # in the paper's form, eta = 0.02
    'disturbance.leakage': 0.02,
    'learning.compensation': 'state',
    'learning.bumpless': False,
    'truth.parameters': list(P),
    'truth.constant': [0.1, 0.1],
}


class Sweep(NamedTuple):
    """A condition with its unit, its values, and the changes of law and plant for each value."""

    label: str
    values: tuple[float, ...]
    changes: Callable[[float], tuple[Changes, Changes]]
    laws: tuple[str, ...] = SWEPT

    @property
    def name(self) -> str:
        """Name of the condition."""
        return self.label.partition(' [')[0]


def case_name(sweep: str, law: str, value: float) -> str:
    """Return the name of one run of a sweep."""
    return f'{sweep} {law} {value:g}'


def _differenced(name: str, value: float) -> tuple[Changes, Changes]:
    return {}, {f'sensor.{name}': value, 'sensor.velocity': 'differenced'}


SWEEPS = (
    Sweep(
        'sample time [ms]',
        (0.5, 1.0, 2.0, 3.0, 5.0, 7.0, 10.0),
        lambda value: ({'sample_time': value * 1e-3}, {'sample_time': value * 1e-3}),
    ),
    Sweep(
        'delay [samples]',
        (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0),
        lambda value: ({}, {'actuator.delay': int(value)}),
    ),
    Sweep(
        'encoder [bits a turn]',
        (12.0, 13.0, 14.0, 15.0, 16.0, 18.0, 20.0),
        lambda value: _differenced('resolution', 2.0 * math.pi / 2.0**value),
    ),
    Sweep(
        'noise [µrad]',
        (1.0, 3.0, 10.0, 30.0, 100.0, 300.0),
        lambda value: _differenced('position_noise', value * 1e-6),
    ),
    Sweep(
        'torque limit [N m]',
        (9.0, 9.5, 10.0, 10.5, 11.0, 12.0, 14.0, 20.0),
        lambda value: ({'torque.limit': [value, value]}, {}),
    ),
    Sweep(
        'initial error [of the bound]',
        (0.0, 0.25, 0.5, 0.75, 0.9, 0.99),
        lambda value: ({}, {'initial.position': [start + value * BOUND for start in START]}),
    ),
    Sweep(
        'initial parameters [of the truth]',
        (0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0),
        lambda value: ({'learning.initial_estimate': [value * each for each in P]}, {}),
    ),
    Sweep(
        'disturbance frequency [rad/s]',
        (0.1, 0.3, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0, 100.0),
        lambda value: ({}, {'disturbance.frequency': [value, value]}),
    ),
    Sweep(
        'window [s]',
        (1.0, 2.0, 3.0, 4.0, 5.0, 2.0 * math.pi, 8.0, 10.0, 4.0 * math.pi),
        lambda value: ({'learning.window': value}, {}),
        ('recommended', 'paper_tuned'),
    ),
)

CASES = {
    **{preset: Case(preset) for preset in SIDE_BY_SIDE},
    'paper_quiet': Case('paper', plant=_QUIET),
    'paper_at_rest': Case('paper', _AT_REST),
    'paper_from_zero': Case('paper', {'learning.initial_estimate': [0.0] * 3}),
    'leaky': Case('recommended', {**_LEAKY, 'truth.amplitude': [0.1, 0.1]}),
    'leaky_constant': Case('recommended', _LEAKY, {'disturbance.amplitude': [0.0, 0.0]}),
    'paper_pushed': Case('paper', plant=_PUSHED),
    'recommended_pushed': Case('recommended', plant=_PUSHED),
    **{
        case_name(sweep.name, law, value): Case(law, *sweep.changes(value), SWEEP_DURATION)
        for sweep in SWEEPS
        for law in sweep.laws
        for value in sweep.values
    },
}
"""Every run, by name."""


class Results(NamedTuple):
    """Results by name of the case; the runs of sweeps are not kept."""

    metrics: dict[str, Metrics]
    runs: dict[str, Run]

    def held(self, sweep: str, law: str) -> list[float]:
        """Return the values of a sweep at which the law keeps its bound."""
        (values,) = (each.values for each in SWEEPS if each.name == sweep)
        return [value for value in values if self.metrics[case_name(sweep, law, value)].held]

    def ratios(self, *names: str) -> list[float]:
        """Return the largest |xi1| / k_c of each case."""
        return [self.metrics[name].max_error_ratio for name in names]

    def parameter_errors(self, *names: str) -> list[float]:
        """Return the relative parameter error of each case after 60 s."""
        return [self.metrics[name].parameter_error[60] for name in names]


def run_case(case: Case) -> tuple[Metrics, Run | None]:
    """Simulate a case; return its metrics and, unless it belongs to a sweep, the run."""
    loop = case.loop()
    with np.errstate(all='ignore'):  # a run that diverges has metrics too
        run = simulate(loop.controller, loop.plant, supervised=False).run()
        return measure(run), run if case.duration == DURATION else None


def run_all() -> Results:
    """Simulate every case on all cores."""
    run_case(CASES['paper']._replace(duration=1.0))  # compiles what the workers load
    cases = CASES.values()
    found = process_map(run_case, cases, max_workers=cores(), chunksize=1, desc='runs', unit='run')
    named = dict(zip(CASES, found, strict=True))
    return Results(
        {name: metrics for name, (metrics, _) in named.items()},
        {name: run for name, (_, run) in named.items() if run is not None},
    )
