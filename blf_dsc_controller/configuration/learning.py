# SPDX-License-Identifier: Apache-2.0
"""Composite learning of the parameters of the arm: equations (20) to (27) of the paper."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Literal

from blf_dsc_controller.configuration.common import PerJoint
from blf_dsc_controller.configuration.schema import counted, non_negative, parameter, positive

_size = partial(parameter, read_only='it sets the memory size of the learning')
_in_window = partial(parameter, read_only='the data in the excitation window depend on it')
_at_start = partial(parameter, read_only='it has no effect later')

_SAMPLES = (10, 1_000_000)  # per window: fewer do not determine P, more need over 100 MB


@dataclass(frozen=True)
class Learning:
    """Composite learning of the parameters P and of the disturbance columns."""

    initial_estimate: tuple[float, ...] = _at_start(
        (0.5, 0.16, 0.2), 'initial estimate of (m1+m2)*l1^2, m2*l2^2, m2*l1*l2', 'kg m^2', 'P^(0)'
    )
    adaptation_gain: Annotated[tuple[float, ...], 'learning.initial_estimate'] = non_negative(
        (0.5, 0.5, 0.5), 'diagonal of the adaptation gain', symbol='Gamma'
    )
    weight: float = non_negative(
        100.0, 'weight of the prediction error; 0: no composite learning', symbol='kappa'
    )
    update: Literal['newton', 'gradient'] = parameter(
        'newton', 'step along the prediction error: regularised Newton, or the gradient (paper)'
    )
    prediction: Literal['filtered', 'acceleration', 'lambda'] = _in_window(
        'filtered', 'prediction error by filtered regressor, estimated acceleration or Lambda (24)'
    )
    latch: Literal['last', 'max'] = parameter(
        'last', 'excited window that is latched: the last one (paper), or the best one'
    )
    regularization: float = positive(
        1e-5, 'regularisation of the excitation matrix in the Newton step', symbol='rho'
    )
    excitation_threshold: float = positive(
        0.003, 'minimum eigenvalue of the excitation matrix of an excited window', symbol='sigma'
    )
    window: float = _size(
        2.0 * math.pi,
        'length of the excitation window; whole reference periods average out disturbances',
        's',
        'tau_d',
        above=0.0,
    )
    settling_time: float = _at_start(
        0.5, 'time for the filters to settle before the window is used', 's', 'T_a', at_least=0.0
    )
    filter_pole: float = _in_window(
        10.0, 'pole of the filters on regressor and torque', 'rad/s', above=0.0
    )
    bias: bool = _size(True, 'also estimate a constant disturbance of each joint')
    viscous: bool = _size(False, 'also estimate the viscous friction of each joint')
    coulomb: bool = _size(False, 'also estimate the Coulomb friction of each joint')
    coulomb_velocity: float = _in_window(
        0.01, 'velocity scale of the sign change of the Coulomb column', 'rad/s', above=0.0
    )
    frequencies: tuple[float, ...] = _size(
        (),
        'also estimate a sinusoidal disturbance of each joint at each of these frequencies',
        'rad/s',
        above=0.0,
        may_be_empty=True,
    )
    derivative_filter: float = _in_window(
        100.0, 'frequency of filter (8) for lambda and acceleration', 'rad/s', 'omega', above=0.0
    )
    radius: float = positive(
        3.0, 'radius of the projection ball of the estimate', 'kg m^2', 'omega_a'
    )
    compensation: Literal['reference', 'state'] = parameter(
        'reference',
        'where what is learned acts: along the reference only, or at the measured state (paper)',
    )
    bumpless: bool = parameter(
        True, 'let the disturbance estimate offset the torque that the prediction error adds'
    )
    change_detection: bool = _size(
        True, 'discard the window when torques contradict it: payload, contact, a changed arm'
    )
    residual_floor: PerJoint = positive(
        (0.07, 0.07),
        'rms unmodelled torque of a joint that is not treated as a change of the arm',
        'N m',
    )
    anchor_weight: float = non_negative(
        0.1, 'pull towards the estimate before a change, until the new window is full'
    )
    prior_weight: float = non_negative(
        0.0, 'pull towards the initial estimate, for arms whose parameters are not all excited'
    )
    motion_scale: float = non_negative(
        0.0, 'reference velocity below which the rows of a joint count less; 0: none', 'rad/s'
    )
    row_interval: int = _size(
        1, 'samples between two rows of the excitation window', 'samples', at_least=1
    )
    column_gain: float = positive(1.0, 'adaptation gain of the disturbance columns')
    interval: int = _size(
        10, 'samples between two eigenvalue checks of the excitation matrix', 'samples', at_least=1
    )
    torque_source: Literal['command', 'effort'] = _in_window(
        'command', 'torque to learn from: the limited command, or the effort of the joint states'
    )

    def problems(self, sample_time: float, model: str, count: int) -> list[str]:
        """Check the size of the window, and the initial estimate against the model and the ball."""
        problems = []
        samples, (fewest, most) = round(self.window / sample_time), _SAMPLES
        if not fewest <= samples <= most:
            problems.append(
                f'learning.window: got {self.window:g} s, which is {samples} samples of '
                f'{sample_time:g} s: between {fewest} and {most} are allowed'
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
                f'learning.radius: got {self.radius:g} kg m^2, but learning.initial_estimate has '
                f'a norm of {norm:.6g} kg m^2: the radius must be larger'
            )
        return problems
