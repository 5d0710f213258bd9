# SPDX-License-Identifier: Apache-2.0
"""What the tip holds: mass and centre of a load, with intervals, while the arm moves as it must.

The rows X theta = u of the window (see `prediction`) are those of an arm.  A load in
the tip with the ten inertial parameters phi changes its base parameters by N phi, so
with

    before:  X theta = u,        since:  X (theta + N phi) = u

the rows before, in which nothing is held, and those since give the most likely theta
and phi, given the prior of each: a linear problem with unknowns phi = D z, z ~ (0, 1),
and theta.  The load is thus the difference of two estimates of one arm, whatever its
links and friction are.

The rows before are those of the first window, or of less if they contradict each other
(see `innovation`): a load that is put down and picked up from the first cycle on is
weighed, too.  Where later rows contradict the solution, something else is held.  If
what was held until then is clearly less than nothing, the arm held a load before: what
is lightest is taken for nothing.  If it was nothing, its rows are added to those before
until they make a window.  Rows are kept apart until they are 0.15 to 0.3 s old, so that
those of a change that has not been found yet can be discarded.

Rows of slow joints count little, since they may stick.  Nothing here acts on the
torque: `weigh` runs after it has been sent.
"""

from math import sqrt

from blf_dsc_controller.arms.model import ArmModel
from blf_dsc_controller.compiled.jit import inner, kernel
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.law import innovation, window
from blf_dsc_controller.law.state import (
    Settings,
    Signals,
    State,
    settings_of,
    signals_of,
    state_of,
)
from blf_dsc_controller.numerics.algebra import cholesky_factor, cholesky_solve

_FEWEST = 0.5  # s of motion that a part has
# s, for which the latest rows are kept apart, and then those of them again
_APART = 0.15
_SETTLED = 6.0  # time constants of the filters
# rad/s or m/s, below which friction is least like its columns, and rows count less
_SLOW = 0.3
_NOTHING, _LESS = 2.0, 4.0  # standard deviations: within, and below minus

# rows before, of two halves since, and of the two parts that are kept apart
BEFORE, OLDER, NEWER, RECENT, LATEST = range(5)
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
    rows = samples // interval
    has_changed = state.changes[0] != state.weighed_changes[0]
    state.weighed_changes[0] = state.changes[0]
    weight_row(settings, signals)
    if samples <= interval:
        begin(settings, state, signals, period)
    elif has_changed:
        end_part(settings, state, signals, period)
    elif state.weighing_wait[0] > 0.0:
        state.weighing_wait[0] -= 1.0
    elif is_contradicted(settings, state, signals, period):
        end_part(settings, state, signals, period)
    else:
        window.add_products(signals.row, state.weighed_sums[LATEST])
        state.weighed_rows[LATEST] += moving_share(settings, signals)
        if is_first(state) and rows_before(state) >= settings.window:
            state.weighed_complete[0] = 1.0
        if rows % max(1, round(_APART / period)) == 0:
            promote(settings, state)
        if rows % max(1, round(innovation.REFRESH / period)) == 0:
            solve(settings, state, signals, period)
            if not is_first(state):
                describe(settings, state, signals, period)


@inner
def weight_row(settings: Settings, signals: Signals) -> None:
    """Let the rows of slow joints count little."""
    for i in range(settings.n):
        weight = abs(signals.dqr[i]) / sqrt(signals.dqr[i] ** 2 + _SLOW**2)
        for j in range(settings.m + 1):
            signals.row[i, j] *= weight


@inner
def moving_share(settings: Settings, signals: Signals) -> float:
    """Return the mean square weight of the joints' rows: 1 in motion, 0 at rest."""
    share = 0.0
    for i in range(settings.n):
        square = signals.dqr[i] ** 2
        share += square / (square + settings.motion_scale**2 + 1e-12) / settings.n
    return share


@inner
def is_first(state: State) -> bool:
    """Whether the rows before are not complete."""
    return bool(state.weighed_complete[0] == 0.0)


@inner
def rows_before(state: State) -> float:
    """Return the number of moving rows so far, while the rows before are not complete."""
    rows = state.weighed_rows
    return float(rows[BEFORE] + rows[RECENT] + rows[LATEST])


@inner
def begin(settings: Settings, state: State, signals: Signals, period: float) -> None:
    """Begin with an arm of which only the prior is known."""
    unmodelled = settings.residual_floor / settings.n
    innovation.start(unmodelled, state.weighed_statistics)
    discard(state, BEFORE)
    state.weighed_complete[0] = 0.0
    state.weighing_wait[0] = _SETTLED / (settings.pole * period)
    solve(settings, state, signals, period)


@inner
def discard(state: State, first: int) -> None:
    """Discard the rows of the parts from the `first` on, and what was held."""
    for part in range(first, LATEST + 1):
        window.clear(state.weighed_sums[part])
        state.weighed_rows[part] = 0.0
    for k in range(state.load.size):
        state.load[k] = 0.0


@inner
def move_rows(state: State, source: int, target: int) -> None:
    """Add the rows of the part `source` to those of the part `target`."""
    sums = state.weighed_sums
    window.add(sums[target], 1.0, sums[source], sums[target])
    state.weighed_rows[target] += state.weighed_rows[source]
    window.clear(sums[source])
    state.weighed_rows[source] = 0.0


