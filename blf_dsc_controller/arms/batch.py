# SPDX-License-Identifier: Apache-2.0
"""Regressors and inertia matrices of an arm at many states, in compiled loops."""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.arms.model import ArmModel
from blf_dsc_controller.compiled.jit import kernel
from blf_dsc_controller.compiled.layout import Array


def regressors_at(model: ArmModel, q: Array, dq: Array, v: Array, a: Array) -> Array:
    """Return H (k, n, p) of the states (k, n): H P = M(q) a + C(q, dq) v + G(q)   [N m]."""
    H = np.zeros((*q.shape, model.p))
    q, dq, v, a = (np.ascontiguousarray(each) for each in (q, dq, v, a))
    _fill_regressors(model, q, dq, v, a, H)
    return H


def inertia_matrices(model: ArmModel, P: Array, q: Array) -> Array:
    """Return M (k, n, n) at the positions (k, n) of an arm with the parameters P (p,)."""
    k, n = q.shape
    Yp, Yr = np.zeros((2, k * n, n, P.size))
    units = np.tile(np.eye(n), (k, 1))
    _fill_momentum_regressors(model, np.repeat(q, n, axis=0), units, Yp, Yr)
    return np.swapaxes((Yp @ P).reshape(k, n, n), 1, 2)


def free_inertias(M: Array) -> Array:
    """Return the inertia (k, n) of each joint with the others free, of matrices M (k, n, n)."""
    return 1.0 / np.diagonal(np.linalg.inv(M), axis1=1, axis2=2)


@kernel
def _fill_regressors(
    model: ArmModel,
    q: np.ndarray,
    dq: np.ndarray,
    v: np.ndarray,
    a: np.ndarray,
    H: np.ndarray,
) -> None:
    for k in range(q.shape[0]):
        model.regressor(q[k], dq[k], v[k], a[k], H[k])


@kernel
def _fill_momentum_regressors(
    model: ArmModel, q: np.ndarray, dq: np.ndarray, Yp: np.ndarray, Yr: np.ndarray
) -> None:
    for k in range(q.shape[0]):
        model.momentum_regressor(q[k], dq[k], Yp[k], Yr[k])
