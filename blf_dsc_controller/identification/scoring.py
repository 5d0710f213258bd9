# SPDX-License-Identifier: Apache-2.0
"""Score of values on torques held back, and the friction that a URDF can hold."""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.identification.identified import Score
from blf_dsc_controller.identification.values import (
    COULOMB,
    OFFSET,
    VISCOUS,
    parts,
)
from blf_dsc_controller.identification.windows import Rows, Split
from blf_dsc_controller.run import Floats


def scored(
    rows: Rows, windows: Split, G: Floats, prior: Floats, values: Floats
) -> Score:
    """Return the score of values that were fitted to `windows.fit`."""
    rows.set_load((G @ values)[: rows.p])
    moving = windows.moving
    urdf = np.zeros_like(prior)
    parts(urdf).bodies[:] = parts(prior).bodies
    parts(urdf).terms[[VISCOUS, COULOMB]] = parts(prior).terms[[VISCOUS, COULOMB]]
    corrected = np.zeros_like(prior)
    parts(corrected).bodies[:] = parts(values).bodies
    parts(corrected).load[:] = parts(values).load
    friction = nearest_friction(rows, windows, values)
    parts(corrected).terms[[VISCOUS, COULOMB]] = friction
    models = (urdf, corrected, values)
    predicted = np.array([rows.torques(moving, (G @ model)[:-1]) for model in models])
    measured = rows.u(values[-1])[moving]
    shown = np.isin(moving, windows.test)
    residual = predicted[:, shown] - measured[shown]
    held_back = rows.time[windows.test]
    return Score(
        time=rows.time[moving],
        measured=measured,
        predicted=predicted,
        errors=np.sqrt(np.mean(residual**2, axis=1)),
        torque=np.sqrt(np.mean(measured[shown] ** 2, axis=0)),
        held_back=(float(held_back[0]), float(held_back[-1])),
    )


def nearest_friction(rows: Rows, windows: Split, values: Floats) -> Floats:
    """Return the viscous and Coulomb friction (2, n) nearest to that of all terms."""
    terms = parts(values).terms[1:].copy()
    terms[OFFSET - 1] = 0.0
    fit = windows.fit
    columns = rows.friction[fit]
    friction = np.sum(columns * terms, axis=1)
    friction[:, -2:] += rows.coupling[fit] @ parts(values).coupling
    weight = rows.weight[fit]
    viscous_and_coulomb = columns[:, :2] * weight[:, None]
    found = [
        np.linalg.lstsq(
            viscous_and_coulomb[:, :, i], friction[:, i] * weight[:, i], rcond=None
        )[0]
        for i in range(rows.speed.size)
    ]
    return np.asarray(np.maximum(np.transpose(found), 0.0))
