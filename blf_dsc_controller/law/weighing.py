# SPDX-License-Identifier: Apache-2.0
"""What the tip holds: mass and centre of a load, with intervals, while the arm moves as it must.

The rows X theta = u of the window (see `prediction`) are those of an arm.  A load in the tip with
the ten inertial parameters phi changes its base parameters by N phi, so with

    before:  X theta = u,        since:  X (theta + N phi) = u

the rows of the first window, in which nothing is held, and those since give the most likely theta
and phi, given the prior of each: a linear problem with unknowns phi = D z, z ~ (0, 1), and theta.
The load is thus the difference of two estimates of one arm, whatever its links and friction are.

Residuals of rows, with the mean square s^2, are correlated: as many rows as fit into `_LASTING`
count as one.  Rows of slow joints count little, since they may stick.  Where the last rows
contradict the solution, something else is held: the rows since are discarded, as they are after a
window in any case.  Nothing here acts on the torque: `weigh` runs after it has been sent.
"""

from math import sqrt

from blf_dsc_controller.arms.model import ArmModel
from blf_dsc_controller.compiled.algebra import cholesky_factor, cholesky_solve
from blf_dsc_controller.compiled.jit import inner, kernel
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.law import window
from blf_dsc_controller.law.excitation import window_residual
from blf_dsc_controller.law.state import (
    Settings,
    Signals,
    State,
    settings_of,
    signals_of,
    state_of,
)

_PERIOD = 0.1  # s, from one solution to the next
_LASTING = 0.2  # s, correlation length of the residual
_MEMORY = 0.3  # s, averaging time of the last rows
_FEWEST = 0.5  # s of motion, before which they are not compared with the solution
# times the mean square residual of the first window: something else is held
_ALARM = 8.0
_SETTLED = 6.0  # time constants of the filters
# rad/s or m/s, below which friction is least like its columns, and rows count less
_SLOW = 0.3

# rows of the first window, and of the last two halves since
BEFORE, OLDER, NEWER = range(3)
TWO_SIDED = 1.96  # standard deviations in half of a 95 % interval
MASS, DEVIATION = 0, 4  # in `state.load`, each followed by three of the centre


@inner
def add_row(settings: Settings, state: State, signals: Signals, dt: float) -> None:
    """Add the row of this sample if one is due, and solve for the load ten times a second."""
    samples = int(state.samples[0])
    interval = settings.row_interval
    is_due = samples % interval == interval // 2 and state.frozen[0] == 0.0
    if settings.weighed == 0 or not is_due:
        return
    period = interval * dt
    for i in range(settings.n):  # those of slow joints count little
        weight = abs(signals.dqr[i]) / sqrt(signals.dqr[i] ** 2 + _SLOW**2)
        for j in range(settings.m + 1):
            signals.row[i, j] *= weight
    is_new = samples <= interval or state.changes[0] != state.weighed_changes[0]
    if is_new or is_contradicted(settings, state, signals, period):
        state.weighed_changes[0] = state.changes[0]
        discard(settings, state)
        state.weighing_wait[0] = _SETTLED / (settings.pole * period)
    if state.weighing_wait[0] > 0.0:
        state.weighing_wait[0] -= 1.0
        return
    part = BEFORE if is_first(settings, state) else NEWER
    window.add_products(signals.row, state.weighed_sums[part])
    share = 0.0  # mean square weight of the joints' rows: 1 in motion, 0 at rest
    for i in range(settings.n):
        square = signals.dqr[i] ** 2
        share += square / (square + settings.motion_scale**2 + 1e-12) / settings.n
    state.weighed_rows[part] += share
    if part == NEWER and state.weighed_rows[NEWER] >= 0.5 * settings.window:
        window.add(
            state.weighed_sums[NEWER], 0.0, state.weighed_sums[NEWER], signals.since
        )
        window.add(signals.since, 0.0, signals.since, state.weighed_sums[OLDER])
        window.clear(state.weighed_sums[NEWER])
        state.weighed_rows[OLDER] = state.weighed_rows[NEWER]
        state.weighed_rows[NEWER] = 0.0
    if samples // interval % max(1, round(_PERIOD / period)) == 0:
        solve(settings, state, signals, _LASTING / period)
        if not is_first(settings, state):
            describe(settings, state, signals, _LASTING / period)


@inner
def is_first(settings: Settings, state: State) -> bool:
    """Whether the first window is not complete."""
    return bool(state.weighed_rows[BEFORE] < settings.window)


@inner
def rows_since(state: State) -> float:
    """Return the number of moving rows since the first window that count."""
    return float(state.weighed_rows[OLDER] + state.weighed_rows[NEWER])


@inner
def discard(settings: Settings, state: State) -> None:
    """Discard the rows since the first window, or those of an incomplete first window."""
    for part in range(BEFORE if is_first(settings, state) else OLDER, NEWER + 1):
        window.clear(state.weighed_sums[part])
        state.weighed_rows[part] = 0.0
    for k in range(state.load.size):
        state.load[k] = 0.0
    state.weighed_recent[0] = 0.0


