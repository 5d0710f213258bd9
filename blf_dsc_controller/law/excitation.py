# SPDX-License-Identifier: Apache-2.0
"""Which windows are learned from: those that are excited (27), and of one and the same arm.

Disturbance columns that a window cannot distinguish from the parameters are rejected:
theta_j = 0.

A window that spans a change of the arm (a payload, a contact) contradicts itself
although it is excited; its least-squares solution is a mixture, and the Newton step
would solve it exactly.  The mean of u^T u, kept with Phi and b, gives the residual of
the solution,

    r^2 = mean(u^T u) - b^T theta_LS   [(N m)^2],

and a window is latched only if r^2 is at most four times the smallest of any full
window, or what unmodelled torque explains (configured, but no more than the smallest
residual shows), and if its solution gives the arm a positive inertia, which the
residual does not show.  The first full window has only its own parts as a measure:
fitted apart, neither may explain its rows better than by that factor, else the older
part is removed from the window; again only if the residual has halved since, since
parts of a period never agree about a lasting disturbance.

After a change of the arm (see `change`) and until the new window is full, it does not
average out disturbances, so its solution is pulled to the estimate before the change,
most strongly in weakly excited directions.  Likewise, a full window with an unusually
large residual is pulled to an earlier solution, kept once per window.
"""

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.law import sums, window
from blf_dsc_controller.law.state import Settings, Signals, State
from blf_dsc_controller.numerics.algebra import cholesky_factor, cholesky_solve

_WARM = 4  # inverse iterations from the previous direction
_COLD = 60  # from an arbitrary direction
_COMPARABLE = 0.95  # fraction of the best lambda_min
_FORGETTING = 0.1  # fraction of the best lambda_min lost per window
_GATE = 4.0  # ratio of mean squares: twice the torque
# times the smallest residual: the floor, where that is below the configured one
_QUIET = 4.0
_LEAST_FLOOR = 0.01  # of the configured floor: a tenth of the torque
# of the residual since the last split; that of a lasting disturbance does not fall
_FALLEN = 0.5
_USUAL = 1.25  # times the smallest residual, which varies with the motion
_DOUBT = 3.0  # pull to the anchor per (N m)^2 above that, 1/(kg m^2)^2
_LEAST_INERTIA = 0.1  # fraction of the initial estimate's


@inner
def explained(settings: Settings, state: State, residual: float) -> float:
    """Return the mean square residual that noise and unmodelled torque explain (>= `residual`).

    Their configured floor is an upper limit: the best full window shows how little they
    are.
    """
    floor = settings.residual_floor
    if state.least_residual[0] > 0.0:
        shown = max(_QUIET * state.least_residual[0], _LEAST_FLOOR * floor)
        floor = min(floor, shown)
    return max(residual, floor)


@inner
def window_residual(running: Array, theta: Array) -> float:
    """Return the sum of |u - X theta|^2 over the window, from its sums of [X | u]^T [X | u]."""
    m = theta.size
    total = running[m, m]
    for i in range(m):
        product = -2.0 * running[i, m] + running[i, i] * theta[i]
        for j in range(i + 1, m):
            product += 2.0 * running[i, j] * theta[j]
        total += theta[i] * product
    return max(float(total), 0.0)


@inner
def is_physical(settings: Settings, signals: Signals, theta: Array) -> bool:
    """Check that M(q) of theta (m,), minus a tenth of that of P^(0), is positive definite.

    Overwrites Yp and Yr of `signals`.
    """
    for k in range(settings.n):
        for i in range(settings.n):
            signals.unit[i] = 1.0 if i == k else 0.0
        settings.model.momentum_regressor(
            signals.q, signals.unit, signals.Yp, signals.Yr
        )
        for i in range(k, settings.n):
            signals.inertia[k, i] = 0.0
            for j in range(settings.p):
                parameter = theta[j] - _LEAST_INERTIA * settings.initial_estimate[j]
                signals.inertia[k, i] += signals.Yp[i, j] * parameter
    return cholesky_factor(signals.inertia)


@inner
def is_in_question(settings: Settings, state: State, residual: float) -> bool:
    """Return whether a full window must be compared with its parts, for want of another measure."""
    is_full = state.rows[0] == settings.window
    if not is_full or state.least_residual[0] > 0.0 or settings.window == 1:
        return False
    split = state.split_residual[0]
    is_new = split == 0.0 or residual < _FALLEN * split
    return bool(is_new and residual > _GATE * settings.residual_floor)


@inner
def solve(settings: Settings, state: State, signals: Signals) -> None:
    """Factor Phi + rho R, and solve Phi theta = b, with theta in `signals.work`."""
    window.regularized_factor(
        state.active,
        settings.rho,
        settings.information,
        signals.Phi,
        signals.b,
        signals.factor,
    )
    for j in range(settings.m):
        signals.work[j] = signals.b[j]
    cholesky_solve(signals.factor, signals.work)


