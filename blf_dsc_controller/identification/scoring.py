# SPDX-License-Identifier: Apache-2.0
"""Score of values on torques held back, and the friction that a URDF can hold."""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.identification.identified import Score
from blf_dsc_controller.identification.prior import Prior
from blf_dsc_controller.identification.recording import Indices
from blf_dsc_controller.identification.values import (
    COULOMB,
    OFFSET,
    VISCOUS,
    parts,
)
from blf_dsc_controller.identification.windows import Rows, Split
from blf_dsc_controller.run import Floats


def scored(rows: Rows, windows: Split, prior: Prior, values: Floats) -> Score:
    """Return the score of values that were fitted to `windows.fit`."""
    rows = rows.with_load(prior.G @ values)
    moving = windows.moving
    models = np.zeros((3, values.size))  # URDF, corrected URDF, all values
    parts(models[0]).bodies[:] = parts(prior.mean).bodies
    parts(models[1]).bodies[:] = parts(values).bodies
    parts(models[1]).load[:] = parts(values).load
    models[2] = values
    predicted = np.array([rows.torques(moving, prior.G @ model) for model in models])
    columns = _columns_of_urdf(rows, moving)
    friction_of_urdf = parts(prior.mean).terms[[VISCOUS, COULOMB]]
    predicted[0] += np.sum(columns * friction_of_urdf, axis=1)
    predicted[1] += np.sum(columns * nearest_friction(rows, windows, values), axis=1)
    measured = rows.u(values[-1])[moving]
    shown = np.isin(moving, windows.test)
    residual = predicted[:, shown] - measured[shown]
    held_back = rows.time[windows.test]
    return Score(
        time=rows.time[moving],
        measured=measured,
        predicted=predicted,
        errors=rows.rms(residual, windows.test),
        torque=rows.rms(measured[shown], windows.test),
        held_back=(float(held_back[0]), float(held_back[-1])),
    )


def nearest_friction(rows: Rows, windows: Split, values: Floats) -> Floats:
    """Return the viscous and Coulomb friction (2, n) nearest to that of all terms.

    They are those of a URDF or MJCF, whose Coulomb friction changes its sign at once.
    """
    from scipy.optimize import nnls

    fit = windows.fit
    terms = parts(values).terms[1:].copy()
    terms[OFFSET - 1] = 0.0
    friction = np.sum(rows.friction(fit) * terms, axis=1)
    friction[:, -2:] += rows.coupling[fit] @ parts(values).coupling
    weight = rows.weight[fit]
    friction *= weight
    columns = _columns_of_urdf(rows, fit) * weight[:, None]
    joints = range(rows.speed.size)
    found = [nnls(columns[:, :, i], friction[:, i])[0] for i in joints]
    return np.transpose(found)


def _columns_of_urdf(rows: Rows, windows: Indices) -> Floats:
    """Return the columns (k, 2, n) of viscous and Coulomb friction as a URDF has them."""
    viscous = rows.columns['viscous'][windows]
    return np.stack((viscous, rows.sliding_at_once()[windows]), axis=1)
