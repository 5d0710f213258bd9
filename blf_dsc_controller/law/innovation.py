# SPDX-License-Identifier: Apache-2.0
"""Whether a row is what the rows before it predict, or the arm has changed between them.

Rows X theta = u with residuals of the variance s^2, correlated for `CORRELATION`, and
the prior N(theta_0, R^-1) give theta.  With a row each T, whose [X | u]^T [X | u] add
up to S:

    theta ~ N(A^-1 b, a A^-1),  A = S_XX + a R,  b = S_Xu + a R theta_0,
    a = s^2 CORRELATION / T.

The innovation e = u - X theta of a later row has the covariance s^2 C, with

    C = I + a / s^2 X A^-1 X^T.

A row is thus judged by what is known of theta so far, from the first row on, when many
theta explain the rows.

Rows of joints that hardly move have a small weight (see `prediction`), and are small
whatever the arm is.  They must not count as rows that fit: after a rest, s^2 would be
next to nothing, and the first motion a change.  So a mean is that of rows by their
weights: with w^2, the mean square of the weights of a row's joints,

    mean = sum(e^T C^-1 e / n) / sum(w^2).

The arm has changed where the mean over 0.1 s of motion exceeds eight times s^2, and
more where s^2, which is of few rows, may be too small (`alarm`).

s^2 is assumed at first, and measured as the mean.  Rows that fit ever worse raise it as
they come, and contradict nothing.  It has a floor for some seconds after rows have
contradicted those before again and again, as under a push (`raise_noise`).
"""

from typing import NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, Cell
from blf_dsc_controller.numerics.algebra import cholesky_factor, whiten
from blf_dsc_controller.numerics.elementary import exp

CORRELATION = 0.2  # s, of the residual
REFRESH = 0.1  # s, from one solution to the next
LASTING = 2.0  # s, in which a floor of s^2 falls to 1 / e
MEMORY = 0.1  # s of motion, over which the last rows are averaged
DETECTION_TIME = 0.15  # s, within which a change of the arm is detected
# times s^2: friction is no noise, and reaches what the noise of a sensor never would
_ALARM_SQUARE = 8.0
# s^2 before any row, of the square of the torque that is unmodelled; counts as so many
# rows, and ever less until the mean square is of a window
_ASSUMED_FRACTION, _ASSUMED_ROWS = 0.1, 100.0
# times s^2, as which a row counts: those of a change hardly raise it
_MAX_SQUARE = 3.0
_MIN_SQUARE = 0.001  # of that square, which s^2 is at least


class Prior(NamedTuple):
    """What is known of theta before any row."""

    estimate: Array  # theta_0 (m,)
    information: Array  # R (m, m)


class State(NamedTuple):
    """Means of e^T C^-1 e / n by the weights of the rows so far."""

    noise: Cell  # s^2, (N m)^2; 0 before `begin`
    mean: Cell  # mean square
    rows: Cell  # moving ones that it is of
    recent: Cell  # mean over 0.1 s of motion
    floor: Cell  # s^2 at least, for some time after it was raised


@inner
def begin(state: State, unmodelled: float) -> None:
    """Begin with s^2 assumed from the mean square torque that is `unmodelled` [(N m)^2]."""
    state.noise[0] = _ASSUMED_FRACTION * unmodelled
    state.mean[0] = 0.0
    state.rows[0] = 0.0
    forget_recent(state)


@inner
def forget_recent(state: State) -> None:
    """Forget the mean of the last rows: those that follow are of another arm."""
    state.recent[0] = 0.0


@inner
def raise_noise(state: State) -> None:
    """Take the last rows for noise: no theta explains their torque.

    s^2 stays that large for some `LASTING`, and is measured meanwhile as if it were not.
    """
    state.floor[0] = max(state.noise[0], state.recent[0])
    state.noise[0] = state.floor[0]


