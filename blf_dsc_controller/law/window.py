# SPDX-License-Identifier: Apache-2.0
"""Sliding window (21), (22): its sums, and lambda_min of its Phi.

The window's sums of X^T [X | u] take constant time and do not drift.  A running sum that adds the
new and subtracts the old term accumulates a rounding error in every sample.  The window therefore
also keeps, beside the running sum S, the sum F of the rows written since the ring last wrapped; at
the next wrap F is the exact sum over the ring and replaces S.  F also splits the window without
further sums: with L, the sum of the last complete half of the ring, the newest rows sum to F + L,
F or F - L, one of which has between a quarter and three quarters of the rows.

Eigenvalues are relative to the information R of the prior, which makes parameters of different
units comparable: Phi x = lambda R x.
"""

from math import sqrt

import numpy as np

from blf_dsc_controller.compiled import cholesky
from blf_dsc_controller.compiled.jit import called, inner
from blf_dsc_controller.law.settings import Settings
from blf_dsc_controller.law.state import Signals, State


@inner
def push_row(
    ring: np.ndarray,
    cursor: int,
    running: np.ndarray,
    fresh: np.ndarray,
    half: np.ndarray,
    row: np.ndarray,
    rows: int,
) -> int:
    """Replace the oldest row of the window by `row` and return the next cursor.

    `ring` (N, n, m + 1) has the oldest row at `cursor`, which counts once the window is full
    (`rows` = N); `running` S, `fresh` F and `half` L (m + 1, m + 1), sums of [X | u]^T [X | u],
    have only their upper triangle filled; `row` is [X | u] (n, m + 1).
    """
    old = ring[cursor]
    n = row.shape[0]
    m = row.shape[1] - 1
    keep = 1.0 if rows == ring.shape[0] else 0.0
    for a in range(m + 1):
        for b in range(a, m + 1):
            new_term = 0.0
            old_term = 0.0
            for i in range(n):
                new_term += row[i, a] * row[i, b]
                old_term += keep * old[i, a] * old[i, b]
            running[a, b] += new_term - old_term
            fresh[a, b] += new_term
    for i in range(n):
        for a in range(m + 1):
            old[i, a] = row[i, a]
    cursor += 1
    if cursor == ring.shape[0] // 2:
        add(fresh, 0.0, half, half)
    if cursor < ring.shape[0]:
        return cursor
    if rows >= ring.shape[0] - 1:
        add(fresh, 0.0, fresh, running)
    add(fresh, -1.0, half, half)
    clear(fresh)
    return 0


@inner
def add(first: np.ndarray, weight: float, second: np.ndarray, out: np.ndarray) -> None:
    """Write the upper triangle of `first` + `weight` `second` to `out`."""
    for a in range(out.shape[0]):
        for b in range(a, out.shape[0]):
            out[a, b] = first[a, b] + weight * second[a, b]


@inner
def add_products(row: np.ndarray, sums: np.ndarray) -> None:
    """Add the upper triangle of [X | u]^T [X | u] of a row (n, m + 1) to `sums`."""
    for i in range(row.shape[0]):
        for a in range(row.shape[1]):
            for b in range(a, row.shape[1]):
                sums[a, b] += row[i, a] * row[i, b]


@inner
def clear(matrix: np.ndarray) -> None:
    """Fill a matrix with zeros."""
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            matrix[i, j] = 0.0


@inner
def newer_part(
    cursor: int, length: int, fresh: np.ndarray, half: np.ndarray, newer: np.ndarray
) -> int:
    """Fill `newer` with the sum of the newer part of a full ring; return its number of rows."""
    middle = length // 2
    if 4 * cursor < length:
        add(fresh, 1.0, half, newer)
        return cursor + length - middle
    if 4 * cursor > 3 * length:
        add(fresh, -1.0, half, newer)
        return cursor - middle
    add(fresh, 0.0, half, newer)
    return cursor


@inner
def average_window(running: np.ndarray, samples: int, Phi: np.ndarray, b: np.ndarray) -> None:
    """Fill Phi (m, m) and b (m,), the means (21) and (22) over the window."""
    m = Phi.shape[0]
    for i in range(m):
        b[i] = running[i, m] / samples
        for j in range(i, m):
            Phi[i, j] = running[i, j] / samples
            Phi[j, i] = Phi[i, j]


