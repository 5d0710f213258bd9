# SPDX-License-Identifier: Apache-2.0
"""Sliding window (21), (22): its sums, and lambda_min of its Phi.

The window's sums of X^T [X | u] take constant time and do not drift.  A running sum
that adds the new and subtracts the old term accumulates a rounding error in every
sample.  The window therefore also keeps, beside the running sum S, the sum F of the
rows written since the ring last wrapped; at the next wrap F is the exact sum over the
ring and replaces S.  F also splits the window without further sums: with L, the sum of
the last complete half of the ring, the newest rows sum to F + L, F or F - L, one of
which has between a quarter and three quarters of the rows.

Eigenvalues are relative to the information R of the prior, which makes parameters of
different units comparable: Phi x = lambda R x.
"""

from math import sqrt
from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import called, inner
from blf_dsc_controller.compiled.layout import Array, Cell
from blf_dsc_controller.law.innovation import Prior
from blf_dsc_controller.law.sums import add, clear, copy
from blf_dsc_controller.numerics.algebra import cholesky_factor, cholesky_solve


class Settings(NamedTuple):
    """The size of the window, and what regularises its equations."""

    length: int  # N, rows in tau_d
    row_interval: int  # samples between two rows
    interval: int  # samples between two checks of the excitation
    regularization: float  # rho, of the Newton update
    prior_weight: float  # pull to the initial estimate, always


class State(NamedTuple):
    """Its rows and their sums."""

    cursor: Cell  # index of the oldest row
    rows: Cell  # number of rows
    running: Annotated[Array, 'm + 1', 'm + 1']  # S
    fresh: Annotated[Array, 'm + 1', 'm + 1']  # F
    half: Annotated[Array, 'm + 1', 'm + 1']  # L
    min_eigenvector: Annotated[Array, 'm']  # x of Phi x = lambda R x, x^T R x = 1
    ring: Annotated[Array, 'window.length', 'n', 'm + 1']


class Workspace(NamedTuple):
    """Equations of the current window, and scratch."""

    Phi: Annotated[Array, 'm', 'm']
    b: Annotated[Array, 'm']
    factor: Annotated[Array, 'm', 'm']  # of Phi + rho R
    solution: Annotated[Array, 'm']  # of Phi theta = b; scratch
    newer: Annotated[Array, 'm + 1', 'm + 1']  # sum of the newer part of the window
    part: Annotated[Array, 'm + 1', 'm + 1']  # of the part that is fitted


class Window(NamedTuple):
    """A window: its settings, its rows, and its equations."""

    settings: Settings
    state: State
    workspace: Workspace


@inner
def is_full(settings: Settings, state: State) -> bool:
    """Whether the window has all its rows."""
    return bool(state.rows[0] == settings.length)


@inner
def push_row(state: State, row: Array) -> None:
    """Replace the oldest row of the window by `row`, [X | u] (n, m + 1).

    The oldest row of the ring is at the cursor, and counts once the window is full.  The sums of
    [X | u]^T [X | u], S, F and L, have only their upper triangle filled.
    """
    running = state.running
    fresh = state.fresh
    half = state.half
    cursor = int(state.cursor[0])
    length = int(state.ring.shape[0])
    old = state.ring[cursor]
    n, size = row.shape
    counts = 1.0 if state.rows[0] == length else 0.0
    for a in range(size):
        for b in range(a, size):
            new_term = 0.0
            old_term = 0.0
            for i in range(n):
                new_term += row[i, a] * row[i, b]
                old_term += counts * old[i, a] * old[i, b]
            running[a, b] += new_term - old_term
            fresh[a, b] += new_term
    for i in range(n):
        for a in range(size):
            old[i, a] = row[i, a]
    state.rows[0] = min(state.rows[0] + 1.0, float(length))
    state.cursor[0] = float((cursor + 1) % length)
    if cursor + 1 == length // 2:
        copy(fresh, half)
    if cursor + 1 == length:
        if state.rows[0] == length:
            copy(fresh, running)
        add(fresh, -1.0, half, half)
        clear(fresh)


@inner
def newer_part(state: State, newer: Array) -> int:
    """Fill `newer` (m + 1, m + 1) with the sum of the newer part of a full ring.

    Return its number of rows, between a quarter and three quarters of all.
    """
    cursor = int(state.cursor[0])
    length = int(state.ring.shape[0])
    middle = length // 2
    if 4 * cursor < length:
        add(state.fresh, 1.0, state.half, newer)
        return cursor + length - middle
    if 4 * cursor > 3 * length:
        add(state.fresh, -1.0, state.half, newer)
        return cursor - middle
    copy(state.fresh, newer)
    return cursor


@inner
def average_window(running: Array, samples: int, Phi: Array, b: Array) -> None:
    """Fill Phi (m, m) and b (m,), the means (21) and (22) over `samples` rows.

    `running` (m + 1, m + 1) is the sum of their [X | u]^T [X | u].
    """
    m = Phi.shape[0]
    for i in range(m):
        b[i] = running[i, m] / samples
        for j in range(i, m):
            Phi[i, j] = running[i, j] / samples
            Phi[j, i] = Phi[i, j]


