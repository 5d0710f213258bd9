# SPDX-License-Identifier: Apache-2.0
"""Linear algebra: of vectors of three, in kernels, and with the same bits on every processor.

Vectors of three entries are tuples, which kernels keep in registers; the Cholesky
factorisation is in place, since numpy's allocates memory.  Products, inverses and
dependent columns of numpy call a BLAS, which sums in another order on each kind of
processor: what kernels start from is computed with those below, of elementwise
operations and sums over rows.
"""

from math import sqrt

import numpy as np

from blf_dsc_controller.compiled.jit import inner

Vector = tuple[float, float, float]
_ROUNDING = 1e-14  # relative to the diagonal entry
_TINY = 1e-300


@inner
def vector(a: np.ndarray) -> Vector:
    """Return an array (3,) as a vector."""
    return a[0], a[1], a[2]


@inner
def put(a: Vector, out: np.ndarray) -> None:
    """Write a vector into an array (3,)."""
    out[0], out[1], out[2] = a


@inner
def plus(a: Vector, b: Vector) -> Vector:
    """Return a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@inner
def times(k: float, a: Vector) -> Vector:
    """Return k a."""
    return k * a[0], k * a[1], k * a[2]


@inner
def cross(a: Vector, b: Vector) -> Vector:
    """Return the cross product."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


@inner
def dot(a: Vector, b: Vector) -> float:
    """Return the scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inner
def transform(A: np.ndarray, b: Vector) -> Vector:
    """Return the product of a matrix (3, 3) and a vector."""
    return dot(vector(A[0]), b), dot(vector(A[1]), b), dot(vector(A[2]), b)


@inner
def cholesky_factor(U: np.ndarray) -> bool:
    """Replace the upper triangle of A (m, m) by U, U^T U = A; return whether A > 0.

    The diagonal is stored inverted.  A pivot lost to rounding is replaced by the
    rounding level, so that every regularized excitation matrix has a factor.  Rows,
    contiguous, are subtracted four at a time: 2.3 times as fast for m = 62, with the
    same sums in the same order.
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
            a = U[k, j:]
            b = U[k + 1, j:]
            c = U[k + 2, j:]
            d = U[k + 3, j:]
            a0 = a[0]
            b0 = b[0]
            c0 = c[0]
            d0 = d[0]
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
def cholesky_solve(U: np.ndarray, x: np.ndarray) -> None:
    """Solve A y = x with the U of `cholesky_factor`; y overwrites x (m,)."""
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


@inner
def whiten(U: np.ndarray, x: np.ndarray) -> float:
    """Replace x (m,) by U^-T x, with the U of `cholesky_factor`; return x^T A^-1 x."""
    square = 0.0
    for k in range(x.size):
        x[k] *= U[k, k]
        square += x[k] * x[k]
        for i in range(k + 1, x.size):
            x[i] -= U[k, i] * x[k]
    return square


def product(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Return A B of (stacks of) matrices."""
    result: np.ndarray = (A[..., np.newaxis] * B[..., np.newaxis, :, :]).sum(axis=-2)
    return result


def inverse(A: np.ndarray) -> np.ndarray:
    """Return the inverse of (a stack of) symmetric positive definite matrices, by elimination."""
    A = A.copy()
    for k in range(A.shape[-1]):
        column = A[..., k].copy()
        pivot = column[..., k, np.newaxis]
        row = A[..., k, :] / pivot
        A -= column[..., np.newaxis] * row[..., np.newaxis, :]
        A[..., k, :] = row
        A[..., k] = -column / pivot
        A[..., k, k] = 1.0 / pivot[..., 0]
    return A


def independent_columns(Y: np.ndarray, least: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of independent columns of Y, tried in order, and X of Y = Y[:, kept] X.

    A column is dependent if less than `least` remains of it without its part along
    those before (modified Gram-Schmidt).
    """
    rest = Y.copy()
    kept = []
    rows = []
    for k in range(Y.shape[1]):
        size = np.sqrt((rest[:, k] ** 2).sum())
        if size > least:
            unit = rest[:, k] / size
            along = (unit[:, np.newaxis] * rest).sum(axis=0)
            along[:k], along[k] = 0.0, size
            rest -= unit[:, np.newaxis] * along
            kept.append(k)
            rows.append(along)
    X = np.array(rows)  # triangular in the columns kept
    for i in reversed(range(len(kept))):
        X[i] /= X[i, kept[i]]
        X[:i] -= X[:i, kept[i], np.newaxis] * X[i]
    return np.array(kept), X
