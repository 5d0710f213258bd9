# SPDX-License-Identifier: Apache-2.0
"""Products, inverses and dependent columns of matrices, with the same bits on every processor.

Those of numpy call a BLAS, which sums in another order on each kind of processor.  What kernels
start from is computed with these, of elementwise operations and sums over rows.
"""

import numpy as np


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

    A column is dependent if less than `least` remains of it without its part along those before
    (modified Gram-Schmidt).
    """
    rest, kept, rows = Y.copy(), [], []
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
