# SPDX-License-Identifier: Apache-2.0
"""Whether efforts are what they are said to be: their gravity, and their signs.

The torque of each joint is explained by three shares, of the URDF's gravity, of its
other inertial torque, and of friction.  A share of gravity near 1 is right; near 0 it
is missing; near -1 the sign of the effort is reversed.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.identification.regression import triangle
from blf_dsc_controller.identification.values import LOAD
from blf_dsc_controller.identification.windows import COLUMNS, Indices, Rows
from blf_dsc_controller.run import Floats

LEAST_GRAVITY = 0.4
"""Share of the URDF's gravity below which it is missing."""

MOST_GRAVITY = 1.6
"""Share of the URDF's gravity above which it is double."""

_FRICTION = ('viscous', 'Coulomb', 'offset')
_FAINT = 0.1  # of the torque, least gravity that can be checked
_TINY = 1e-6  # N m or N
_DRIVEN = 0.3  # of the torque, least work of friction that shows a sign


def gravity_share(rows: Rows, fit: Indices, P: Floats) -> float:
    """Return the share of the gravity of P in all efforts; NaN where there is hardly any.

    A load that the columns of the rows contain is found beside it.
    """
    size = _sizes(rows, fit)
    weight = rows.weight[fit] / size
    gravity, inertial = _shares_of(rows, fit, P)
    if np.sqrt(np.mean((gravity.std(axis=0) / size) ** 2)) < _FAINT:
        return float('nan')
    u = rows.u(0.0)[fit]
    names = [COLUMNS.index(name) for name in _FRICTION]
    used = [*(rows.p + np.arange(size.size) + k * size.size for k in names)]
    used.append(np.arange(rows.unknowns - LOAD, rows.unknowns))

    def weighted() -> Iterator[Floats]:
        known = np.stack((gravity, inertial), axis=2)
        for block in rows.blocks(fit):
            X = rows.matrix(fit[block])[:, :, np.concatenate(used)]
            columns = np.concatenate((known[block], X, u[block, :, None]), axis=2)
            yield (columns * weight[block, :, None]).reshape(-1, columns.shape[2])

    R = triangle(weighted())
    return float(_solved(R[:, :-1], R[:, -1])[0])


def reversed_joints(rows: Rows, fit: Indices, P: Floats) -> NDArray[np.bool_]:
    """Return which joints (n,) have efforts of the opposite sign.

    Gravity shows it; where a joint carries hardly any, friction does, which cannot
    drive.  What neither shows is taken to be as in all joints that carry some.
    """
    u = rows.u(0.0)[fit]
    size = _sizes(rows, fit)
    gravity, inertial = _shares_of(rows, fit, P)
    carries = gravity.std(axis=0) > _FAINT * size
    drags = np.zeros(size.size, dtype=bool)  # friction shows the sign
    found = np.zeros(size.size, dtype=bool)
    names = [COLUMNS.index(name) for name in _FRICTION]
    for i in range(size.size):
        friction = rows.friction[fit][:, names, i]
        columns = np.column_stack((gravity[:, i], inertial[:, i], friction))
        weight = rows.weight[fit, i]
        share = _solved(columns * weight[:, None], u[:, i] * weight)
        if carries[i]:
            found[i] = share[0] < -LEAST_GRAVITY
        else:
            sliding = friction[:, :2] @ share[2:4]
            drags[i] = _rms(sliding) > _DRIVEN * size[i]
            found[i] = drags[i] and np.mean(sliding * friction[:, 0]) < 0.0
    if carries.any() and found[carries].all():
        found |= ~(carries | drags)
    return found


def _sizes(rows: Rows, fit: Indices) -> Floats:
    """Return the root mean square torque of each joint (n,), or a little where it is zero."""
    rms = np.sqrt(np.mean(rows.u(0.0)[fit] ** 2, axis=0))
    return np.asarray(np.maximum(rms, _TINY))


def _shares_of(rows: Rows, fit: Indices, P: Floats) -> tuple[Floats, Floats]:
    """Return the torques of gravity and of all other inertial terms of P in the windows."""
    gravity = rows.over_windows(lambda at: rows.gravity_torque(P, at), rows.g)[fit]
    theta = np.zeros(rows.unknowns)
    theta[: rows.p] = P
    return gravity, rows.torques(fit, theta) - gravity


def _solved(A: Floats, b: Floats) -> Floats:
    return np.asarray(np.linalg.lstsq(A, b, rcond=None)[0])


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))
