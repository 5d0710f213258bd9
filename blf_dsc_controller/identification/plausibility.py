# SPDX-License-Identifier: Apache-2.0
"""Whether the identified arm is of the size of the URDF's: its gravity, and its inertia.

Each is the torque of the identified bodies over that of the URDF's, projected onto the
latter.  Friction has no part in it, nor has the mean of gravity, which an offset can
replace.  Efforts in other units than N m give shares of that factor; without gravity,
its share is near 0.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from blf_dsc_controller.arms.urdf import Joint
from blf_dsc_controller.identification.recording import TURN, Indices
from blf_dsc_controller.identification.windows import Rows
from blf_dsc_controller.run import Floats, joint_units

GRAVITY = (0.4, 1.6)
"""Least and largest share of the URDF's gravity: beyond, it is missing or double."""

INERTIA = (0.2, 5.0)
"""Likewise of its inertia, which is asked where gravity is faint: rotors are guesses."""

_TOLERANCE = 0.05  # rad or m, beyond the limits of a joint
_FAINT = 0.02  # of the torque of the URDF, least part that says anything


def shares(
    rows: Rows, fit: Indices, urdf: Floats, found: Floats
) -> tuple[float, float]:
    """Return the shares of the URDF's gravity, and inertial torques, of P (p,) in some windows.

    They are NaN where the URDF's would be faint.
    """
    gravity, inertial = inertial_torques(rows, fit, urdf)
    found_gravity, found_inertial = inertial_torques(rows, fit, found)
    size = float(np.sqrt(np.mean((gravity + inertial) ** 2)))
    return (
        _share(_varying(found_gravity), _varying(gravity), size),
        _share(found_inertial, inertial, size),
    )


def outside_range(rows: Rows, joints: Sequence[Joint]) -> Iterator[str]:
    """Yield which joints are mostly outside of their range in the URDF; turns do not count."""
    for joint, q in zip(joints, rows.postures.T, strict=True):
        span = joint.upper - joint.lower
        if not 0.0 < span < np.inf:
            continue
        middle = 0.5 * (joint.lower + joint.upper)
        off = q - middle
        if joint.kind != 'prismatic':
            off -= TURN * np.round(np.median(off) / TURN)
        is_outside = np.abs(off) > 0.5 * span + _TOLERANCE
        if 2 * is_outside.sum() > q.size:
            unit = joint_units(joint.kind).position
            yield (
                f'{joint.name} is at {q.min():.3g} to {q.max():.3g} {unit}, but has a range of '
                f'{joint.lower:.3g} to {joint.upper:.3g}'
            )


def inertial_torques(rows: Rows, windows: Indices, P: Floats) -> tuple[Floats, Floats]:
    """Return the torques (k, n) of gravity, and the other inertial ones, of P (p,)."""
    gravity = rows.over_windows(lambda at: rows.gravity_torque(P, at))[windows]
    theta = np.zeros(rows.unknowns)
    theta[: rows.p] = P
    return gravity, rows.torques(windows, theta) - gravity


def _varying(torque: Floats) -> Floats:
    return np.asarray(torque - torque.mean(axis=0))


def _share(found: Floats, urdf: Floats, size: float) -> float:
    """Return the projection onto the torque (k, n) of the URDF, NaN if that is faint."""
    if np.sqrt(np.mean(urdf**2)) <= _FAINT * size:
        return float('nan')
    return float(np.sum(found * urdf) / np.sum(urdf**2))
