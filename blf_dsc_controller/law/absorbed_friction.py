# SPDX-License-Identifier: Apache-2.0
"""What P^ has absorbed of the friction of the motors, by joint torque sensors.

P^ is learned from the torque u of the motors.  It takes all of it that X can describe: the
torque of the links, and what friction has that is not in its columns D.  With the torque
tau_J that sensors behind the gears show, and P_r of the assumed rotors,

    g = u - X P_r - D d^ - tau_J

is that friction alone, whatever the links carry and whatever pushes them.  What X
describes of it is the share of P^:

    P_f = argmin sum |g - X P_f|^2 + a P_f^T R P_f,      a = s^2 CORRELATION / T

as for the rows of `innovation`, one each T, with s^2 the mean square of g - X P_f: a torque that X
does not describe, as of a motor that drags, makes P_f small.  The rows are those of the
window, but fade over `_WINDOWS` of it in motion, as friction outlasts what is carried.

P^ - P_f - P_r describes the links: by it `load_observer` sees what acts on them.  P_f follows
while P^ learns, at the same rate.
"""

from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, Cell
from blf_dsc_controller.law.innovation import CORRELATION
from blf_dsc_controller.law.lag import filter_gain
from blf_dsc_controller.numerics.algebra import cholesky_factor, cholesky_solve

_WINDOWS = 3.0  # of the learning; by choice, not derived
_NOTHING = 0.1  # of that: rows of zeros before the first


class Settings(NamedTuple):
    """The rows that it uses, and the least weight of its prior."""

    size: int  # entries of theta that are found: P, and d but for Coulomb friction and ripple
    filter_pole: float  # of both poles of a row, rad/s
    length: int  # rows in a window
    period: float  # T, s
    least_weight: float  # of R, on means over the rows


class State(NamedTuple):
    """Means over its rows, and their solution."""

    sensed1: Annotated[Array, 'n * observer.enabled']  # tau_J behind one pole, N m
    sensed2: Annotated[Array, 'n * observer.enabled']  # and behind both, N m
    rows: Cell  # of motion so far
    Phi: Annotated[Array, 'absorbed.size * observer.enabled', 'absorbed.size']  # of X^T X, upper triangle
    b: Annotated[Array, 'absorbed.size * observer.enabled']  # of X^T g
    square: Cell  # of |g|^2, (N m)^2
    residual: Cell  # s^2, of |g - X P_f|^2, (N m)^2
    solution: Annotated[Array, 'absorbed.size * observer.enabled']
    absorbed: Annotated[Array, 'p * observer.enabled']  # P_f, which follows it


class Work(NamedTuple):
    """Scratch of one sample."""

    factor: Annotated[Array, 'absorbed.size * observer.enabled', 'absorbed.size']
    before: Annotated[Array, 'p * observer.enabled']  # P_f of the last sample


@inner
def pass_poles(settings: Settings, state: State, sensed: Array, dt: float) -> None:
    """Pass tau_J, `sensed` (n,) [N m] in the last interval, through both poles of a row."""
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
def fade(settings: Settings, state: State, moving: float) -> float:
    """Let the means fade by one row, whose joints have the mean square weight `moving`.

    Return its share of them.
    """
    most = _WINDOWS * settings.length
    state.rows[0] = min(state.rows[0] + moving, most)
    share = 1.0 / (_NOTHING * most + state.rows[0])
    kept = 1.0 - moving * share
    state.square[0] *= kept
    for a in range(state.b.size):
        state.b[a] *= kept
        for b in range(a, state.b.size):
            state.Phi[a, b] *= kept
    return float(share)


@inner
def unexplained(
    state: State,
    row: Array,
    weight: float,
    i: int,
    rotors: Array,
    initial: Array,
    estimate: Array,
) -> float:
    """Return g of joint i [N m] by its `weight`, for a `row` [X | D | u] (n, m + 1)."""
    m = estimate.size
    g = row[i, m] - weight * state.sensed2[i]
    for j in range(rotors.size):
        g -= row[i, j] * rotors[j]
    for j in range(rotors.size, m):
        g -= row[i, j] * (initial[j] if j < state.b.size else estimate[j])
    return float(g)


@inner
def add_row(state: State, row: Array, i: int, g: float, share: float) -> None:
    """Add the row of joint i with its g [N m] to the means."""
    p = state.b.size
    state.square[0] += share * g * g
    for a in range(p):
        scaled = share * row[i, a]
        state.b[a] += scaled * g
        for b in range(a, p):
            state.Phi[a, b] += scaled * row[i, b]


@inner
def solve(settings: Settings, state: State, work: Work, information: Array) -> None:
    """Solve for P_f; the `information` (m, m) is R.  s^2 is that of the last solution."""
    duration = max(state.rows[0], 1.0) * settings.period
    weight = max(settings.least_weight, state.residual[0] * CORRELATION / duration)
    for a in range(state.b.size):
        state.solution[a] = state.b[a]
        for b in range(a, state.b.size):
            work.factor[a, b] = state.Phi[a, b] + weight * information[a, b]
    cholesky_factor(work.factor)
    cholesky_solve(work.factor, state.solution)
    state.residual[0] = mean_residual(state)


@inner
def mean_residual(state: State) -> float:
    """Return the mean of |g - X P_f|^2 [(N m)^2] for the solution."""
    P_f = state.solution
    residual = state.square[0]
    for a in range(P_f.size):
        product = state.Phi[a, a] * P_f[a] - 2.0 * state.b[a]
        for b in range(a + 1, P_f.size):
            product += 2.0 * state.Phi[a, b] * P_f[b]
        residual += product * P_f[a]
    return max(0.0, float(residual))


@inner
def follow(state: State, work: Work, weight: float, gain: Array, dt: float) -> None:
    """Let P_f follow its solution for `dt` [s], at the rate of P^: `weight` times `gain` (m,).

    What it was before is left in the scratch.
    """
    for j in range(state.absorbed.size):
        work.before[j] = state.absorbed[j]
        missing = state.solution[j] - state.absorbed[j]
        state.absorbed[j] += dt * weight * gain[j] * missing


@inner
def follow_columns(
    state: State, initial: Array, active: Array, estimate: Array, rate: Array
) -> None:
    """Write d - d^ of the columns that are found by sensors to `rate` (m,), if `active` (m,)."""
    for j in range(state.absorbed.size, state.solution.size):
        if active[j] == 1.0:
            rate[j] = initial[j] + state.solution[j] - estimate[j]


@inner
def unexplained_friction(
    state: State, row: Array, i: int, rotors: Array, estimate: Array, own: int
) -> float:
    """Return what P_f and theta^, but for its entry `own`, leave of the motor's friction [N m]."""
    m = estimate.size
    e = row[m] - state.sensed2[i]
    for j in range(rotors.size):
        e -= row[j] * (rotors[j] + state.absorbed[j])
    for j in range(rotors.size, m):
        if j != own:
            e -= row[j] * estimate[j]
    return float(e)
