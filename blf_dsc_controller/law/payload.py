# SPDX-License-Identifier: Apache-2.0
"""Payload estimate: mass and centre of a load in the tip, with intervals, while the arm works.

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
estimated, too.  Where later rows contradict the solution, something else is held.  If
what was held until then is clearly less than nothing, the arm held a load before: what
is lightest is taken for nothing.  If it was nothing, its rows are added to those before
until they make a window.  Rows are kept apart for `innovation.DETECTION_TIME`, and then
once more, so that those of a change that has not been detected yet can be discarded.

Rows of slow joints count little, since they may stick.  Friction must not be taken for a load,
nor a load for friction.  What the columns of theta do not describe of it are unknowns, too, each
with its prior:

    b_i  what a joint has in excess at breakaway, as shaped by `friction`;
    k_i  the fraction of the torque tau_L in its gear that is lost there, k |tau_L| s(dq): a load
         adds to it, and its loss does not average out while a joint mostly moves one way;
    e    by how much viscous and Coulomb friction differ since from before, as the arm gets
         warm: its variance grows for 20 s, since friction does not change at once.

    before:  X theta + b s_b + k |tau_L| s = u,
    since:   X (theta + N phi + E e) + b s_b + k |tau_L| s = u

tau_L is that of the solution so far, not the measured torque, which would explain itself.
Nothing here acts on the torque: `perception` calls `add_row` after it has been sent.
"""

from math import inf, sqrt
from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, Cell
from blf_dsc_controller.law import innovation, sums
from blf_dsc_controller.law.innovation import Prior
from blf_dsc_controller.law.prediction import SETTLED, mean_square_weight, square_weight
from blf_dsc_controller.numerics.algebra import cholesky_factor, cholesky_solve
from blf_dsc_controller.numerics.intervals import TWO_SIDED

_FEWEST_MOTION = 0.5  # s of motion that a part has
_CHANGING_TIME = 20.0  # s, until the variance of e has grown
# rad/s or m/s, below which friction is least like its columns, and rows count less
_SLOW_SPEED = 0.1
_NOTHING_SIGMAS, _LESS_SIGMAS = 2.0, 4.0  # standard deviations: within, and below minus

# rows before, of two halves since, and of the two parts that are kept apart
BEFORE, OLDER, NEWER, RECENT, LATEST = range(5)
MASS, DEVIATION = 0, 4  # in `State.load`, each followed by three of the centre
LOAD = 10  # entries of z
# of all torques: a mass is as many times too large as what drives are believed to give
_SCALE_DEVIATION = 0.03


class Settings(NamedTuple):
    """How a load in the tip acts, and which rows are used."""

    size: int  # m + 2 n + 1, or 0: no load is estimated
    inertial: int  # p, entries of theta that are base parameters
    since: int  # unknowns of the rows since alone: z, then e
    unknowns: int  # theta, b, k, z and e
    window: int  # N, rows in a window of the learning
    row_interval: int  # samples between two rows
    pole: float  # of the row filters, rad/s
    motion_scale: float  # reference velocity below which rows count less, rad/s
    unmodelled: float  # mean square torque that no column describes, (N m)^2
    load_friction: float  # of the fractions k, 1 / variance
    # of the breakaway torques, 1 / variance, 1/(N m)^2
    breakaway: Annotated[Array, 'n']
    # [N D | E], e in standard deviations, and rows of zeros
    columns: Annotated[Array, 'payload.size', 'payload.since']
    # rows of D: mass [kg] and moments [kg m], and zeros
    scale: Annotated[Array, 4, 'payload.since']


class State(NamedTuple):
    """What is kept from one row to the next."""

    begun: Cell  # 1: the load has been solved for, at first by the prior
    rows: Annotated[Array, 5]  # moving ones in each part
    sums: Annotated[Array, 5, 'payload.size', 'payload.size']  # of [X | u]^T [X | u]
    complete: Cell  # 1: the rows before are complete
    age: Cell  # s since then
    innovation: innovation.State
    solution: Annotated[Array, 'payload.unknowns']  # theta, b, k, z and e
    # of their equations
    factor: Annotated[Array, 'payload.unknowns', 'payload.unknowns']
    changes: Cell  # number of changes of the arm at the last row
    wait: Cell  # rows until the filters have settled
    # mass [kg] and centre [m] in the tip, their deviations; 0: unknown
    load: Annotated[Array, 8]


class Sample(NamedTuple):
    """What is read of a sample."""

    Xu: Array  # [X | u] (n, m + 1)
    shapes: Array  # of breakaway (n,), filtered and weighted as the row
    signs: Array  # s of the motion (n,), filtered alone
    dqr: Array  # (n,) rad/s
    samples: int  # number of samples so far
    changes: float  # of the arm so far
    dt: float  # s


