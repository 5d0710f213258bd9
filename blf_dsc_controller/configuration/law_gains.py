# SPDX-License-Identifier: Apache-2.0
"""Gains that only one law of the package has: its group `gains`.

The controller has them if that law is chosen, as it has those of a law of a file
(`law_file`). What they do is in `factory.laws`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from blf_dsc_controller.configuration.controller_groups import in_window
from blf_dsc_controller.configuration.schema import (
    PerJoint,
    non_negative,
    parameter,
    positive,
)

_UPDATE = 'step along the prediction error: regularised Newton, or the gradient (paper)'


@dataclass(frozen=True)
class Paper:
    """What `paper` does as printed; the other choice is that of `blf_dsc`."""

    prediction: Literal['filtered', 'lambda'] = in_window(
        'lambda', 'prediction error by filtered regressor, or by Lambda (24)'
    )
    update: Literal['newton', 'gradient'] = parameter('gradient', _UPDATE)
    compensation: Literal['reference', 'state'] = parameter(
        'state',
        'where what is learned acts: along the reference, or at the state (28)',
    )
    bumpless: bool = parameter(
        False,
        'let the disturbance estimate offset the torque that the prediction error adds; '
        'false: (30)',
    )
    change_detection: bool = parameter(
        False,
        'discard a window that torques contradict, because the arm has changed',
        read_only='the data in the excitation window depend on it',
    )
    known_rate: bool = parameter(
        False,
        'tell the surface filter the rate of the virtual control, by the reference and the '
        'measured velocity, so that it has no lag; `blf_dsc` does so for an arm from a URDF',
        read_only='the torque would jump',
    )


@dataclass(frozen=True)
class LinearSurface:
    """Gains of a law with a linear surface.

    Feedback and learning have groups of their own.
    """

    surface_gain: PerJoint = positive(
        (70.0, 70.0),
        'gain of the linear surface alpha2 = dqr - lambda_s z1',
        '1/s',
        'lambda_s',
    )
    feedback_gain: PerJoint = non_negative(
        (),
        'gain on the surface; empty: that of blf_dsc',
        'N m s/rad',
        'K_c',
        omittable=True,
    )
    adaptation_gain: tuple[float, ...] = non_negative(
        (),
        'diagonal of the adaptation gain of P; empty: that of blf_dsc',
        symbol='Gamma',
        omittable=True,
    )
    learning_weight: float = non_negative(
        0.0,
        'weight of the prediction error; 0: by the tracking error alone',
        '',
        'kappa',
    )
    update: Literal['newton', 'gradient'] = parameter('newton', _UPDATE)


@dataclass(frozen=True)
class Backstepping(LinearSurface):
    """Gains of `backstepping`, (35)."""

    position_gain: PerJoint = non_negative(
        (1.0, 1.0), 'gain on the tracking error z1', 'N m/rad', 'w'
    )
    robust_gain: PerJoint = non_negative(
        (0.0, 0.0), 'amplitude of the robust term', 'N m', 'mu_bar'
    )
    leakage: float = non_negative(0.001, 'leakage of P^', symbol='W_c')


@dataclass(frozen=True)
class SlotineLi(LinearSurface):
    """Gains of `slotine_li`."""

    integral_gain: PerJoint = non_negative(
        (), 'integral gain on the surface; empty: none', 'N m/rad', omittable=True
    )