@inner
def agrees_with_parts(
    settings: Settings, state: State, signals: Signals, residual: float
) -> bool:
    """Check the residual of a full window against those of its two parts, each fitted apart.

    If they contradict each other, only the newer part stays in the window.  Restores
    Phi, b, its factor and the solution of the whole window in `signals`.
    """
    length = settings.window
    newer_rows = window.newer_part(state, signals.newer)
    least = residual
    for k in range(3):
        if k == 0:
            rows = length - newer_rows
            sums.add(state.running, -1.0, signals.newer, signals.part)
        elif k == 1:
            rows = newer_rows
            sums.add(signals.newer, 0.0, signals.newer, signals.part)
        else:
            rows = length
            sums.add(state.running, 0.0, state.running, signals.part)
        window.average_window(signals.part, rows, signals.Phi, signals.b)
        if settings.prior_weight > 0.0:
            prior = settings.initial_estimate
            weight = settings.prior_weight
            window.pull_to(prior, weight, settings.information, signals.Phi, signals.b)
        solve(settings, state, signals)
        least = min(least, window_residual(signals.part, signals.work) / rows)
    if residual <= _GATE * explained(settings, state, least):
        return True
    state.split_residual[0] = residual
    state.rows[0] = float(newer_rows)
    sums.add(signals.newer, 0.0, signals.newer, state.running)
    window.reset_direction(state)
    return False


@inner
def accept_window(settings: Settings, state: State, signals: Signals) -> bool:
    """Check that the window is consistent and its solution physical; if so, keep the solution.

    A window that is not full, or has an unusually large residual, is pulled to the
    anchor: Phi + a R, b + a R theta_anchor, in `signals`.
    """
    m = settings.m
    solution = signals.work
    for j in range(m):
        solution[j] = signals.b[j]
    cholesky_solve(signals.factor, solution)
    residual = window_residual(state.running, solution) / state.rows[0]
    missing = 1.0 - state.rows[0] / settings.window
    is_first = state.latched[0] == 0.0
    if is_in_question(settings, state, residual) and not agrees_with_parts(
        settings, state, signals, residual
    ):
        return False
    if missing <= 0.0 and (
        state.least_residual[0] == 0.0 or residual < state.least_residual[0]
    ):
        state.least_residual[0] = residual
    if residual > _GATE * explained(settings, state, state.least_residual[0]):
        return False
    doubt = _DOUBT * max(0.0, residual - _USUAL * state.least_residual[0])
    pull = settings.anchor_weight * missing + doubt
    if pull > 0.0:
        window.pull_to(state.anchor, pull, settings.information, signals.Phi, signals.b)
        solve(settings, state, signals)
    if not is_physical(settings, signals, solution):
        return False
    for j in range(m):
        state.solution[j] = solution[j]
    state.residual[0] = residual
    if missing <= 0.0 and (is_first or window.is_at_start(settings, state)):
        for j in range(m):
            state.anchor[j] = solution[j]
    return True


@inner
def reject_columns(settings: Settings, state: State, signals: Signals) -> None:
    """Reject the disturbance columns that this window cannot distinguish from the parameters.

    The window must excite the parameters without any column; then the column with the
    largest entry in the minimum eigenvector is rejected, repeatedly, until the rest is
    excited.  This happens at the first settled window that is excited enough, and once
    per window while a column is rejected.
    """
    for j in range(settings.p, settings.m):
        state.active[j] = 0.0
    window.reset_direction(state)
    parameters_excited = (
        window.excitation(settings, state, signals, _COLD) >= settings.sigma
    )
    for j in range(settings.p, settings.m):
        state.active[j] = 1.0
    if not parameters_excited:
        state.columns_checked[0] = 0.0  # readmit all, until a window is excited
        window.reset_direction(state)
        return
    state.columns_checked[0] = 1.0
    for _ in range(settings.p, settings.m):
        window.reset_direction(state)
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

    When the reference stops, (27) would end with the weakest window above the
    threshold.  A weaker window only has less information, unless the latched one is old
    or contradicted.
    """
    return bool(
        settings.change_detection == 0 or value >= _COMPARABLE * state.best_lambda[0]
    )


@inner
def update_excitation(
    settings: Settings, state: State, signals: Signals, t: float, dt: float
) -> None:
    """Compute lambda_min of the window; from tau_d + T_a on, latch the window if it suffices (27).

    After a change of the arm the window need not be full, but must span at least T_a.
    """
    if state.rows[0] == 0.0:
        return
    period = settings.row_interval * dt
    settling_time = settings.learning_start - settings.window * period
    settled = (
        state.rows[0] == settings.window or state.rows[0] * period >= settling_time
    )
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
    if not (
        learning and value >= settings.sigma and is_preferred(settings, state, value)
    ):
        return
    consistent = settings.change_detection == 0
    if not (consistent or accept_window(settings, state, signals)):
        return
    for i in range(settings.m):
        state.b[i] = signals.b[i]
        for j in range(settings.m):
            state.Phi[i, j] = signals.Phi[i, j]
            state.factor[i, j] = signals.factor[i, j]
    state.latched[0] = 1.0
    if state.rows[0] == settings.window:
        state.best_lambda[0] = max(value, state.best_lambda[0])
    state.latch_time[0] = t
