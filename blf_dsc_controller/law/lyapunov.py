# SPDX-License-Identifier: Apache-2.0
"""The Lyapunov function (29), term by term, for watching a run whose truth is known."""

import numpy as np

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.law import barrier
from blf_dsc_controller.law.settings import LINEAR, Settings
from blf_dsc_controller.law.state import Signals, State


@inner
def error_term(settings: Settings, signals: Signals) -> float:
    """Barrier potential (3) of xi1, weighted; w z1^2 / 2 for the laws without a barrier   [J]."""
    total = 0.0
    for i in range(settings.n):
        if settings.surface == LINEAR:
            total += 0.5 * settings.weight[i] * signals.xi1[i] ** 2
        else:
            total += barrier.potential(
                signals.xi1[i],
                signals.bound[i],
                settings.weight[i],
                settings.slope_limit[i],
                signals.knee[i],
            )
    return total


@inner
def kinetic_term(settings: Settings, signals: Signals, q: np.ndarray) -> float:
    """xi2^T M xi2 / 2 [J], by M xi2 = Yp(q, xi2) P; overwrites Yp and Yr in `signals`."""
    settings.model.momentum_regressor(q, signals.xi2, signals.momentum, signals.rest)
    total = 0.0
    for i in range(settings.n):
        for j in range(settings.p):
            total += 0.5 * signals.xi2[i] * signals.momentum[i, j] * settings.true_parameters[j]
    return total


@inner
def parameter_term(settings: Settings, state: State) -> float:
    """P~^T Gamma^-1 P~ / 2; parameters that are not adapted (Gamma_j = 0) do not count."""
    total = 0.0
    for j in range(settings.p):
        if settings.Gamma[j] > 0.0:
            error = settings.true_parameters[j] - state.estimate[j]
            total += 0.5 * error * error / settings.Gamma[j]
    return total


@inner
def disturbance_term(settings: Settings, state: State, signals: Signals) -> float:
    """(tau_dist - d^3)^2 / (2 gamma); joints whose d^3 is not adapted do not count."""
    total = 0.0
    for i in range(settings.n):
        if settings.gamma[i] > 0.0:
            error = signals.known[i] - state.disturbance[i]
            total += 0.5 * error * error / settings.gamma[i]
    return total