class Workspace(NamedTuple):
    """Scratch of one row."""

    shapes: Annotated[Array, 'n']  # of breakaway, filtered and weighted as the row
    before: Annotated[Array, 'payload.size', 'payload.size']  # sums of all such rows
    since: Annotated[Array, 'payload.size', 'payload.size']
    row: Annotated[Array, 'n', 'payload.size']  # [X | u], weighted
    rows: Annotated[Array, 'n', 'payload.unknowns']  # [X | X N D | X E]
    torque: Annotated[Array, 'n']  # that they do not explain, N m
    covariance: Annotated[Array, 'n', 'n']
    spread: Annotated[Array, 4, 'payload.since']  # D U^-1
    held: Annotated[Array, 'payload.inertial']  # base parameters with the load


@inner
def add_row(
    settings: Settings,
    state: State,
    workspace: Workspace,
    prior: Prior,
    sample: Sample,
) -> None:
    """Add the row of this sample if one is due; estimate the load ten times a second.

    Each `row_interval` samples, half an interval after the window's.  `prior` is that of theta.
    """
    samples, dqr = sample.samples, sample.dqr
    if samples % settings.row_interval != settings.row_interval // 2:
        return
    period = settings.row_interval * sample.dt
    has_changed = sample.changes != state.changes[0]
    state.changes[0] = sample.changes
    if not is_first(state):
        state.age[0] += period
    row = workspace.row
    find_held(settings, state, workspace.held)
    fill_row(sample, workspace.held, row)
    if state.begun[0] == 0.0:
        begin(settings, state, workspace, prior, period)
    elif has_changed:
        end_part(settings, state, workspace, prior, period)
    elif state.wait[0] > 0.0:
        state.wait[0] -= 1.0
    elif update_innovation(settings, state, workspace, row, dqr, period):
        end_part(settings, state, workspace, prior, period)
    else:
        sums.add_products(row, state.sums[LATEST])
        state.rows[LATEST] += mean_square_weight(dqr, settings.motion_scale)
        refresh(
            settings, state, workspace, prior, samples // settings.row_interval, period
        )


@inner
def refresh(
    settings: Settings,
    state: State,
    workspace: Workspace,
    prior: Prior,
    rows: int,
    period: float,
) -> None:
    """Use the rows that are old enough, and estimate the load, each at its own rate.

    `rows` is the number of rows so far, one each `period` [s].
    """
    if is_first(state):
        moving_rows = state.rows[BEFORE] + state.rows[RECENT] + state.rows[LATEST]
        if moving_rows >= settings.window:
            state.complete[0] = 1.0
    if rows % max(1, round(innovation.DETECTION_TIME / period)) == 0:
        promote(settings, state)
    if rows % max(1, round(innovation.REFRESH / period)) == 0:
        solve(settings, state, workspace, prior, period)
        if not is_first(state):
            fill_estimate(settings, state, workspace, period)


@inner
def find_held(settings: Settings, state: State, held: Array) -> None:
    """Write the base parameters theta + N D z of the arm with its load to `held` (p,)."""
    x = state.solution
    load = settings.size - 1
    for j in range(held.size):
        held[j] = x[j]
        for c in range(LOAD):
            held[j] += settings.columns[j, c] * x[load + c]


@inner
def fill_row(sample: Sample, held: Array, row: Array) -> None:
    """Write [X | u] (n, m + 1) with columns of b and of k, weighted, to `row`.

    Rows of slow joints have a small weight.  `held` (p,) gives tau_L.
    """
    Xu, shapes, signs = sample.Xu, sample.shapes, sample.signs
    n = shapes.size
    m = row.shape[1] - 1 - 2 * n
    for i in range(n):
        for j in range(m):
            row[i, j] = Xu[i, j]
        for j in range(m, m + 2 * n):
            row[i, j] = 0.0
        torque = 0.0
        for j in range(held.size):
            torque += Xu[i, j] * held[j]
        row[i, m + i] = shapes[i]
        row[i, m + n + i] = abs(torque) * signs[i]
        row[i, m + 2 * n] = Xu[i, m]
        speed = sample.dqr[i]
        weight = abs(speed) / sqrt(speed**2 + _SLOW_SPEED**2)
        for j in range(row.shape[1]):
            row[i, j] *= weight


@inner
def counted_weight(dqr: Array, motion_scale: float) -> float:
    """Return the mean square weight of the joints' rows, with that of `fill_row`.

    dqr (n,) [rad/s] is the velocity of the reference.
    """
    mean = 0.0
    for i in range(dqr.size):
        square = dqr[i] ** 2
        mean += (
            square_weight(dqr[i], motion_scale)
            * square
            / (square + _SLOW_SPEED**2)
            / dqr.size
        )
    return mean


