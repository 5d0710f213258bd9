# SPDX-License-Identifier: Apache-2.0
"""Excitation: the sliding window (21), (22), lambda_min of its Phi, and the latch (27).

The window's sums of X^T [X | u] take constant time and do not drift.  A running sum that adds the
new and subtracts the old term accumulates one rounding error a sample.  Beside the running sum S
the window keeps F, the sum of what was written since the ring last wrapped; at the wrap F is the
exact content of the ring and replaces S.

Disturbance columns that the window cannot tell from the parameters are rejected: theta_j = 0.
"""

from math import sqrt

import numpy as np

from blf_dsc_controller.compiled.jit import called, inner
from blf_dsc_controller.law import cholesky, consistency
from blf_dsc_controller.law.settings import BEST, Settings
from blf_dsc_controller.law.state import Signals, State

_WARM = 4  # inverse iterations from the previous direction
_COLD = 60  # from any direction
_COMPARABLE = 0.95  # of the best lambda_min
_FORGETTING = 0.1  # of the best lambda_min in the time of a window


@inner
def push_row(
    ring: np.ndarray,
    cursor: int,
    running: np.ndarray,
    fresh: np.ndarray,
    row: np.ndarray,
    is_full: bool,
) -> int:
    """Replace the oldest row of the window by `row` and return the next cursor.

    `ring` (N, n, m + 1) has the oldest row at `cursor`, which counts once the window is full;
    `running` S and `fresh` F (m + 1, m + 1), the sums of [X | u]^T [X | u], are filled in the upper
    triangle; `row` is [X | u] (n, m + 1).
    """
    old = ring[cursor]
    n = row.shape[0]
    m = row.shape[1] - 1
    keep = 1.0 if is_full else 0.0
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
    if cursor < ring.shape[0]:
        return cursor
    for a in range(m + 1):
        for b in range(a, m + 1):
            running[a, b] = fresh[a, b]
            fresh[a, b] = 0.0
    return 0


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
def min_eigenvector(
    Phi: np.ndarray, factor: np.ndarray, direction: np.ndarray, work: np.ndarray, iterations: int
) -> float:
    """lambda_min(Phi) by inverse iteration, which improves `direction`, its unit eigenvector.

    From a warm start a few iterations suffice (the error of the Rayleigh quotient is the square of
    the direction's), at a fixed cost and without the m^3 of an eigenvalue decomposition.

    `factor` is the Cholesky factor of Phi + rho I, `work` (m,) scratch.
    """
    m = direction.size
    for _ in range(iterations):
        cholesky.solve(factor, direction)
        square = 0.0
        for i in range(m):
            square += direction[i] * direction[i]
        shrink = 1.0 / sqrt(square)
        for i in range(m):
            direction[i] *= shrink
    quotient = 0.0
    for i in range(m):
        work[i] = 0.0
        for j in range(m):
            work[i] += Phi[i, j] * direction[j]
        quotient += direction[i] * work[i]
    return quotient


@inner
def remove_rejected(active: np.ndarray, Phi: np.ndarray, b: np.ndarray) -> None:
    """Remove the rejected columns from Phi theta = b: theta_j = 0 instead."""
    for i in range(active.size):
        if active[i] == 0.0:
            for j in range(active.size):
                Phi[i, j] = 0.0
                Phi[j, i] = 0.0
            Phi[i, i] = 1.0
            b[i] = 0.0


@called
def min_eigenvalue(
    running: np.ndarray,
    samples: int,
    active: np.ndarray,
    rho: float,
    Phi: np.ndarray,
    b: np.ndarray,
    factor: np.ndarray,
    direction: np.ndarray,
    work: np.ndarray,
    iterations: int,
) -> float:
    """lambda_min of the present window's Phi, which is computed with b and its factor."""
    average_window(running, samples, Phi, b)
    remove_rejected(active, Phi, b)
    cholesky.factor(Phi, rho, factor)
    return min_eigenvector(Phi, factor, direction, work, iterations)


