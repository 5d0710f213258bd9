# SPDX-License-Identifier: Apache-2.0
"""How well the window excites the parameters, and the latch (27) that keeps an excited window."""

from math import sqrt

import numpy as np

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.law import cholesky, window
from blf_dsc_controller.law.settings import BEST, Settings
from blf_dsc_controller.law.state import Signals, State

_WARM = 4  # inverse iterations from the last look's direction
_COLD = 60  # from anywhere


@inner
def weakest_direction(
    Phi: np.ndarray, factor: np.ndarray, direction: np.ndarray, work: np.ndarray, iterations: int
) -> float:
    """lambda_min(Phi) by inverse iteration, going on from `direction`.

    Exact in the limit; from a warm start a few iterations are (the Rayleigh quotient's error is the
    square of the direction's), at a fixed cost and without the m^3 of an eigenvalue decomposition.

    Args:
        Phi: excitation matrix (m, m).
        factor: Cholesky factor of Phi + rho I.
        direction: unit vector (m,), improved in place.
        work: scratch (m,).
        iterations: how many.
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
def leave_out(active: np.ndarray, Phi: np.ndarray, b: np.ndarray) -> None:
    """Take the columns that are not active out of Phi theta = b: theta_j = 0 instead."""
    for i in range(active.size):
        if active[i] == 0.0:
            for j in range(active.size):
                Phi[i, j] = 0.0
                Phi[j, i] = 0.0
            Phi[i, i] = 1.0
            b[i] = 0.0


@inner
def measure(settings: Settings, state: State, signals: Signals, iterations: int) -> float:
    """lambda_min of the present window's Phi, which is left in `signals` with b and its factor."""
    window.average(state.running, int(state.rows[0]), signals.Phi, signals.b)
    leave_out(state.active, signals.Phi, signals.b)
    cholesky.factor(signals.Phi, settings.rho, signals.factor)
    return weakest_direction(signals.Phi, signals.factor, state.weakest, signals.look, iterations)


@inner
def restart(settings: Settings, state: State) -> None:
    """Forget the weakest direction: the matrix it belonged to has changed."""
    for i in range(settings.m):
        state.weakest[i] = settings.m**-0.5


@inner
def judge(settings: Settings, state: State, signals: Signals) -> None:
    """Refuse the disturbance columns that this window cannot tell from the parameters.

    Only where the window excites the parameters without any of the columns; then the column that
    is strongest in the weakest direction goes, until the rest is excited.  Done once, at the first
    full window that is good enough: a column that came and went would move the estimates.
    """
    for j in range(settings.p, settings.m):
        state.active[j] = 0.0
    restart(settings, state)
    parameters_excited = measure(settings, state, signals, _COLD) >= settings.sigma
    for j in range(settings.p, settings.m):
        state.active[j] = 1.0
    if not parameters_excited:
        restart(settings, state)
        return
    state.judged[0] = 1.0
    for _ in range(settings.p, settings.m):
        restart(settings, state)
        if measure(settings, state, signals, _COLD) >= settings.sigma:
            return
        worst = settings.p
        for j in range(settings.p, settings.m):
            strength = abs(state.weakest[j]) * state.active[j]
            if strength > abs(state.weakest[worst]) * state.active[worst]:
                worst = j
        state.active[worst] = 0.0


@inner
def look(settings: Settings, state: State, signals: Signals, t: float) -> None:
    """Measure the present window's excitation; from tau_d + T_a on, latch it where it suffices."""
    learning = t >= settings.learning_start
    if learning and state.judged[0] == 0.0:
        judge(settings, state, signals)
    value = measure(settings, state, signals, _WARM)
    state.lambda_min[0] = value
    better = settings.latch != BEST or value > state.latched_lambda[0]
    if learning and value >= settings.sigma and better:
        for i in range(settings.m):
            state.b[i] = signals.b[i]
            for j in range(settings.m):
                state.Phi[i, j] = signals.Phi[i, j]
                state.factor[i, j] = signals.factor[i, j]
        state.latched[0] = 1.0
        state.latched_lambda[0] = value
        state.latch_time[0] = t
