# SPDX-License-Identifier: Apache-2.0
"""How the arm is mounted: the direction of gravity that its torques show.

The torques of joints are explained by those of gravity along the three axes of the
base, computed with the masses of the URDF, by the other inertial torque of the URDF,
and by friction.  The masses need not be right: on recordings of real arms the direction
is within two degrees.
"""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.arms.urdf import Chain, frames
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
    axis = np.zeros(3)
    main = int(np.argmax(np.abs(direction)))
    axis[main] = np.sign(direction[main])
    return size * (axis if direction @ axis > _SNAP else direction)


def _shown_gravity(
    rows: Rows, fit: Indices, chain: Chain, P: Floats, given: Floats, alone: Alone
) -> Floats:
    """Return the gravity (3,) that the torques show, with the masses of the URDF."""
    _, inertial = inertial_torques(rows, fit, P)
    # what friction does not show is taken to be as in most joints
    most = np.sign(np.sum(alone.friction)) or 1.0
    signs = np.where(alone.friction == 0.0, most, alone.friction)
    columns = np.concatenate(
        (
            np.swapaxes(rows.friction(fit, SIMPLE), 1, 2),
            gravity_columns(chain, rows.postures[fit]),
            inertial[:, :, None],
            (signs * rows.u(alone.delay)[fit])[:, :, None],
        ),
        axis=2,
    )
    columns *= (rows.weight[fit] / alone.deviation)[:, :, None]
    R = np.asarray(np.linalg.qr(np.moveaxis(columns, 1, 0), mode='r'))
    left = R[:, len(SIMPLE) :, len(SIMPLE) :]  # for any friction
    A = np.concatenate((_towards(given), *left))
    found, *_ = np.linalg.lstsq(A[:, :-1], A[:, -1], rcond=None)
    # without friction, inertia shows whether all efforts are of the opposite sign
    is_opposite = not alone.friction.any() and found[3] < 0.0
    return np.asarray(-found[:3] if is_opposite else found[:3])


def _towards(given: Floats) -> Floats:
    """Return rows (3, 5) by which what the torques do not show is as given."""
    weight = _UNSEEN / float(np.linalg.norm(given))
    return np.column_stack((weight * np.eye(3), np.zeros(3), weight * given))


def gravity_columns(chain: Chain, q: Floats) -> Floats:
    """Return the torques (..., n, 3) [N m or N] that each m/s^2 of gravity needs at q (..., n)."""
    placements = frames(chain, q)[1:-1]
    mass = 0.0
    first = np.zeros((*q.shape[:-1], 3))  # moments of all beyond a joint, in the base
    columns = np.zeros((*q.shape, 3))
    for i in reversed(range(len(chain.joints))):
        joint = chain.joints[i]
        rotation = placements[i][..., :3, :3]
        origin = placements[i][..., :3, 3]
        m = float(joint.inertia[0])
        mass += m
        first = first + rotation @ joint.inertia[1:4] + m * origin
        axis = rotation @ joint.axis
        if joint.kind == 'prismatic':
            columns[..., i, :] = -mass * axis
        else:
            arm = first - mass * origin
            columns[..., i, :] = -np.cross(axis, arm)
    return columns
