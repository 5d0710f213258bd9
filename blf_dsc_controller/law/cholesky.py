# SPDX-License-Identifier: Apache-2.0
"""In-place Cholesky factorisation and solve; numpy's versions allocate memory."""

from math import sqrt

import numpy as np

from blf_dsc_controller.compiled.jit import inner

_ROUNDING = 1e-14  # relative to the diagonal entry
_TINY = 1e-300


@inner
def factor(L: np.ndarray) -> bool:
    """Replace the lower triangle of A (m, m) by its factor, for `solve`; return whether A > 0.

    The diagonal is stored inverted.  A pivot lost to rounding is replaced by the rounding level,
    so that every regularized excitation matrix has a factor.
    """
    is_positive = True
    for j in range(L.shape[0]):
        least = _ROUNDING * abs(L[j, j]) + _TINY
        pivot = L[j, j]
        for k in range(j):
            pivot -= L[j, k] * L[j, k]
        is_positive = is_positive and pivot > least
        L[j, j] = 1.0 / sqrt(max(pivot, least))
        for i in range(j + 1, L.shape[0]):
            value = L[i, j]
            for k in range(j):
                value -= L[i, k] * L[j, k]
            L[i, j] = value * L[j, j]
    return is_positive


@inner
def solve(L: np.ndarray, x: np.ndarray) -> None:
    """Solve A y = x with the L of `factor`; y overwrites x (m,)."""
    m = x.size
    for i in range(m):
        value = x[i]
        for k in range(i):
            value -= L[i, k] * x[k]
        x[i] = value * L[i, i]
    for i in range(m - 1, -1, -1):
        value = x[i]
        for k in range(i + 1, m):
            value -= L[k, i] * x[k]
        x[i] = value * L[i, i]