@inner
def is_first(state: State) -> bool:
    """Whether the rows before are not complete yet: then the tip is taken to hold nothing."""
    return bool(state.complete[0] == 0.0)


@inner
def held_mass(state: State) -> tuple[float, float]:
    """Return the mass of the load [kg] and its standard deviation [kg], infinite where unknown."""
    mass = state.load[MASS]
    deviation = state.load[DEVIATION]
    if deviation == 0.0 and not is_first(state):
        return mass, inf
    return mass, deviation


@inner
def mass_interval(load: Array) -> float:
    """Return half of the 95 % interval [kg] of the mass in a `State.load`.

    To what the rows leave open, it adds the error of the torques' scale, which no row reveals.
    """
    by_scale = _SCALE_DEVIATION * load[MASS]
    return TWO_SIDED * sqrt(load[DEVIATION] ** 2 + by_scale**2)


@inner
def begin(
    settings: Settings, state: State, workspace: Workspace, prior: Prior, period: float
) -> None:
    """Begin with an arm of which only the prior is known; rows come each `period` [s]."""
    state.begun[0] = 1.0
    innovation.begin(state.innovation, settings.unmodelled)
    discard(state, BEFORE)
    state.complete[0] = 0.0
    state.age[0] = 0.0
    state.wait[0] = SETTLED / (settings.pole * period)
    solve(settings, state, workspace, prior, period)


@inner
def discard(state: State, first: int) -> None:
    """Discard the rows of the parts from the `first` on, and the load."""
    for part in range(first, LATEST + 1):
        clear_part(state, part)
    for k in range(state.load.size):
        state.load[k] = 0.0


@inner
def clear_part(state: State, part: int) -> None:
    """Discard the rows of a part."""
    sums.clear(state.sums[part])
    state.rows[part] = 0.0


@inner
def move_rows(state: State, source: int, target: int) -> None:
    """Add the rows of the part `source` to those of the part `target`."""
    parts = state.sums
    sums.add(parts[target], 1.0, parts[source], parts[target])
    state.rows[target] += state.rows[source]
    clear_part(state, source)


@inner
def promote(settings: Settings, state: State) -> None:
    """Use the rows that have been kept apart long enough; forget those of an earlier half."""
    if is_first(state):
        move_rows(state, RECENT, BEFORE)
    else:
        move_rows(state, RECENT, NEWER)
        if state.rows[NEWER] >= 0.5 * settings.window:
            clear_part(state, OLDER)
            move_rows(state, NEWER, OLDER)
    move_rows(state, LATEST, RECENT)


@inner
def end_part(
    settings: Settings, state: State, workspace: Workspace, prior: Prior, period: float
) -> None:
    """Close the part, without its latest rows, and begin another: something else is held."""
    clear_part(state, RECENT)
    clear_part(state, LATEST)
    fewest = _FEWEST_MOTION / period
    if not is_first(state):
        move_rows(state, OLDER, NEWER)
        if state.rows[NEWER] >= fewest:
            compare_with_empty(settings, state, workspace, prior, period)
        discard(state, OLDER)
    elif state.rows[BEFORE] >= fewest:
        state.complete[0] = 1.0
        discard(state, OLDER)
    else:
        discard(state, BEFORE)
    innovation.forget_recent(state.innovation)
    state.wait[0] = SETTLED / (settings.pole * period)
    solve(settings, state, workspace, prior, period)


@inner
def compare_with_empty(
    settings: Settings, state: State, workspace: Workspace, prior: Prior, period: float
) -> None:
    """Take the newer rows for those of an empty tip if it held nothing, or less than before.

    Nothing: a mass within 2 deviations of zero.  Less: a mass below minus 4 deviations.
    """
    solve(settings, state, workspace, prior, period)
    fill_estimate(settings, state, workspace, period)
    mass = state.load[MASS]
    deviation = state.load[DEVIATION]
    is_full = state.rows[BEFORE] >= settings.window
    if mass < -_LESS_SIGMAS * deviation:
        state.age[0] = 0.0
        clear_part(state, BEFORE)
        move_rows(state, NEWER, BEFORE)
    elif abs(mass) < _NOTHING_SIGMAS * deviation and not is_full:
        move_rows(state, NEWER, BEFORE)


@inner
def add_load_columns(settings: Settings, is_held: bool, row: Array, out: Array) -> None:
    """Fill `out` with [X | X N D | X E]; zeros in the last two before anything `is_held`."""
    m = row.shape[1] - 1
    ND = settings.columns
    for i in range(row.shape[0]):
        for j in range(m):
            out[i, j] = row[i, j]
        for c in range(ND.shape[1]):
            out[i, m + c] = 0.0
            if is_held:
                for j in range(m):
                    out[i, m + c] += row[i, j] * ND[j, c]


