# SPDX-License-Identifier: Apache-2.0
"""How the arm is mounted: the direction of gravity that its torques show.

The torques of joints are explained by those of gravity along the three axes of the
base, computed with the masses of the URDF, by the other inertial torque of the URDF,
and by friction.  The masses need not be right: on recordings of real arms the direction
is within two degrees.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np

from blf_dsc_controller.arms.model import regressors_at
from blf_dsc_controller.arms.serial_chain import serial_chain
from blf_dsc_controller.arms.urdf import Chain
from blf_dsc_controller.identification.joint_alone import SIMPLE, Alone
from blf_dsc_controller.identification.plausibility import inertial_torques
from blf_dsc_controller.identification.recording import Indices
from blf_dsc_controller.identification.windows import Rows
from blf_dsc_controller.run import Floats

_UNSEEN = 1e-3  # of its deviation, what a component of gravity counts that is not shown
_APART = np.cos(
    np.deg2rad(30.0)
)  # of directions: right masses do not change it so much
_SNAP = np.cos(np.deg2rad(15.0))  # from an axis of the base
_LEAST = 0.3  # of gravity, what shows a direction


def other_mounting(
    rows: Rows, fit: Indices, chain: Chain, P: Floats, gravity: Floats, alone: Alone
) -> Floats | None:
    """Return gravity (3,) [m/s^2] in the base if it clearly is not the given one, else None.

    P are the base parameters of the URDF for the given gravity.
    """
    size = float(np.linalg.norm(gravity))
    if size == 0.0:
        return None
    found = _shown_gravity(rows, fit, chain, P, gravity, alone)
    strength = float(np.linalg.norm(found))
    if strength < _LEAST * size or found @ gravity > _APART * strength * size:
        return None
    direction = found / strength
    axis = np.trunc(direction / _SNAP) + 0.0  # zero, not -0, if none is near
    return size * (axis if axis.any() else direction)


def _shown_gravity(
    rows: Rows, fit: Indices, chain: Chain, P: Floats, given: Floats, alone: Alone
) -> Floats:
    """Return the gravity (3,) that the torques show, with the masses of the URDF."""
    _, inertial = inertial_torques(rows, fit, P)
    # what friction does not show is taken to be as in most joints
    most = np.sign(np.sum(alone.friction)) or 1.0
    signs = np.where(alone.friction == 0.0, most, alone.friction)
    q = rows.postures[fit]
    of_gravity = [gravity_torques(chain, axis)(q) for axis in np.eye(3)]
    columns = np.concatenate(
        (
            np.swapaxes(rows.friction(fit, SIMPLE), 1, 2),
            np.stack(of_gravity, axis=2),
            inertial[:, :, None],
            (signs * rows.u(alone.delay)[fit])[:, :, None],
        ),
        axis=2,
    )
    columns *= (rows.weight[fit] / alone.deviation)[:, :, None]
    R = np.asarray(np.linalg.qr(np.moveaxis(columns, 1, 0), mode='r'))
    left = R[:, len(SIMPLE) :, len(SIMPLE) :]  # for any friction
    # what the torques do not show is as given
    weight = _UNSEEN / float(np.linalg.norm(given))
    towards = weight * np.column_stack((np.eye(3), np.zeros(3), given))
    A = np.concatenate((towards, *left))
    found, *_ = np.linalg.lstsq(A[:, :-1], A[:, -1], rcond=None)
    # without friction, inertia shows whether all efforts are of the opposite sign
    is_opposite = not alone.friction.any() and found[3] < 0.0
    return np.asarray(-found[:3] if is_opposite else found[:3])


def gravity_torques(chain: Chain, gravity: Floats) -> Callable[[Floats], Floats]:
    """Return what gives the torques (k, n) [N m or N] of gravity (3,) [m/s^2] at q (k, n).

    They are those of the masses and centres of the URDF.
    """
    joints = range(len(chain.joints))
    model = serial_chain(chain, tuple(gravity), list(product(joints, range(4))))
    moments = chain.inertias[:, :4].ravel()

    def torques(q: Floats) -> Floats:
        still = np.zeros_like(q)
        return np.asarray(regressors_at(model, q, still, still, still) @ moments)

    return torques
