# SPDX-License-Identifier: Apache-2.0
"""Composite learning of the parameters of the arm: equations (20) to (27) of the paper."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from blf_dsc_controller.configuration.schema import counted, non_negative, parameter, positive

_SIZES = 'it sizes the memory of the learning'
_WINDOW = 'the data in the excitation window depend on it'
_FIRST = 'it has no effect later'

FEWEST_SAMPLES = 10
"""In an excitation window: fewer do not determine the parameters of an arm."""

MOST_SAMPLES = 1_000_000
"""In an excitation window: each takes a few hundred bytes, so this is some hundred megabytes."""


@dataclass(frozen=True)
class Learning:
    """Composite learning of the parameters P and of the disturbance columns."""

    initial_estimate: tuple[float, ...] = parameter(
        (0.5, 0.16, 0.2),
        'initial estimate of the parameters (m1+m2)*l1^2, m2*l2^2, m2*l1*l2',
        'kg m^2',
        'P^(0)',
        read_only=_FIRST,
    )
    adaptation_gain: Annotated[tuple[float, ...], 'learning.initial_estimate'] = non_negative(
        (0.5, 0.5, 0.5), 'diagonal of the adaptation gain', symbol='Gamma'
    )
    weight: float = non_negative(
        100.0,
        'weight of the prediction error against the tracking error; 0: no composite learning',
        symbol='kappa',
    )
    update: str = parameter(
        'newton',
        'direction of the prediction-error step: regularised Newton, or the gradient (paper)',
        choices=('newton', 'gradient'),
    )
    prediction: str = parameter(
        'filtered',
        'prediction error: filtered regressor, Lambda of (24), or estimated acceleration',
        choices=('filtered', 'acceleration', 'lambda'),
        read_only=_WINDOW,
    )
    latch: str = parameter(
        'last',
        'which excited window is latched: the last one (paper), or the best one',
        choices=('last', 'max'),
    )
    regularization: float = positive(
        1e-5, 'regularisation of the excitation matrix in the Newton step', symbol='rho'
    )
    excitation_threshold: float = positive(
        0.003,
        'minimum eigenvalue of the excitation matrix from which the window counts as excited',
        symbol='sigma',
    )
    window: float = positive(
        2.0 * math.pi,
        'length of the excitation window; whole periods of the reference average disturbances out',
        's',
        'tau_d',
        read_only=_SIZES,
    )
    settling_time: float = non_negative(
        0.5,
        'time for the filters to settle before the window is used',
        's',
        'T_a',
        read_only=_FIRST,
    )
    filter_pole: float = positive(
        10.0, 'pole of the filters on regressor and torque', 'rad/s', read_only=_WINDOW
    )
    bias: bool = parameter(
        True, 'also estimate a constant disturbance of each joint', read_only=_SIZES
    )
    viscous: bool = parameter(
        False, 'also estimate the viscous friction of each joint', read_only=_SIZES
    )
    coulomb: bool = parameter(
        False, 'also estimate the Coulomb friction of each joint', read_only=_SIZES
    )
    coulomb_velocity: float = positive(
        0.01, 'velocity scale of the sign change of the Coulomb column', 'rad/s', read_only=_WINDOW
    )
    frequencies: tuple[float, ...] = positive(
        (),
        'also estimate a sinusoidal disturbance of each joint at each of these frequencies',
        'rad/s',
        may_be_empty=True,
        read_only=_SIZES,
    )
    derivative_filter: float = positive(
        100.0,
        'frequency of the filter (8), for the predictions lambda and acceleration',
        'rad/s',
        'omega',
        read_only=_WINDOW,
    )
    radius: float = positive(
        3.0, 'radius of the projection ball of the estimate', 'kg m^2', 'omega_a'
    )
    interval: int = parameter(
        10,
        'samples between two eigenvalue checks of the excitation matrix',
        'samples',
        at_least=1,
        read_only=_SIZES,
    )
    torque_source: str = parameter(
        'command',
        'torque used for learning: the limited command, or the effort of the joint states',
        choices=('command', 'effort'),
        read_only=_WINDOW,
    )

    def problems(self, sample_time: float, model: str, count: int) -> list[str]:
        """Check the size of the window, and the initial estimate against the model and the ball."""
        problems = []
        samples = round(self.window / sample_time)
        if not FEWEST_SAMPLES <= samples <= MOST_SAMPLES:
            problems.append(
                f'learning.window: got {self.window:g} s, which is {samples} samples of '
                f'{sample_time:g} s: between {FEWEST_SAMPLES} and {MOST_SAMPLES} are allowed'
            )
        if len(self.initial_estimate) != count:
            entries = counted(len(self.initial_estimate), 'entry', 'entries')
            problems.append(
                f'learning.initial_estimate: got {entries}, but model {model} has {count} '
                'parameters'
            )
        norm = math.hypot(*self.initial_estimate)
        if norm >= self.radius:
            problems.append(
                f'learning.radius: got {self.radius:g} kg m^2, but learning.initial_estimate lies '
                f'at {norm:.6g} kg m^2: the radius must be larger'
            )
        return problems
