# SPDX-License-Identifier: Apache-2.0
"""Sums of [X | u]^T [X | u] over rows [X | u] (n, m + 1); only their upper triangle is filled."""

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array


@inner
def add(first: Array, weight: float, second: Array, out: Array) -> None:
    """Write the upper triangle of `first` + `weight` `second` to `out`."""
    for a in range(out.shape[0]):
        for b in range(a, out.shape[0]):
            out[a, b] = first[a, b] + weight * second[a, b]


@inner
def copy(source: Array, out: Array) -> None:
    """Write the upper triangle of `source` to `out`."""
    for a in range(out.shape[0]):
        for b in range(a, out.shape[0]):
            out[a, b] = source[a, b]


@inner
def add_products(row: Array, sums: Array) -> None:
    """Add the upper triangle of [X | u]^T [X | u] of a row (n, m + 1) to `sums`."""
    for i in range(row.shape[0]):
        for a in range(row.shape[1]):
            for b in range(a, row.shape[1]):
                sums[a, b] += row[i, a] * row[i, b]


@inner
def clear(matrix: Array) -> None:
    """Fill a matrix with zeros."""
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            matrix[i, j] = 0.0
