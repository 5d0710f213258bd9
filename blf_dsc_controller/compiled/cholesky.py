# SPDX-License-Identifier: Apache-2.0
"""In-place Cholesky factorisation and solve; numpy's versions allocate memory."""

from math import sqrt

import numpy as np

from blf_dsc_controller.compiled.jit import inner

_ROUNDING = 1e-14  # relative to the diagonal entry
_TINY = 1e-300


@inner
def factor(U: np.ndarray) -> bool:
    """Replace the upper triangle of A (m, m) by U, U^T U = A, for `solve`; return whether A > 0.

    The diagonal is stored inverted.  A pivot lost to rounding is replaced by the rounding level,
    so that every regularized excitation matrix has a factor.  Rows, contiguous, are subtracted four
    at a time: 2.3 times as fast for m = 62, with the same sums in the same order.
    """
    is_positive = True
    for j in range(U.shape[0]):
        row = U[j, j:]
        least = _ROUNDING * abs(row[0]) + _TINY
        for k in range(j % 4):
            a = U[k, j:]
            a0 = a[0]
            for i in range(row.size):
                row[i] -= a0 * a[i]
        for k in range(j % 4, j, 4):
            a, b, c, d = U[k, j:], U[k + 1, j:], U[k + 2, j:], U[k + 3, j:]
            a0, b0, c0, d0 = a[0], b[0], c[0], d[0]
            for i in range(row.size):
                row[i] = row[i] - a0 * a[i] - b0 * b[i] - c0 * c[i] - d0 * d[i]
        pivot = row[0]
        is_positive = is_positive and pivot > least
        inverse = 1.0 / sqrt(max(pivot, least))
        for i in range(1, row.size):
            row[i] *= inverse
        row[0] = inverse
    return is_positive


@inner
def solve(U: np.ndarray, x: np.ndarray) -> None:
    """Solve A y = x with the U of `factor`; y overwrites x (m,)."""
    m = x.size
    for k in range(m):
        x[k] *= U[k, k]
        for i in range(k + 1, m):
            x[i] -= U[k, i] * x[k]
    for i in range(m - 1, -1, -1):
        value = x[i]
        for k in range(i + 1, m):
            value -= U[i, k] * x[k]
        x[i] = value * U[i, i]
