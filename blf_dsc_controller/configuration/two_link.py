# SPDX-License-Identifier: Apache-2.0
"""The paper's arm of two links, and the gains of the law for it.

A controller without `robot.urdf` has this group. The gains of an arm from a URDF follow
from its stiffness and damping instead (`arms.tuning`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from blf_dsc_controller.configuration.schema import (
    PerJoint,
    Vector,
    non_negative,
    parameter,
    parameters,
    positive,
)

GROUP = 'two_link'

STEEPEST = 2e4
"""Stiffness [N m/rad] at which the barrier continues linearly: below 2 K_p / T."""

_in_window = partial(
    parameter, read_only='the data in the excitation window depend on it'
)
_at_start = partial(parameter, read_only='it has no effect later')
_sizing = partial(parameter, read_only='it sets the size of the state of the law')


@dataclass(frozen=True)
class TwoLink:
    """Known geometry and initial estimate of the two links, and the gains of the law.

    The masses and the length of the second link are learned.
    """

    l1: float = _in_window(1.0, 'length of the first link', 'm', 'l1', above=0.0)
    gravity: float = _in_window(9.8, 'gravity; 0 for a horizontal arm', 'm/s^2', 'g')
    initial_estimate: Vector = _at_start(
        (0.5, 0.16, 0.2),
        'initial estimate of (m1+m2)*l1^2, m2*l2^2, m2*l1*l2',
        'kg m^2',
        'P^(0)',
    )
    feedback_gain: PerJoint = non_negative(
        (60.0, 20.0), 'gain on the velocity error', 'N m s/rad', 'K_p'
    )
    surface_gain: PerJoint = non_negative(
        (150.0, 150.0), 'gain of the virtual control on the tracking error', '1/s', 'K'
    )
    mu: PerJoint = non_negative(
        (20.0, 20.0),
        'gain of the virtual control that remains at the bound',
        '1/s',
        'mu',
    )
    barrier_weight: PerJoint = positive(
        (1000.0, 1000.0),
        'stiffness of the barrier at zero error; 1 in the paper',
        'N m/rad',
        'w',
        below=STEEPEST,
    )
    robust_gain: PerJoint = non_negative(
        (0.0, 0.0), 'robust term d2 |xi1| sat(xi2/b)', 'N m/rad', 'd2'
    )
    leakage: float = non_negative(
        0.0, 'leakage of the disturbance estimate', 'rad/(N m s)', 'eta'
    )
    adaptation_gain: Vector = non_negative(
        (0.5, 0.5, 0.5), 'diagonal of the adaptation gain', symbol='Gamma'
    )
    learning_weight: float = non_negative(
        100.0, 'weight of the prediction error', symbol='kappa'
    )
    excitation_threshold: float = positive(
        0.003,
        'minimum eigenvalue of the excitation matrix of an excited window',
        symbol='sigma',
    )
    frequencies: tuple[float, ...] = _sizing(
        (),
        'also estimate a sinusoidal disturbance of each joint at each of these frequencies',
        'rad/s',
        above=0.0,
        omittable=True,
    )
    bias: bool = _sizing(True, 'also estimate a constant disturbance of each joint')


NAMES = frozenset(f'{GROUP}.{param.name}' for param in parameters(TwoLink))


def two_link(config: object) -> TwoLink:
    """Return the group of a configuration, or its defaults."""
    given: TwoLink = getattr(config, GROUP, TwoLink())
    return given
