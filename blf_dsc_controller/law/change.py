# SPDX-License-Identifier: Apache-2.0
"""Whether the arm has changed: rows contradict the latched solution, or the rows before them.

The mean square error of the solution of a full window over the last 0.1 s is compared
with the residual that it had.  As long as the window is not full, and until the first
full one is latched, each row is compared with what the rows so far and the prior
predict (see `innovation`): a window that has a pick-up in it is a mixture of two arms,
which may leave no more than the unmodelled torque, and the solution of few rows does
not predict the next ones.

If the arm has changed, window, filters and latch are cleared, and learning restarts.
What a window has taught before it was full is taken back: it did not predict what it
was not fitted to.
"""

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.law import adaptation, innovation, sums, window
from blf_dsc_controller.law.excitation import explained
from blf_dsc_controller.law.state import Settings, Signals, State
from blf_dsc_controller.numerics.algebra import cholesky_factor, cholesky_solve

# ratio of mean squares; larger than the gate's, since a solution extrapolates
_ALARM = 8.0
_MEMORY = 0.1  # s, averaging time of the last rows


@inner
def detect_change(
    settings: Settings, state: State, signals: Signals, dt: float
) -> None:
    """Forget the window if the arm has changed: its rows contradict the solution, or each other.

    What a window has taught before it was full is taken back: back to the estimate
    before.
    """
    if is_predicted(settings, state):
        has_changed = contradicts_rows(settings, state, signals, dt)
    else:
        has_changed = contradicts_solution(settings, state, signals, dt)
    if not has_changed:
        return
    state.changes[0] += 1.0
    state.contradiction[0] = state.recent_residual[0]
    if state.latched[0] == 1.0 and state.rows[0] < settings.window:
        for j in range(settings.m):
            signals.work[j] = state.estimate[j]
            state.estimate[j] = state.anchor[j]
        if settings.bumpless == 1:
            adaptation.hand_over(settings, state, signals)
    forget_window(settings, state)
    state.rows_statistics[innovation.RECENT] = 0.0
    fit_rows(settings, state, settings.row_interval * dt)


@inner
def is_predicted(settings: Settings, state: State) -> bool:
    """Whether rows are compared with those before them, as long as no full window is known.

    Without a prior, as of planar arms, the first rows predict too little.
    """
    is_full = state.rows[0] == settings.window and state.least_residual[0] > 0.0
    return bool(settings.prior_weight > 0.0 and not is_full)


@inner
def compare_row(
    settings: Settings, state: State, signals: Signals, theta: Array, period: float
) -> None:
    """Write e = u - X theta of this row to `signals.innovation`; average its square.

    `period` [s] is the time from one row to the next.
    """
    square = 0.0
    for i in range(settings.n):
        error = signals.row[i, settings.m]
        for j in range(settings.m):
            error -= signals.row[i, j] * theta[j]
        signals.innovation[i] = error
        square += error * error
    state.recent_residual[0] += min(1.0, period / _MEMORY) * (
        square - state.recent_residual[0]
    )


@inner
def contradicts_solution(
    settings: Settings, state: State, signals: Signals, dt: float
) -> bool:
    """Compare this row with the latched solution; return whether the last ones contradict it."""
    if state.latched[0] == 0.0:
        return False
    compare_row(settings, state, signals, state.solution, dt)
    allowed = _ALARM * explained(settings, state, state.residual[0])
    return bool(state.recent_residual[0] > allowed)


@inner
def contradicts_rows(
    settings: Settings, state: State, signals: Signals, dt: float
) -> bool:
    """Compare this row with those before it; return whether the last ones contradict them."""
    samples = int(state.samples[0])
    if samples % settings.row_interval != 0:
        return False
    period = settings.row_interval * dt
    unmodelled = settings.residual_floor / settings.n
    statistics = state.rows_statistics
    if statistics[innovation.NOISE] == 0.0:
        innovation.start(unmodelled, statistics)
        fit_rows(settings, state, period)
    compare_row(settings, state, signals, state.rows_fit, period)
    for i in range(settings.n):
        for j in range(settings.m):
            signals.predicted[i, j] = signals.row[i, j]
    square = innovation.normalized_square(
        signals.predicted,
        signals.innovation,
        state.rows_factor,
        period,
        signals.covariance,
    )
    if innovation.update(square, unmodelled, period, settings.window, statistics):
        return True
    refresh = max(1, round(innovation.REFRESH / period))
    # a quarter later than the excitation is checked: each takes its time
    if samples // settings.row_interval % refresh == refresh // 4:
        fit_rows(settings, state, period)
    return False


@inner
def fit_rows(settings: Settings, state: State, period: float) -> None:
    """Solve for theta of the rows so far, one each `period` [s], and of the prior."""
    a = innovation.row_variance(state.rows_statistics, period)
    factor = state.rows_factor
    theta = state.rows_fit
    window.average_window(state.running, 1, factor, theta)
    window.pull_to(settings.initial_estimate, a, settings.information, factor, theta)
    cholesky_factor(factor)
    cholesky_solve(factor, theta)


@inner
def forget_window(settings: Settings, state: State) -> None:
    """Clear the window, its filters and the latch; the estimate stays and becomes the anchor."""
    state.latched[0] = 0.0
    state.best_lambda[0] = 0.0
    state.recent_residual[0] = 0.0
    state.rows[0] = 0.0
    state.cursor[0] = 0.0
    sums.clear(state.running)
    sums.clear(state.fresh)
    sums.clear(state.half)
    sums.clear(state.filter1)
    sums.clear(state.filter2)
    for j in range(settings.m):
        state.anchor[j] = state.estimate[j]
    window.reset_direction(state)
