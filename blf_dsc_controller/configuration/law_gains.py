# SPDX-License-Identifier: Apache-2.0
"""Gains that only one law of the package has: its group `gains`.

The controller has them if that law is chosen, as it has those of a law of a file
(`law_file`). What they do is in `factory.laws`.
"""

from __future__ import annotations

from dataclasses import dataclass

from blf_dsc_controller.configuration.schema import (
    PerJoint,
    non_negative,
    positive,
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
    learning_weight: float = non_negative(
        0.0,
        'weight of the prediction error; 0: by the tracking error alone',
        '',
        'kappa',
    )


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