@inner
def promote(settings: Settings, state: State) -> None:
    """Use the rows that have been kept apart long enough; forget those of an earlier half."""
    if is_first(state):
        move_rows(state, RECENT, BEFORE)
    else:
        move_rows(state, RECENT, NEWER)
        if state.weighed_rows[NEWER] >= 0.5 * settings.window:
            window.clear(state.weighed_sums[OLDER])
            state.weighed_rows[OLDER] = 0.0
            move_rows(state, NEWER, OLDER)
    move_rows(state, LATEST, RECENT)


@inner
def end_part(settings: Settings, state: State, signals: Signals, period: float) -> None:
    """Something else is held: close the part, without its latest rows, and begin another."""
    sums = state.weighed_sums
    for part in (RECENT, LATEST):
        window.clear(sums[part])
        state.weighed_rows[part] = 0.0
    fewest = _FEWEST / period
    if not is_first(state):
        move_rows(state, OLDER, NEWER)
        if state.weighed_rows[NEWER] >= fewest:
            compare_with_nothing(settings, state, signals, period)
        discard(state, OLDER)
    elif state.weighed_rows[BEFORE] >= fewest:
        state.weighed_complete[0] = 1.0
        discard(state, OLDER)
    else:
        discard(state, BEFORE)
    state.weighed_statistics[innovation.RECENT] = 0.0
    state.weighing_wait[0] = _SETTLED / (settings.pole * period)
    solve(settings, state, signals, period)


@inner
def compare_with_nothing(
    settings: Settings, state: State, signals: Signals, period: float
) -> None:
    """Take the newer rows for those of an empty hand if it held nothing, or less than before."""
    solve(settings, state, signals, period)
    describe(settings, state, signals, period)
    mass = state.load[MASS]
    deviation = state.load[DEVIATION]
    is_full = state.weighed_rows[BEFORE] >= settings.window
    if mass < -_LESS * deviation:
        window.clear(state.weighed_sums[BEFORE])
        state.weighed_rows[BEFORE] = 0.0
        move_rows(state, NEWER, BEFORE)
    elif abs(mass) < _NOTHING * deviation and not is_full:
        move_rows(state, NEWER, BEFORE)


@inner
def fill_load(settings: Settings, state: State, signals: Signals) -> None:
    """Fill [X | X N D] of this row, whose unknowns are theta and z; no load in the first rows."""
    m = settings.m
    ND = settings.load_columns
    X = signals.load_rows
    is_held = not is_first(state)
    for i in range(settings.n):
        for j in range(m):
            X[i, j] = signals.row[i, j]
        for c in range(ND.shape[1]):
            X[i, m + c] = 0.0
            if is_held:
                for j in range(m):
                    X[i, m + c] += signals.row[i, j] * ND[j, c]


@inner
def is_contradicted(
    settings: Settings, state: State, signals: Signals, period: float
) -> bool:
    """Compare this row with the solution; return whether the last ones contradict it."""
    X = signals.load_rows
    e = signals.load_torque
    x = state.weighed_solution
    fill_load(settings, state, signals)
    for i in range(settings.n):
        e[i] = signals.row[i, settings.m]
        for j in range(x.size):
            e[i] -= X[i, j] * x[j]
    square = innovation.normalized_square(
        X, e, state.weighed_factor, period, signals.load_covariance
    )
    return innovation.update(
        square,
        settings.residual_floor / settings.n,
        period,
        settings.window,
        state.weighed_statistics,
    )


@inner
def fill_equations(
    settings: Settings, state: State, signals: Signals, a: float
) -> None:
    """Fill the upper triangle and the right-hand side of the normal equations of theta and z.

    With the sums S of all rows and S' of those since, and the variance a of rows that
    count,

        [S + a R       S' N D             ] [theta]   [S_u + a R theta_0]
        [D^T N^T S'    D^T N^T S' N D + a ] [z    ] = [D^T N^T S'_u     ]
    """
    m = settings.m
    A = state.weighed_factor
    x = state.weighed_solution
    before = signals.before
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
def solve(settings: Settings, state: State, signals: Signals, period: float) -> None:
    """Find theta and z of all rows, one each `period` [s], those kept apart included."""
    sums = state.weighed_sums
    window.add(sums[OLDER], 1.0, sums[NEWER], signals.since)
    window.add(sums[BEFORE], 0.0, sums[BEFORE], signals.before)
    for part in (RECENT, LATEST):
        if is_first(state):
            window.add(signals.before, 1.0, sums[part], signals.before)
        else:
            window.add(signals.since, 1.0, sums[part], signals.since)
    a = innovation.row_variance(state.weighed_statistics, period)
    fill_equations(settings, state, signals, a)
    cholesky_factor(state.weighed_factor)
    cholesky_solve(state.weighed_factor, state.weighed_solution)


@inner
def describe(settings: Settings, state: State, signals: Signals, period: float) -> None:
    """Write mass and centre of the load to `state.load`, and their standard deviations.

    The covariance of z is a (U^T U)^-1 with the last rows U of the factor.  The centre
    is unknown where the mass is not twice its deviation.
    """
    m, k = settings.m, settings.load_scale.shape[1]
    U = state.weighed_factor[m:, m:]
    z = state.weighed_solution[m:]
    v = signals.load_spread
    a = innovation.row_variance(state.weighed_statistics, period)
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