@inner
def row_variance(state: State, period: float) -> float:
    """Return a = s^2 CORRELATION / T [(N m)^2], the variance of a row, one each T [s].

    `period` is T.
    """
    return float(state.noise[0] * CORRELATION / period)


@inner
def normalized_square(
    X: Array, e: Array, factor: Array, period: float, C: Array
) -> float:
    """Return e^T C^-1 e / n [(N m)^2] of a row, the mean square of its normalized innovation.

    Args:
        X: row (n, m), overwritten.
        e: innovation (n,) [N m], overwritten.
        factor: Cholesky factor of A (m, m).
        period: T [s], from one row to the next.
        C: scratch (n, n).
    """
    n = e.size
    for i in range(n):
        whiten(factor, X[i])
    for i in range(n):
        for j in range(i, n):
            total = 0.0
            for k in range(X.shape[1]):
                total += X[i, k] * X[j, k]
            C[i, j] = CORRELATION / period * total
        C[i, i] += 1.0
    cholesky_factor(C)
    return whiten(C, e) / n


@inner
def update(
    state: State,
    square: float,
    square_weight: float,
    unmodelled: float,
    period: float,
    window_rows: float,
) -> bool:
    """Add a row with its normalized square [(N m)^2]; return whether the arm has changed.

    Args:
        square: e^T C^-1 e / n of the row.
        square_weight: w^2 of the row.
        unmodelled: mean square torque that no column describes [(N m)^2].
        period: T [s].
        window_rows: moving rows over which the mean square is taken, a window.
    """
    excess = square - square_weight * state.recent[0]
    state.recent[0] += min(1.0, period / MEMORY) * excess
    has_changed = state.recent[0] > alarm(state, period, window_rows)
    noise = noise_estimate(state.mean[0], state.rows[0], unmodelled, window_rows)
    state.rows[0] = min(state.rows[0] + square_weight, window_rows)
    if state.rows[0] > 0.0:
        clipped = min(square, _MAX_SQUARE * square_weight * noise)
        state.mean[0] += (clipped - square_weight * state.mean[0]) / state.rows[0]
    state.floor[0] *= 1.0 - period / LASTING
    noise = noise_estimate(state.mean[0], state.rows[0], unmodelled, window_rows)
    state.noise[0] = max(noise, state.floor[0])
    return bool(has_changed)


@inner
def alarm(state: State, period: float, window_rows: float) -> float:
    """Return the mean square [(N m)^2] above which the arm has changed.

    It is 8 s^2 where s^2 is the mean of `window_rows`, and more where it is that of fewer.
    """
    rows = state.rows[0] + _ASSUMED_ROWS * (1.0 - state.rows[0] / window_rows)
    excess = _excess(rows * period / CORRELATION)
    window_excess = _excess(window_rows * period / CORRELATION)
    return float(_ALARM_SQUARE * state.noise[0] * max(1.0, excess / window_excess))


@inner
def _excess(rows: float) -> float:
    """Return the F whose F s^2 is as improbable as 8 s^2 if s^2 were known, not of `rows`.

    These are independent.  The innovations of n joints are then multivariate t with
    nu = n `rows` degrees of freedom, so that

        (nu + n) / 2 log(1 + n F / nu) = 8 n / 2
    """
    return float(rows * (exp(_ALARM_SQUARE / (rows + 1.0)) - 1.0))


@inner
def noise_estimate(
    mean: float, count: float, unmodelled: float, window_rows: float
) -> float:
    """Return s^2 [(N m)^2]: the `mean` square of `count` rows, and an assumption that fades.

    A tenth of `unmodelled` [(N m)^2] is assumed, which counts as 100 rows at first.
    """
    assumed_rows = _ASSUMED_ROWS * (1.0 - count / window_rows)
    assumed_fraction = assumed_rows / (assumed_rows + count)
    noise = mean + assumed_fraction * (_ASSUMED_FRACTION * unmodelled - mean)
    return max(noise, _MIN_SQUARE * unmodelled)
