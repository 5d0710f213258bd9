# SPDX-License-Identifier: Apache-2.0
"""Friction of the motors by joint torque sensors: its columns d, and what P^ absorbs.

P^ is learned from the torque u of the motors.  It takes all of it that X can describe: the
torque of the links, and what friction has that is not in its columns D.  What pushes the arm
it takes for either.  With the torque tau_J of sensors behind the gears, P_r of the
assumed rotors, and D_c d_c of Coulomb friction and ripple,

    g = u - X P_r - D_c d_c - tau_J

is friction alone, whatever the links carry and whatever pushes them.  The other columns D of
friction, and what X describes of it, are

    P_f, d = argmin sum |g - X P_f - D d|^2 + a |P_f, d - d_0|^2_R,      a = s^2 CORRELATION / T

as for the rows of `innovation`, one each T, with s^2 the mean square of what they leave of g: a
torque that they do not describe, as of a motor that drags, makes P_f small.  The rows are
those of the window, but fade over `_MEAN_WINDOWS` of it in motion, as friction outlasts what is
carried.

P^ - P_f - P_r describes the links: by it `load_observer` finds what acts on them.  d^ is this d,
in place of that of the window, and outlasts changes of the arm; P_f and d^ follow while P^
learns, at the same rate.  What is left of g also identifies Coulomb friction at reversals.
"""

from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, Cell
from blf_dsc_controller.law.innovation import CORRELATION
from blf_dsc_controller.law.lag import filter_gain
from blf_dsc_controller.numerics.algebra import cholesky_factor, cholesky_solve

_MEAN_WINDOWS = 3.0  # of the learning; by choice, not derived
_EMPTY_ROWS = 0.1  # of that: rows of zeros before the first


class Settings(NamedTuple):
    """Which rows are used, and the smallest weight of the prior."""

    size: int  # entries of theta to solve for: P, and columns before those of Coulomb friction
    filter_pole: float  # of both poles of a row, rad/s
    length: int  # rows in a window
    period: float  # T, s
    min_weight: float  # of R, on means over the rows


class State(NamedTuple):
    """Means over the rows, and their solution."""

    sensed1: Annotated[Array, 'n * observer.enabled']  # tau_J behind one pole, N m
    sensed2: Annotated[Array, 'n * observer.enabled']  # and behind both, N m
    rows: Cell  # of motion so far
    # of [X | D]^T [X | D], upper triangle
    Phi: Annotated[Array, 'motors.size * observer.enabled', 'motors.size']
    b: Annotated[Array, 'motors.size * observer.enabled']  # of [X | D]^T (g - D d_0)
    square: Cell  # of |g - D d_0|^2, (N m)^2
    residual: Cell  # s^2, (N m)^2
    solution: Annotated[Array, 'motors.size * observer.enabled']  # [P_f; d - d_0]
    absorbed: Annotated[Array, 'p * observer.enabled']  # P_f, which follows it


class Workspace(NamedTuple):
    """Scratch of one sample."""

    factor: Annotated[Array, 'motors.size * observer.enabled', 'motors.size']
    before: Annotated[Array, 'p * observer.enabled']  # P_f of the last sample


@inner
def pass_poles(settings: Settings, state: State, sensed: Array, dt: float) -> None:
    """Pass tau_J of the last interval, `dt` [s], through both poles of a row.

    `sensed` is tau_J (n,) [N m].
    """
    gain = filter_gain(1.0 / settings.filter_pole, dt)
    for i in range(sensed.size):
        state.sensed1[i] += gain * (sensed[i] - state.sensed1[i])
        state.sensed2[i] += gain * (state.sensed1[i] - state.sensed2[i])


@inner
def forget(state: State) -> None:
    """Empty both poles of tau_J, as those of the rows are."""
    for i in range(state.sensed1.size):
        state.sensed1[i] = 0.0
        state.sensed2[i] = 0.0


@inner
def fade(settings: Settings, state: State, square_weight: float) -> float:
    """Let the means fade by one row with the mean square weight of its joints; return its gain.

    That is the weight with which `add_row` adds the row.
    """
    max_rows = _MEAN_WINDOWS * settings.length
    state.rows[0] = min(state.rows[0] + square_weight, max_rows)
    gain = 1.0 / (_EMPTY_ROWS * max_rows + state.rows[0])
    retained = 1.0 - square_weight * gain
    state.square[0] *= retained
    for a in range(state.b.size):
        state.b[a] *= retained
        for b in range(a, state.b.size):
            state.Phi[a, b] *= retained
    return float(gain)


