# SPDX-License-Identifier: Apache-2.0
"""Torques of the estimated model: of a motion, of gravity alone, and of friction."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.friction import sliding
from blf_dsc_controller.arms.model import regressors_at
from blf_dsc_controller.law import columns
from blf_dsc_controller.law.state import Settings
from blf_dsc_controller.law.torque import added_torque

Vector = NDArray[np.float64]


def gravity_torque(settings: Settings, estimate: Vector, q: Vector) -> Vector:
    """Return H(q, 0, 0, 0) P^ (n,) [N m], which holds the model at rest at q (n,) [rad].

    `estimate` is theta^ = [P^; d^] (m,).
    """
    return model_torque(settings, estimate, q, *np.zeros((2, settings.n)))


def model_torque(
    settings: Settings, estimate: Vector, q: Vector, dq: Vector, ddq: Vector
) -> Vector:
    """Return H(q, dq, dq, ddq) P^ = M ddq + C dq + G (n,) [N m] of a motion q, dq, ddq (n,).

    `estimate` is theta^ = [P^; d^] (m,).
    """
    (H,) = regressors_at(
        settings.model, *(vector[np.newaxis] for vector in (q, dq, dq, ddq))
    )
    return np.asarray((H * estimate[: settings.p]).sum(axis=1))


def friction_torque(
    settings: Settings, estimate: Vector, dq: Vector, tau: Vector
) -> Vector:
    """Return the friction D d^ (n,) [N m] of the estimate theta^ (m,), zero without columns.

    It is that at dq (n,) [rad/s], of gears that carry tau (n,) [N m].
    """
    column_settings, n = settings.columns, settings.n
    torque = np.zeros(n)
    for i in range(n):
        sign = sliding(dq[i], column_settings.coulomb_velocity)
        at = columns.Point(0.0, 0.0, dq[i], sign, tau[i])
        torque[i] = columns.torque_of(
            column_settings, columns.FRICTION, i, at, estimate, n
        )
    return torque


def needed_torque(
    settings: Settings, estimate: Vector, q: Vector, dq: Vector, ddq: Vector
) -> Vector:
    """Return the command (n,) [N m] that causes a motion q, dq, ddq (n,).

    It is model and friction of the estimate theta^ (m,), less what the drives add.
    """
    with np.errstate(over='ignore', invalid='ignore'):  # the caller checks it
        needed = model_torque(settings, estimate, q, dq, ddq)
        needed += friction_torque(settings, estimate, dq, needed)
    needed -= added_torque(settings.torque, q)
    return needed
