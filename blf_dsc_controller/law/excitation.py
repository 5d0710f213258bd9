# SPDX-License-Identifier: Apache-2.0
"""Excitation: the latch (27) and the rejection of disturbance columns.

Columns that the window cannot distinguish from the parameters are rejected: theta_j = 0.
"""

import numpy as np

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.law import consistency, window
from blf_dsc_controller.law.settings import BEST, Settings
from blf_dsc_controller.law.state import Signals, State

_WARM = 4  # inverse iterations from the previous direction
_COLD = 60  # from an arbitrary direction
_COMPARABLE = 0.95  # fraction of the best lambda_min
_FORGETTING = 0.1  # fraction of the best lambda_min lost per window


@inner
def reset_direction(settings: Settings, state: State) -> None:
    """Restart the inverse iteration, for a matrix that has changed."""
    for i in range(settings.m):
        state.min_eigenvector[i] = settings.m**-0.5


@inner
def reject_columns(settings: Settings, state: State, signals: Signals) -> None:
    """Reject the disturbance columns that this window cannot distinguish from the parameters.

    The window must excite the parameters without any column; then the column with the largest entry
    in the minimum eigenvector is rejected, repeatedly, until the rest is excited.  This happens at
    the first settled window that is excited enough, and once per window while a column is rejected.
    """
    for j in range(settings.p, settings.m):
        state.active[j] = 0.0
    reset_direction(settings, state)
    parameters_excited = window.excitation(settings, state, signals, _COLD) >= settings.sigma
    for j in range(settings.p, settings.m):
        state.active[j] = 1.0
    if not parameters_excited:
        state.columns_checked[0] = 0.0  # readmit all, until a window is excited
        reset_direction(settings, state)
        return
    state.columns_checked[0] = 1.0
    for _ in range(settings.p, settings.m):
        reset_direction(settings, state)
        if window.excitation(settings, state, signals, _COLD) >= settings.sigma:
            return
        worst = settings.p
        for j in range(settings.p, settings.m):
            strength = abs(state.min_eigenvector[j]) * state.active[j]
            if strength > abs(state.min_eigenvector[worst]) * state.active[worst]:
                worst = j
        state.active[worst] = 0.0


@inner
def readmit_columns(settings: Settings, state: State, signals: Signals) -> None:
    """Check rejected columns again, once per window: a later one may distinguish them."""
    rejected = 0.0
    for j in range(settings.p, settings.m):
        rejected += 1.0 - state.active[j]
    if rejected == 0.0 or not window.is_at_start(settings, state):
        return
    reject_columns(settings, state, signals)


@inner
def is_preferred(settings: Settings, state: State, value: float) -> bool:
    """Return whether a window with lambda_min `value` may replace the latched one.

    When the reference stops, `last` (27) would end with the weakest window above the threshold.  A
    weaker window only has less information, unless the latched one is old or contradicted.
    """
    if settings.latch == BEST:
        return bool(value > state.latched_lambda[0])
    return bool(settings.change_detection == 0 or value >= _COMPARABLE * state.best_lambda[0])


@inner
def update_excitation(
    settings: Settings, state: State, signals: Signals, t: float, dt: float, q: np.ndarray
) -> None:
    """Compute lambda_min of the window; from tau_d + T_a on, latch the window if it suffices (27).

    After a change of the arm the window need not be full, but must span at least T_a.
    """
    if state.rows[0] == 0.0:
        return
    period = settings.row_interval * dt
    settling_time = settings.learning_start - settings.window * period
    settled = state.rows[0] == settings.window or state.rows[0] * period >= settling_time
    learning = t >= settings.learning_start and settled
    if learning and state.columns_checked[0] == 0.0:
        reject_columns(settings, state, signals)
    elif learning:
        readmit_columns(settings, state, signals)
    value = window.excitation(settings, state, signals, _WARM)
    state.lambda_min[0] = value
    state.best_lambda[0] *= 1.0 - _FORGETTING * settings.interval / (
        settings.window * settings.row_interval
    )
    if not (learning and value >= settings.sigma and is_preferred(settings, state, value)):
        return
    consistent = settings.change_detection == 0
    if not (consistent or consistency.accept_window(settings, state, signals, q)):
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