@inner
def pull_to(
    target: np.ndarray, weight: float, information: np.ndarray, Phi: np.ndarray, b: np.ndarray
) -> None:
    """Pull theta to `target` (m,) by `weight` a times R:  Phi + a R,  b + a R target."""
    for i in range(b.size):
        pull = weight * target[i]
        for j in range(b.size):
            Phi[i, j] += weight * information[i, j]
            b[j] += pull * information[i, j]


@inner
def remove_rejected(active: np.ndarray, Phi: np.ndarray, b: np.ndarray) -> None:
    """Remove the rejected columns from Phi theta = b, setting theta_j = 0."""
    for i in range(active.size):
        if active[i] == 0.0:
            for j in range(active.size):
                Phi[i, j] = 0.0
                Phi[j, i] = 0.0
            Phi[i, i] = 1.0
            b[i] = 0.0


@inner
def regularized_factor(
    active: np.ndarray,
    rho: float,
    information: np.ndarray,
    Phi: np.ndarray,
    b: np.ndarray,
    factor: np.ndarray,
) -> None:
    """Remove the rejected columns; fill `factor` with the Cholesky factor of Phi + rho R."""
    remove_rejected(active, Phi, b)
    for i in range(Phi.shape[0]):
        for j in range(i + 1):
            factor[j, i] = Phi[i, j] + rho * information[i, j]
    cholesky.factor(factor)


@inner
def weigh(information: np.ndarray, x: np.ndarray, out: np.ndarray) -> float:
    """Write R x (m,) to `out`; return x^T R x."""
    for i in range(x.size):
        out[i] = 0.0
    for j in range(x.size):  # R is symmetric: traversed by rows, which are contiguous
        for i in range(x.size):
            out[i] += information[j, i] * x[j]
    square = 0.0
    for i in range(x.size):
        square += x[i] * out[i]
    return square


@inner
def min_eigenvector(
    Phi: np.ndarray,
    information: np.ndarray,
    factor: np.ndarray,
    direction: np.ndarray,
    work: np.ndarray,
    iterations: int,
) -> float:
    """Return lambda_min(Phi) relative to R by inverse iteration, which refines `direction`.

    The direction x is the eigenvector of Phi x = lambda R x with x^T R x = 1.

    From a warm start a few iterations suffice (the error of the Rayleigh quotient is the square of
    the direction's), at a fixed cost and without the O(m^3) of an eigenvalue decomposition.

    `factor` is the Cholesky factor of Phi + rho R, `work` (m,) scratch.
    """
    m = direction.size
    weigh(information, direction, work)
    for _ in range(iterations):
        for i in range(m):
            direction[i] = work[i]
        cholesky.solve(factor, direction)
        shrink = 1.0 / sqrt(weigh(information, direction, work))
        for i in range(m):
            direction[i] *= shrink
            work[i] *= shrink
    return weigh(Phi, direction, work)


@called
def min_eigenvalue(
    running: np.ndarray,
    samples: int,
    active: np.ndarray,
    prior: np.ndarray,
    prior_weight: float,
    rho: float,
    information: np.ndarray,
    Phi: np.ndarray,
    b: np.ndarray,
    factor: np.ndarray,
    direction: np.ndarray,
    work: np.ndarray,
    iterations: int,
) -> float:
    """Return lambda_min of the current window's Phi; fill Phi, b and its factor."""
    average_window(running, samples, Phi, b)
    if prior_weight > 0.0:
        pull_to(prior, prior_weight, information, Phi, b)
    regularized_factor(active, rho, information, Phi, b, factor)
    return min_eigenvector(Phi, information, factor, direction, work, iterations)


@inner
def excitation(settings: Settings, state: State, signals: Signals, iterations: int) -> float:
    """Return lambda_min of the current window's Phi; leave Phi, b and its factor in `signals`."""
    return min_eigenvalue(
        state.running,
        int(state.rows[0]),
        state.active,
        settings.initial_estimate,
        settings.prior_weight,
        settings.rho,
        settings.information,
        signals.Phi,
        signals.b,
        signals.factor,
        state.min_eigenvector,
        signals.work,
        iterations,
    )


@inner
def is_at_start(settings: Settings, state: State) -> bool:
    """Return whether the ring has wrapped since the last check: true once per window."""
    return bool(state.cursor[0] * settings.row_interval < settings.interval)
