# SPDX-License-Identifier: Apache-2.0
"""How well the window excites the parameters, and the latch (27) that keeps an excited window."""

from math import sqrt

import numpy as np

from blf_dsc_controller.core import cholesky, window
from blf_dsc_controller.core.kernel import kernel
from blf_dsc_controller.core.settings import Settings
from blf_dsc_controller.core.state import Signals, State

_ITERATIONS = 4


@kernel
def weakest_direction(
    Phi: np.ndarray, factor: np.ndarray, direction: np.ndarray, work: np.ndarray
) -> float:
    """lambda_min(Phi) by inverse iteration, going on from the last look's `direction`.

    Exact in the limit; from a warm start a few iterations are (the Rayleigh quotient's error is the
    square of the direction's), at a fixed cost and without the m^3 of an eigenvalue decomposition.

    Args:
        Phi: excitation matrix (m, m).
        factor: Cholesky factor of Phi + rho I.
        direction: unit vector (m,), improved in place.
        work: scratch (m,).
    """
    m = direction.size
    for _ in range(_ITERATIONS):
        cholesky.solve(factor, direction)
        square = 0.0
        for i in range(m):
            square += direction[i] * direction[i]
        for i in range(m):
            direction[i] /= sqrt(square)
    quotient = 0.0
    for i in range(m):
        work[i] = 0.0
        for j in range(m):
            work[i] += Phi[i, j] * direction[j]
        quotient += direction[i] * work[i]
    return quotient


@kernel
def look(settings: Settings, state: State, signals: Signals, t: float) -> None:
    """Measure the present window's excitation; from tau_d + T_a on, latch it where it suffices."""
    window.average(state.running, int(state.rows[0]), signals.Phi, signals.b)
    cholesky.factor(signals.Phi, settings.rho, signals.factor)
    state.lambda_min[0] = weakest_direction(
        signals.Phi, signals.factor, state.weakest, signals.look
    )
    if t >= settings.learning_start and state.lambda_min[0] >= settings.sigma:
        state.Phi[:, :] = signals.Phi
        state.factor[:, :] = signals.factor
        state.b[:] = signals.b
        state.latched[0] = 1.0
        state.latch_time[0] = t