@inner
def update_innovation(
    settings: Settings,
    state: State,
    workspace: Workspace,
    row: Array,
    dqr: Array,
    period: float,
) -> bool:
    """Compare a row (n, m + 2 n + 1) with the solution; return whether the last contradict it."""
    e = workspace.torque
    x = state.solution
    add_load_columns(settings, not is_first(state), row, workspace.rows)
    for i in range(e.size):
        e[i] = row[i, row.shape[1] - 1]
        for j in range(x.size):
            e[i] -= workspace.rows[i, j] * x[j]
    square = innovation.normalized_square(
        workspace.rows, e, state.factor, period, workspace.covariance
    )
    weight = counted_weight(dqr, settings.motion_scale)
    return innovation.update(
        state.innovation, square, weight, settings.unmodelled, period, settings.window
    )


@inner
def fill_equations(
    settings: Settings,
    state: State,
    workspace: Workspace,
    prior: Prior,
    a: float,
    grown: float,
) -> None:
    """Fill the upper triangle and the right-hand side of the normal equations of theta and z.

    With the sums S of all rows and S' of those since, and the variance a of rows that
    count, and [D | E] for D and (z, e) for z,

        [S + a R       S' N D             ] [theta]   [S_u + a R theta_0]
        [D^T N^T S'    D^T N^T S' N D + a ] [z    ] = [D^T N^T S'_u     ]

    where theta has b and k, too, and a is divided by the fraction that has `grown` of the
    variance of e for its entries.
    """
    m = settings.size - 1
    A = state.factor
    x = state.solution
    before = workspace.before
    since = workspace.since
    ND = settings.columns
    for i in range(m):
        x[i] = before[i, m] + since[i, m]
        for j in range(i, m):
            A[i, j] = before[i, j] + since[i, j]
    add_prior(settings, prior, a, A, x)
    for c in range(ND.shape[1]):
        x[m + c] = 0.0
        for j in range(m):
            x[m + c] += ND[j, c] * since[j, m]
            A[j, m + c] = 0.0
            for i in range(m):
                A[j, m + c] += since[min(i, j), max(i, j)] * ND[i, c]
        for d in range(c + 1):
            A[m + d, m + c] = 0.0
            for j in range(m):
                A[m + d, m + c] += ND[j, d] * A[j, m + c]
        A[m + c, m + c] += a if c < LOAD else a / grown


@inner
def add_prior(settings: Settings, prior: Prior, a: float, A: Array, x: Array) -> None:
    """Add a R of theta, b and k to A, and a R theta_0 to x."""
    R = prior.information
    known = prior.estimate.size
    for i in range(known):
        for j in range(known):
            x[i] += a * R[i, j] * prior.estimate[j]
        for j in range(i, known):
            A[i, j] += a * R[i, j]
    n = settings.breakaway.size
    for i in range(n):
        A[known + i, known + i] += a * settings.breakaway[i]
        A[known + n + i, known + n + i] += a * settings.load_friction


@inner
def solve(
    settings: Settings, state: State, workspace: Workspace, prior: Prior, period: float
) -> None:
    """Solve for theta and z by all rows, one each `period` [s], those kept apart included."""
    parts = state.sums
    sums.add(parts[OLDER], 1.0, parts[NEWER], workspace.since)
    sums.add(parts[BEFORE], 0.0, parts[BEFORE], workspace.before)
    for part in (RECENT, LATEST):
        if is_first(state):
            sums.add(workspace.before, 1.0, parts[part], workspace.before)
        else:
            sums.add(workspace.since, 1.0, parts[part], workspace.since)
    a = innovation.row_variance(state.innovation, period)
    grown = min(1.0, max(state.age[0], period) / _CHANGING_TIME)
    fill_equations(settings, state, workspace, prior, a, grown)
    cholesky_factor(state.factor)
    cholesky_solve(state.factor, state.solution)


@inner
def fill_estimate(
    settings: Settings, state: State, workspace: Workspace, period: float
) -> None:
    """Write mass and centre of the load to `state.load`, and their standard deviations.

    The covariance of z is a (U^T U)^-1 with the last rows U of the factor.  The centre
    is unknown where the mass is not twice its deviation.
    """
    k = settings.scale.shape[1]
    m = state.solution.size - k
    U = state.factor[m:, m:]
    z = state.solution[m:]
    v = workspace.spread
    a = innovation.row_variance(state.innovation, period)
    for r in range(4):
        state.load[r] = 0.0
        for c in range(k):
            state.load[r] += settings.scale[r, c] * z[c]
            v[r, c] = settings.scale[r, c]
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
