# SPDX-License-Identifier: Apache-2.0
"""Damping that brings all joints of an arm to rest without one dragging another along."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.model import inertia_matrices
from blf_dsc_controller.law.state import Settings

Array = NDArray[np.float64]


def braking_matrix(settings: Settings, damping: Array, q: Array) -> Array:
    """Return D(q) (n, n) [N m s/rad] with the `damping` (n,) of each joint on its diagonal.

    Joints that brake by themselves drag those behind them along: a wrist of a Panda gets
    three times as fast as it was.  With the rate r_i = damping_i / M0_ii of each joint,

        D_ij = min(r_i, r_j) M0_ij

    Where all rates are the same, D = r M0, so that each velocity of the model decays by
    itself.  Else a joint in front acts on a faster one behind it as it does in M0, and the
    other way round with less.  D is the product, entry by entry, of two matrices that are
    symmetric and positive semidefinite, and so it is one, too (Schur's product theorem): it
    takes energy out of any motion, that of elastic joints included.  M0 is of the initial
    estimate; without one, D is diagonal.
    """
    M = inertia_matrices(
        settings.model, settings.initial_estimate[: settings.p], q[np.newaxis]
    )[0]
    inertia = np.diagonal(M)
    if not (np.isfinite(M).all() and (inertia > 0.0).all()):
        return np.diag(damping)
    rate = damping / inertia
    coupled: Array = np.minimum.outer(rate, rate) * M
    return coupled
