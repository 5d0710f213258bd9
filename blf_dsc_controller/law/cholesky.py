# SPDX-License-Identifier: Apache-2.0
"""Cholesky factor and solve in place; numpy's own allocate memory."""

from math import sqrt

import numpy as np

from blf_dsc_controller.compiled.jit import inner


@inner
def factor(A: np.ndarray, shift: float, L: np.ndarray) -> None:
    """Fill lower L (m x m) with the factor of A + shift I, its diagonal inverted for `solve`.

    A is symmetric >= 0 and shift > 0.  A pivot that rounding makes smaller than `shift` is taken as
    `shift`, which it is at least in exact arithmetic, so the factor exists for every excitation
    matrix, singular ones included.
    """
    m = A.shape[0]
    for j in range(m):
        pivot = A[j, j] + shift
        for k in range(j):
            pivot -= L[j, k] * L[j, k]
        L[j, j] = 1.0 / sqrt(max(pivot, shift))
        for i in range(j + 1, m):
            value = A[i, j]
            for k in range(j):
                value -= L[i, k] * L[j, k]
            L[i, j] = value * L[j, j]


@inner
def solve(L: np.ndarray, x: np.ndarray) -> None:
    """Solve (A + shift I) y = x with the factor L of `factor`, leaving y in x (m,)."""
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
