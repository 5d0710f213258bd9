# SPDX-License-Identifier: Apache-2.0
"""How the controller learns the parameters of the arm: equations (20) to (27) of the paper."""

from __future__ import annotations

import math
from dataclasses import dataclass

from blf_dsc_controller.configuration.schema import parameter

_SIZES = 'it sizes the memory of the learning, which is laid out at the start'
_FILTERED = 'what is already in the excitation window was filtered with it'
_MEASURED = 'what is already in the excitation window was measured with it'
_FIRST = 'it only matters at the start'
_PER_PARAMETER = ('learning.initial_estimate',)

FEWEST_SAMPLES = 10
"""In an excitation window: fewer cannot tell the parameters of an arm apart."""

MOST_SAMPLES = 1_000_000
"""In an excitation window: each holds a few hundred bytes, so this is some hundred megabytes."""


@dataclass(frozen=True)
class Learning:
    """Composite learning of the parameters P and of a constant disturbance of each joint."""

    initial_estimate: tuple[float, ...] = parameter(
        (0.5, 0.16, 0.2),
        'first estimate of the parameters (m1+m2)*l1^2, m2*l2^2, m2*l1*l2',
        unit='kg m^2',
        symbol='P^(0)',
        read_only=_FIRST,
    )
    adaptation_gain: tuple[float, ...] = parameter(
        (0.5, 0.5, 0.5),
        'diagonal of the adaptation gain',
        symbol='Gamma',
        at_least=0.0,
        length=_PER_PARAMETER,
    )
    weight: float = parameter(
        100.0,
        'weight of the prediction error against the tracking error; 0: no composite learning',
        symbol='kappa',
        at_least=0.0,
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
        read_only=_FILTERED,
    )
    latch: str = parameter(
        'last',
        'window learned from: the last excited one (paper), or the best excited one',
        choices=('last', 'max'),
    )
    regularization: float = parameter(
        1e-5,
        'added to the excitation matrix before the Newton step divides by it',
        symbol='rho',
        above=0.0,
    )
    excitation_threshold: float = parameter(
        0.003,
        'least eigenvalue of the excitation matrix from which on it is learned from',
        symbol='sigma',
        above=0.0,
    )
    window: float = parameter(
        2.0 * math.pi,
        'excitation window; a whole number of periods of the reference averages disturbances out',
        unit='s',
        symbol='tau_d',
        above=0.0,
        read_only=_SIZES,
    )
    settling_time: float = parameter(
        0.5,
        'time left to the filters before the window counts',
        unit='s',
        symbol='T_a',
        at_least=0.0,
        read_only=_FIRST,
    )
    filter_pole: float = parameter(
        10.0,
        'pole of both filters that the regressor and the torque pass through',
        unit='rad/s',
        above=0.0,
        read_only=_FILTERED,
    )
    bias: bool = parameter(
        True,
        'also estimate a constant disturbance of each joint',
        read_only=_SIZES,
    )
    viscous: bool = parameter(
        False,
        'also estimate the viscous friction of each joint',
        read_only=_SIZES,
    )
    coulomb: bool = parameter(
        False,
        'also estimate the Coulomb friction of each joint',
        read_only=_SIZES,
    )
    coulomb_velocity: float = parameter(
        0.01,
        'velocity scale over which the Coulomb column changes sign',
        unit='rad/s',
        above=0.0,
        read_only=_MEASURED,
    )
    frequencies: tuple[float, ...] = parameter(
        (),
        'also estimate a sinusoidal disturbance of each of these frequencies on each joint',
        unit='rad/s',
        above=0.0,
        may_be_empty=True,
        read_only=_SIZES,
    )
    derivative_filter: float = parameter(
        100.0,
        'frequency of the filter (8) behind the predictions lambda and acceleration',
        unit='rad/s',
        symbol='omega',
        above=0.0,
        read_only=_FILTERED,
    )
    radius: float = parameter(
        3.0,
        'radius of the ball that the estimate is kept in',
        unit='kg m^2',
        symbol='omega_a',
        above=0.0,
    )
    interval: int = parameter(
        10,
        'samples from one look at the eigenvalues of the excitation matrix to the next',
        unit='samples',
        at_least=1,
        read_only=_SIZES,
    )
    torque_source: str = parameter(
        'command',
        'torque learned from: the limited command, or the effort reported with the joint states',
        choices=('command', 'effort'),
        read_only=_MEASURED,
    )

    def window_problems(self, sample_time: float) -> list[str]:
        """Whether the window holds a sensible number of samples."""
        samples = round(self.window / sample_time)
        if FEWEST_SAMPLES <= samples <= MOST_SAMPLES:
            return []
        problem = (
            f'learning.window: got {self.window:g} s, which is {samples} samples of '
            f'{sample_time:g} s: between {FEWEST_SAMPLES} and {MOST_SAMPLES} are allowed'
        )
        return [problem]

    def estimate_problems(self, model: str, count: int) -> list[str]:
        """Whether the first estimate fits the model and lies in the ball."""
        given = len(self.initial_estimate)
        problems = []
        if given != count:
            problems.append(
                f'learning.initial_estimate: got {given} '
                f'{"entry" if given == 1 else "entries"}, but model {model} has {count} parameters'
            )
        norm = math.hypot(*self.initial_estimate)
        if norm >= self.radius:
            problems.append(
                f'learning.radius: got {self.radius:g} kg m^2, but learning.initial_estimate lies '
                f'at {norm:.6g} kg m^2: the radius must be larger'
            )
        return problems