@inner
def row_friction(
    state: State,
    row: Array,
    weight: float,
    i: int,
    rotors: Array,
    initial: Array,
    estimate: Array,
) -> float:
    """Return g - D d_0 of joint i [N m], the friction in a weighted `row` [X | D | u] (n, m + 1).

    Args:
        weight: by which the row of the joint is multiplied.
        rotors: P_r (p,).
        initial: theta (m,) with d_0.
        estimate: theta^ (m,) with d_c.
    """
    m = estimate.size
    g = row[i, m] - weight * state.sensed2[i]
    for j in range(rotors.size):
        g -= row[i, j] * rotors[j]
    for j in range(rotors.size, m):
        g -= row[i, j] * (initial[j] if j < state.b.size else estimate[j])
    return float(g)


@inner
def unexplained(
    state: State, row: Array, i: int, rotors: Array, estimate: Array, excluded: int
) -> float:
    """Return e of joint i [N m]: what P_f and d^ leave of g, without entry `excluded` of theta^.

    `row` [X | D | u] (m + 1,) is unweighted, theta^ the `estimate` (m,), P_r are `rotors` (p,).
    """
    m = estimate.size
    e = row[m] - state.sensed2[i]
    for j in range(rotors.size):
        e -= row[j] * (rotors[j] + state.absorbed[j])
    for j in range(rotors.size, m):
        if j != excluded:
            e -= row[j] * estimate[j]
    return float(e)


@inner
def add_row(state: State, row: Array, i: int, g: float, gain: float) -> None:
    """Add the row of joint i with its g - D d_0 [N m] to the means, with the `gain` of `fade`."""
    size = state.b.size
    state.square[0] += gain * g * g
    for a in range(size):
        scaled = gain * row[i, a]
        state.b[a] += scaled * g
        for b in range(a, size):
            state.Phi[a, b] += scaled * row[i, b]


@inner
def solve(
    settings: Settings, state: State, workspace: Workspace, information: Array
) -> None:
    """Solve for P_f and d; `information` is R (m, m).  s^2 is that of the last solution."""
    duration = max(state.rows[0], 1.0) * settings.period
    weight = max(settings.min_weight, state.residual[0] * CORRELATION / duration)
    for a in range(state.b.size):
        state.solution[a] = state.b[a]
        for b in range(a, state.b.size):
            workspace.factor[a, b] = state.Phi[a, b] + weight * information[a, b]
    cholesky_factor(workspace.factor)
    cholesky_solve(workspace.factor, state.solution)
    state.residual[0] = mean_residual(state)


@inner
def mean_residual(state: State) -> float:
    """Return the mean of |g - X P_f - D d|^2 [(N m)^2] for the solution."""
    x = state.solution
    residual = state.square[0]
    for a in range(x.size):
        product = state.Phi[a, a] * x[a] - 2.0 * state.b[a]
        for b in range(a + 1, x.size):
            product += 2.0 * state.Phi[a, b] * x[b]
        residual += product * x[a]
    return max(0.0, float(residual))


@inner
def follow(
    state: State, workspace: Workspace, weight: float, gain: Array, dt: float
) -> None:
    """Let P_f follow its solution for `dt` [s], at the rate `weight` times `gain` (m,) of P^.

    P_f of before is left in `workspace.before`.
    """
    for j in range(state.absorbed.size):
        workspace.before[j] = state.absorbed[j]
        error = state.solution[j] - state.absorbed[j]
        state.absorbed[j] += dt * weight * gain[j] * error


@inner
def follow_columns(
    state: State, initial: Array, active: Array, estimate: Array, rate: Array
) -> None:
    """Write d - d^ of the columns that the sensors identify to `rate` (m,), if `active` (m,).

    d_0 is of the `initial` theta (m,), d^ of the `estimate` (m,).
    """
    for j in range(state.absorbed.size, state.solution.size):
        if active[j] == 1.0:
            rate[j] = initial[j] + state.solution[j] - estimate[j]
