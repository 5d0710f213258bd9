# SPDX-License-Identifier: Apache-2.0
"""Damping that brings all joints of an arm to rest without one dragging another along."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.model import inertia_matrices
from blf_dsc_controller.law.sensor import FILTER
from blf_dsc_controller.law.state import Settings

Array = NDArray[np.float64]


def braking_matrix(M: Array | None, damping: Array, gap: float = 0.0) -> Array:
    """Return D (n, n) [N m s/rad] with the `damping` (n,) of each joint on its diagonal.

    Joints that brake by themselves drag those behind them along: a wrist of a Panda gets
    three times as fast as it was.  With the rate r_i = damping_i / M0_ii of each joint,

        D_ij = min(r_i, r_j) M0_ij

    Where all rates are the same, D = r M0, so that each velocity of the model decays by
    itself.  Else a joint in front acts on a faster one behind it as it does in M0, and the
    other way round with less.  D is the product, entry by entry, of two matrices that are
    symmetric and positive semidefinite, and so it is one, too (Schur's product theorem): it
    takes energy out of any motion, that of elastic joints included.  M0 is `known_inertia`;
    without one, D is diagonal.  `gap` [s] bounds it as `within_gap` does.
    """
    if M is None:
        return np.diag(damping)
    rate = _limited_rate(damping / np.diagonal(M), gap)
    return _without_reversal(np.minimum.outer(rate, rate) * M, M, gap)


def within_gap(M: Array | None, damping: Array, gap: float) -> Array:
    """Return the `damping` (n,) [N m s/rad] of joints that low pass and gap allow them.

    Behind the low pass of v no rate D/M0 is above 1/tau (`Swing`).  A torque -D v that is held
    for h turns v into v - h M^-1 D v.  While no eigenvalue of h M0^-1 D is above 1, it reverses
    no motion of the model; above 2, each gap leaves a faster one than before.  So no rate is
    above 1/h, and what the coupling of the joints adds to that divides D.  Without a gap, `gap`
    is 0.
    """
    if M is None:
        return damping
    inertia = np.diagonal(M)
    tolerated = np.diag(_limited_rate(damping / inertia, gap) * inertia)
    return np.diagonal(_without_reversal(tolerated, M, gap))


def known_inertia(settings: Settings, q: Array) -> Array | None:
    """Return M0 (n, n) [kg m^2] at q (n,) [rad]; None without a positive estimate."""
    M = inertia_matrices(
        settings.model, settings.initial_estimate[: settings.p], q[np.newaxis]
    )[0]
    is_known = np.isfinite(M).all() and (np.diagonal(M) > 0.0).all()
    return M if is_known else None


def _limited_rate(rate: Array, gap: float) -> Array:
    """Return the rates (n,) [1/s] that low pass and gap tolerate.

    1/tau makes a joint half critical.
    """
    return np.minimum(rate, 1.0 / max(gap, FILTER))


def _without_reversal(D: Array, M: Array, gap: float) -> Array:
    """Return D (n, n), divided by the largest eigenvalue of gap M^-1 D if it is above 1."""
    if gap == 0.0:
        return D
    largest = gap * float(np.linalg.eigvals(np.linalg.solve(M, D)).real.max())
    return D / max(1.0, largest)