@inner
def window_excitation(settings: Settings, state: State, signals: Signals, iterations: int) -> float:
    """lambda_min of the present window's Phi, which is left in `signals` with b and its factor."""
    return min_eigenvalue(
        state.running,
        int(state.rows[0]),
        state.active,
        settings.rho,
        signals.Phi,
        signals.b,
        signals.factor,
        state.min_eigenvector,
        signals.work,
        iterations,
    )


@inner
def reset_direction(settings: Settings, state: State) -> None:
    """Start the inverse iteration afresh, for a matrix that has changed."""
    for i in range(settings.m):
        state.min_eigenvector[i] = settings.m**-0.5


@inner
def reject_columns(settings: Settings, state: State, signals: Signals) -> None:
    """Reject the disturbance columns that this window cannot tell from the parameters.

    Only if the window excites the parameters without any column; then the column with the largest
    entry in the minimum eigenvector is rejected, until the rest is excited.  This happens once, at
    the first full window that is excited enough: a column that came and went would move the
    estimates.
    """
    for j in range(settings.p, settings.m):
        state.active[j] = 0.0
    reset_direction(settings, state)
    parameters_excited = window_excitation(settings, state, signals, _COLD) >= settings.sigma
    for j in range(settings.p, settings.m):
        state.active[j] = 1.0
    if not parameters_excited:
        state.columns_checked[0] = 0.0  # all are back, until a window is excited
        reset_direction(settings, state)
        return
    state.columns_checked[0] = 1.0
    for _ in range(settings.p, settings.m):
        reset_direction(settings, state)
        if window_excitation(settings, state, signals, _COLD) >= settings.sigma:
            return
        worst = settings.p
        for j in range(settings.p, settings.m):
            strength = abs(state.min_eigenvector[j]) * state.active[j]
            if strength > abs(state.min_eigenvector[worst]) * state.active[worst]:
                worst = j
        state.active[worst] = 0.0


@inner
def readmit_columns(settings: Settings, state: State, signals: Signals) -> None:
    """Check rejected columns again, once a window: a later one may tell them apart."""
    rejected = 0.0
    for j in range(settings.p, settings.m):
        rejected += 1.0 - state.active[j]
    if rejected == 0.0 or state.cursor[0] >= settings.interval:
        return
    reject_columns(settings, state, signals)


@inner
def is_preferred(settings: Settings, state: State, value: float) -> bool:
    """Whether a window of this lambda_min may replace the latched one.

    When the reference stops, `last` (27) would end on the weakest window above the threshold.  A
    weaker window only has less information, unless the latched one is old or contradicted.
    """
    if settings.latch == BEST:
        return value > state.latched_lambda[0]
    return settings.change_detection == 0 or value >= _COMPARABLE * state.best_lambda[0]


@inner
def update_excitation(
    settings: Settings, state: State, signals: Signals, t: float, dt: float
) -> None:
    """Compute lambda_min of the window; latch it from tau_d + T_a on if it suffices (27).

    After a change of the arm a window need not be full, but must have lasted T_a.
    """
    if state.rows[0] == 0.0:
        return
    settling_time = settings.learning_start - settings.window * dt
    settled = state.rows[0] == settings.window or state.rows[0] * dt >= settling_time
    learning = t >= settings.learning_start and settled
    if learning and state.columns_checked[0] == 0.0:
        reject_columns(settings, state, signals)
    elif learning:
        readmit_columns(settings, state, signals)
    value = window_excitation(settings, state, signals, _WARM)
    state.lambda_min[0] = value
    state.best_lambda[0] *= 1.0 - _FORGETTING * settings.interval / settings.window
    if not (learning and value >= settings.sigma and is_preferred(settings, state, value)):
        return
    if settings.change_detection == 1 and not consistency.accept_window(settings, state, signals):
        return
    for i in range(settings.m):
        state.b[i] = signals.b[i]
        for j in range(settings.m):
            state.Phi[i, j] = signals.Phi[i, j]
            state.factor[i, j] = signals.factor[i, j]
    state.latched[0] = 1.0
    state.latched_lambda[0] = value
    if state.rows[0] == settings.window:
        state.best_lambda[0] = max(value, state.best_lambda[0])
    state.latch_time[0] = t