@inner
def is_contradicted(
    settings: Settings, state: State, signals: Signals, period: float
) -> bool:
    """Compare this row with the solution; return whether the last ones contradict it."""
    if rows_since(state) < _FEWEST / period or state.load[DEVIATION] == 0.0:
        return False
    square = 0.0
    for i in range(settings.n):
        error = -signals.row[i, settings.m]
        for j in range(settings.m):
            error += signals.row[i, j] * state.weighed_model[j]
        square += error * error / settings.n
    state.weighed_recent[0] += min(1.0, period / _MEMORY) * (
        square - state.weighed_recent[0]
    )
    return bool(state.weighed_recent[0] > _ALARM * state.weighed_noise[0])


@inner
def row_variance(settings: Settings, state: State, lasting: float) -> float:
    """Return a = `lasting` s^2; the law's assumed residual until it has been measured."""
    noise = max(state.weighed_noise[0], state.weighed_noise[1])
    return lasting * (noise if noise > 0.0 else settings.residual_floor / settings.n)


@inner
def fill_equations(
    settings: Settings, state: State, signals: Signals, a: float
) -> None:
    """Fill the upper triangle and the right-hand side of the normal equations of theta and z.

    With the sums S of all rows and S' of those since, and the variance a of rows that count,

        [S + a R       S' N D             ] [theta]   [S_u + a R theta_0]
        [D^T N^T S'    D^T N^T S' N D + a ] [z    ] = [D^T N^T S'_u     ]
    """
    m = settings.m
    A = signals.load_normal
    x = signals.load_solution
    before = state.weighed_sums[BEFORE]
    since = signals.since
    ND = settings.load_columns
    for i in range(m):
        x[i] = before[i, m] + since[i, m]
        for j in range(m):
            x[i] += a * settings.information[i, j] * settings.initial_estimate[j]
        for j in range(i, m):
            A[i, j] = before[i, j] + since[i, j] + a * settings.information[i, j]
    for c in range(ND.shape[1]):
        x[m + c] = 0.0
        for j in range(m):
            x[m + c] += ND[j, c] * since[j, m]
            A[j, m + c] = 0.0
            for i in range(m):
                A[j, m + c] += since[min(i, j), max(i, j)] * ND[i, c]
        for d in range(c + 1):
            A[m + d, m + c] = a if d == c else 0.0
            for j in range(m):
                A[m + d, m + c] += ND[j, d] * A[j, m + c]


@inner
def solve(settings: Settings, state: State, signals: Signals, lasting: float) -> None:
    """Find theta and z, and the residual before and since; `lasting` rows count as one."""
    m = settings.m
    ND = settings.load_columns
    x = signals.load_solution
    window.add(state.weighed_sums[OLDER], 1.0, state.weighed_sums[NEWER], signals.since)
    fill_equations(settings, state, signals, row_variance(settings, state, lasting))
    cholesky_factor(signals.load_normal)
    cholesky_solve(signals.load_normal, x)
    theta, model = x[:m], state.weighed_model[:m]
    for i in range(m):
        model[i] = theta[i]
        for c in range(ND.shape[1]):
            model[i] += ND[i, c] * x[m + c]
    first = max(state.weighed_rows[BEFORE], lasting)
    last = max(rows_since(state), lasting)
    before = window_residual(state.weighed_sums[BEFORE], theta)
    state.weighed_noise[0] = before / (settings.n * first)
    state.weighed_noise[1] = window_residual(signals.since, model) / (settings.n * last)


@inner
def describe(
    settings: Settings, state: State, signals: Signals, lasting: float
) -> None:
    """Write mass and centre of the load to `state.load`, and their standard deviations.

    The covariance of z is a (U^T U)^-1 with the last rows U of the factor.  The centre is unknown
    where the mass is not twice its deviation.
    """
    m, k = settings.m, settings.load_scale.shape[1]
    U = signals.load_normal[m:, m:]
    z = signals.load_solution[m:]
    v = signals.load_spread
    a = row_variance(settings, state, lasting)
    for r in range(4):
        state.load[r] = 0.0
        for c in range(k):
            state.load[r] += settings.load_scale[r, c] * z[c]
            v[r, c] = settings.load_scale[r, c]
            for d in range(c):
                v[r, c] -= U[d, c] * v[r, d]
            v[r, c] *= U[c, c]
    mass = state.load[MASS]
    for r in range(4):
        centre = state.load[r] / mass if r > 0 else 0.0  # dc = (dh - c dm) / m
        square = 0.0
        for c in range(k):
            square += (v[r, c] - centre * v[0, c]) ** 2
        state.load[DEVIATION + r] = sqrt(a * square)
        if r > 0:
            is_known = abs(mass) > 2.0 * state.load[DEVIATION]
            state.load[r] = centre if is_known else 0.0
            state.load[DEVIATION + r] = (
                state.load[DEVIATION + r] / abs(mass) if is_known else 0.0
            )


@kernel
def weigh(
    model: ArmModel,
    settings_vector: Array,
    state_vector: Array,
    signals_vector: Array,
    dt: float,
) -> None:
    """Take the row of the last sample on packed vectors: see `add_row`; `dt` [s] is its length."""
    settings = settings_of(settings_vector, model)
    state = state_of(state_vector, settings)
    add_row(settings, state, signals_of(signals_vector, settings), dt)
