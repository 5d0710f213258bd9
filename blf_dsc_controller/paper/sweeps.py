# SPDX-License-Identifier: Apache-2.0
"""The robustness study: one condition at a time, from easy to where the laws break."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from blf_dsc_controller.paper.cases import Case

DURATION = 30.0  # s
LAWS = {
    'recommended': 'recommended',
    'paper_tuned': 'proposed, tuned',
    'comparison': 'comparison, tuned',
    'slotine_li': 'Slotine-Li, tuned',
}

P = (1.0, 0.32, 0.4)  # kg m^2
START = (2.2935, 1.6961)  # rad, qr(0)
BOUND = 0.002  # rad

Changes = tuple[Mapping[str, object], Mapping[str, object]]


@dataclass(frozen=True)
class Sweep:
    """A condition, the values it takes, and what each changes of law and plant."""

    name: str
    label: str
    values: tuple[float, ...]
    changes: Callable[[float], Changes]
    logarithmic: bool = True
    laws: tuple[str, ...] = tuple(LAWS)

    def cases(self) -> list[Case]:
        """A case for every law and value, named by both."""
        found = []
        for law in self.laws:
            for value in self.values:
                of_law, of_plant = self.changes(value)
                name = case_name(self.name, law, value)
                found.append(Case(name, name, law, of_law, of_plant, DURATION))
        return found


def case_name(sweep: str, law: str, value: float) -> str:
    """Name of one run of a sweep."""
    return f'{sweep} {law} {value:g}'


def _differenced(**sensor: float) -> Changes:
    changes: dict[str, object] = {f'sensor.{name}': value for name, value in sensor.items()}
    return {}, {**changes, 'sensor.velocity': 'differenced'}


SWEEPS = (
    Sweep(
        'sample time',
        'sample time [ms]',
        (0.5, 1.0, 2.0, 3.0, 5.0, 7.0, 10.0),
        lambda value: ({'sample_time': value * 1e-3}, {'sample_time': value * 1e-3}),
    ),
    Sweep(
        'delay',
        'delay of the torque [samples]',
        (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0),
        lambda value: ({}, {'actuator.delay': int(value)}),
        logarithmic=False,
    ),
    Sweep(
        'encoder',
        'encoder [bits a turn]',
        (12.0, 13.0, 14.0, 15.0, 16.0, 18.0, 20.0),
        lambda value: _differenced(resolution=2.0 * math.pi / 2.0**value),
        logarithmic=False,
    ),
    Sweep(
        'noise',
        'noise of the positions [µrad]',
        (1.0, 3.0, 10.0, 30.0, 100.0, 300.0),
        lambda value: _differenced(position_noise=value * 1e-6),
    ),
    Sweep(
        'torque limit',
        'torque limit [N m]',
        (9.0, 9.5, 10.0, 10.5, 11.0, 12.0, 14.0, 20.0),
        lambda value: ({'torque.limit': [value, value]}, {}),
        logarithmic=False,
    ),
    Sweep(
        'initial error',
        'initial error [of the bound]',
        (0.0, 0.25, 0.5, 0.75, 0.9, 0.99),
        lambda value: ({}, {'initial.position': [start + value * BOUND for start in START]}),
        logarithmic=False,
    ),
    Sweep(
        'initial parameters',
        'initial estimate [of the truth]',
        (0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0),
        lambda value: ({'learning.initial_estimate': [value * each for each in P]}, {}),
        logarithmic=False,
    ),
    Sweep(
        'disturbance frequency',
        'frequency of the disturbance [rad/s]',
        (0.1, 0.3, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0, 100.0),
        lambda value: ({}, {'disturbance.frequency': [value, value]}),
    ),
    Sweep(
        'window',
        'excitation window [s]',
        (1.0, 2.0, 3.0, 4.0, 5.0, 2.0 * math.pi, 8.0, 10.0, 4.0 * math.pi),
        lambda value: ({'learning.window': value}, {}),
        logarithmic=False,
        laws=('recommended', 'paper_tuned'),
    ),
)