@inner
def pull_to(
    target: Array, weight: float, information: Array, Phi: Array, b: Array
) -> None:
    """Pull theta to `target` (m,) by `weight` a times R:  Phi + a R,  b + a R target."""
    for i in range(b.size):
        pull = weight * target[i]
        for j in range(b.size):
            Phi[i, j] += weight * information[i, j]
            b[j] += pull * information[i, j]


@called
def regularized_factor(
    active: Array,
    rho: float,
    information: Array,
    Phi: Array,
    b: Array,
    factor: Array,
) -> None:
    """Remove the rejected columns (theta_j = 0); fill `factor` with that of Phi + rho R."""
    for i in range(active.size):
        if active[i] == 0.0:
            for j in range(active.size):
                Phi[i, j] = 0.0
                Phi[j, i] = 0.0
            Phi[i, i] = 1.0
            b[i] = 0.0
    for i in range(Phi.shape[0]):
        for j in range(i + 1):
            factor[j, i] = Phi[i, j] + rho * information[i, j]
    cholesky_factor(factor)


@inner
def quadratic_form(A: Array, x: Array, product: Array) -> float:
    """Return x^T A x of a symmetric A (m, m), and write A x (m,) to `product`."""
    for i in range(x.size):
        product[i] = 0.0
    for j in range(x.size):  # by rows of A, which are contiguous
        for i in range(x.size):
            product[i] += A[j, i] * x[j]
    square = 0.0
    for i in range(x.size):
        square += x[i] * product[i]
    return square


@called
def min_eigenvector(
    Phi: Array,
    information: Array,
    factor: Array,
    direction: Array,
    workspace: Array,
    iterations: int,
) -> float:
    """Return lambda_min(Phi) relative to R by inverse iteration, which refines `direction`.

    The direction x is the eigenvector of Phi x = lambda R x with x^T R x = 1.

    From a warm start a few iterations suffice (the error of the Rayleigh quotient is
    the square of the direction's), at a fixed cost and without the O(m^3) of an
    eigenvalue decomposition.

    `factor` is the Cholesky factor of Phi + rho R, `workspace` (m,) scratch.
    """
    m = direction.size
    quadratic_form(information, direction, workspace)
    for _ in range(iterations):
        for i in range(m):
            direction[i] = workspace[i]
        cholesky_solve(factor, direction)
        shrink = 1.0 / sqrt(quadratic_form(information, direction, workspace))
        for i in range(m):
            direction[i] *= shrink
            workspace[i] *= shrink
    return quadratic_form(Phi, direction, workspace)


@inner
def solve(
    settings: Settings, workspace: Workspace, information: Array, active: Array
) -> None:
    """Factor Phi + rho R, and solve Phi theta = b, with theta in `workspace.solution`.

    Columns that are not `active` (m,) are removed; `information` is R (m, m).
    """
    regularized_factor(
        active,
        settings.regularization,
        information,
        workspace.Phi,
        workspace.b,
        workspace.factor,
    )
    for j in range(workspace.b.size):
        workspace.solution[j] = workspace.b[j]
    cholesky_solve(workspace.factor, workspace.solution)


@inner
def forget(state: State) -> None:
    """Discard all rows."""
    state.rows[0] = 0.0
    state.cursor[0] = 0.0
    clear(state.running)
    clear(state.fresh)
    clear(state.half)
    reset_direction(state)


@inner
def keep_newer(state: State, newer: Array, rows: int) -> None:
    """Keep only the newer part of the rows, `rows` with the sum `newer` (of `newer_part`)."""
    state.rows[0] = float(rows)
    copy(newer, state.running)
    reset_direction(state)


@inner
def reset_direction(state: State) -> None:
    """Restart the inverse iteration, for a matrix that has changed."""
    for j in range(state.min_eigenvector.size):
        state.min_eigenvector[j] = 1.0 / sqrt(state.min_eigenvector.size)


@inner
def fill_equations(
    settings: Settings, workspace: Workspace, prior: Prior, sums: Array, rows: int
) -> None:
    """Fill Phi and b of some `rows`, whose sum (m + 1, m + 1) of [X | u]^T [X | u] is `sums`.

    Both are pulled to P^(0) by the prior, if the settings say so.
    """
    average_window(sums, rows, workspace.Phi, workspace.b)
    if settings.prior_weight > 0.0:
        pull_to(
            prior.estimate,
            settings.prior_weight,
            prior.information,
            workspace.Phi,
            workspace.b,
        )


@inner
def find_excitation(
    sliding: Window, prior: Prior, active: Array, iterations: int
) -> float:
    """Return lambda_min of the window's Phi (27); leave Phi, b and the factor in its workspace.

    Columns that are not `active` (m,) are removed.  The inverse iteration begins where the last
    one ended.
    """
    settings, state, workspace = sliding
    R = prior.information
    fill_equations(settings, workspace, prior, state.running, int(state.rows[0]))
    regularized_factor(
        active, settings.regularization, R, workspace.Phi, workspace.b, workspace.factor
    )
    return min_eigenvector(
        workspace.Phi,
        R,
        workspace.factor,
        state.min_eigenvector,
        workspace.solution,
        iterations,
    )


@inner
def is_at_start(settings: Settings, state: State) -> bool:
    """Whether the ring has wrapped since the last check: true once per window."""
    return bool(state.cursor[0] * settings.row_interval < settings.interval)
