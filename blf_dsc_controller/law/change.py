# SPDX-License-Identifier: Apache-2.0
"""Whether the arm has changed: rows contradict those before them, or the latched solution.

With a prior, each row is compared with what the rows of the window so far and the prior
predict (see `innovation`).  The solution of a window says nothing about postures
outside of it, and its residual, if it has rested, nothing about motion: both would look
like changes.

Planar arms have no prior.  There the mean square error of the latched solution over the
last 0.1 s is compared with the residual that it had.

If the arm has changed, window, filters and latch are cleared, and learning restarts.
What was learned from a window before it was full is taken back: it did not predict what it
was not fitted to (`learning.detect_change`).

Something may push the arm for seconds, with a torque that no parameters explain.  Rows
would contradict those before again and again, and nothing would ever be learned.  So
after three changes in a row the contradiction is taken for noise for a while.
"""

from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, Cell
from blf_dsc_controller.law import excitation, innovation, window
from blf_dsc_controller.law.innovation import Prior
from blf_dsc_controller.law.window import Window
from blf_dsc_controller.numerics.algebra import cholesky_factor, cholesky_solve

# ratio of mean squares; larger than the gate's, since a solution extrapolates
_ALARM_RATIO = 8.0
# s from one change to the next.  A load that comes on may be detected twice so soon; rows that
# change a third time are of no arm
_SOON_TIME = 0.3
_HASTY_CHANGES = 2.0  # in a row, each so soon after the one before


class State(NamedTuple):
    """What is kept from one row to the next."""

    changes: Cell  # number of changes of the arm that were detected
    hasty: Cell  # the last changes that came soon after the one before
    announced: Cell  # 1: a change of the arm is announced for now
    contradiction: Cell  # `recent_residual` at the last change, (N m)^2
    recent_residual: Cell  # of the last rows against the solution, (N m)^2
    # with a prior: theta of the rows so far, and the factor of its equations
    rows_fit: Annotated[Array, 'm']
    rows_factor: Annotated[Array, 'm', 'm']
    innovation: innovation.State  # of these rows


class Workspace(NamedTuple):
    """Scratch of one row."""

    predicted: Annotated[Array, 'n', 'm']
    innovation: Annotated[Array, 'n']
    covariance: Annotated[Array, 'n', 'n']
    before: Annotated[Array, 'm']  # theta^ before it is taken back


@inner
def compare_row(
    state: State, row: Array, theta: Array, period: float, error: Array
) -> None:
    """Write the residual e = u - X theta (n,) [N m] of a row to `error`; average its square.

    `row` is [X | u] (n, m + 1), `theta` (m,), `period` [s] the time from one row to the next.  The
    average over 0.1 s is `state.recent_residual`.
    """
    m = theta.size
    square = 0.0
    for i in range(error.size):
        e = row[i, m]
        for j in range(m):
            e -= row[i, j] * theta[j]
        error[i] = e
        square += e * e
    state.recent_residual[0] += min(1.0, period / innovation.MEMORY) * (
        square - state.recent_residual[0]
    )


@inner
def compare_with_solution(
    settings: excitation.Settings,
    state: State,
    workspace: Workspace,
    latch: excitation.State,
    row: Array,
    dt: float,
) -> bool:
    """Return whether the last rows contradict the latched solution: the arm has changed.

    `row` is [X | u] (n, m + 1) of the last interval, `dt` [s] long.  They contradict it where
    their mean square residual exceeds 8 times what noise and unmodelled torque explain.
    """
    if latch.latched[0] == 0.0:
        return False
    compare_row(state, row, latch.solution, dt, workspace.innovation)
    min_residual = latch.min_residual[0]
    allowed = _ALARM_RATIO * excitation.explained(
        settings, min_residual, latch.residual[0]
    )
    return bool(state.recent_residual[0] > allowed)


@inner
def compare_with_rows(
    state: State,
    workspace: Workspace,
    sliding: Window,
    prior: Prior,
    row: Array,
    square_weight: float,
    unmodelled: float,
    samples: int,
    dt: float,
) -> bool:
    """Return whether the last rows contradict those of the window before them: the arm has changed.

    Rows come each `row_interval` samples, else this returns False.  theta of the rows so far is
    solved for anew ten times a second.

    Args:
        row: [X | u] (n, m + 1).
        square_weight: mean square weight of the row's joints, w^2 of `innovation`.
        unmodelled: mean square torque of a joint that no column describes [(N m)^2].
        samples: number of samples so far.
        dt: sample time [s].
    """
    window_settings = sliding.settings
    if samples % window_settings.row_interval != 0:
        return False
    period = window_settings.row_interval * dt
    if state.innovation.noise[0] == 0.0:
        innovation.begin(state.innovation, unmodelled)
        fit_rows(state, sliding, prior, period)
    compare_row(state, row, state.rows_fit, period, workspace.innovation)
    n, m = workspace.predicted.shape
    for i in range(n):
        for j in range(m):
            workspace.predicted[i, j] = row[i, j]
    square = innovation.normalized_square(
        workspace.predicted,
        workspace.innovation,
        state.rows_factor,
        period,
        workspace.covariance,
    )
    statistics = state.innovation
    if innovation.update(
        statistics, square, square_weight, unmodelled, period, window_settings.length
    ):
        return True
    refresh = max(1, round(innovation.REFRESH / period))
    # a quarter later than the excitation is checked: not both in one sample
    if samples // window_settings.row_interval % refresh == refresh // 4:
        fit_rows(state, sliding, prior, period)
    return False


@inner
def fit_rows(state: State, sliding: Window, prior: Prior, period: float) -> None:
    """Solve for theta of the rows so far, one each `period` [s], with the prior: A theta = b.

    A and b are those of `innovation`.  theta and the factor of A are left in `state`.
    """
    a = innovation.row_variance(state.innovation, period)
    factor = state.rows_factor
    theta = state.rows_fit
    window.average_window(sliding.state.running, 1, factor, theta)
    window.pull_to(prior.estimate, a, prior.information, factor, theta)
    cholesky_factor(factor)
    cholesky_solve(factor, theta)


@inner
def count_change(
    state: State,
    latch: excitation.State,
    sliding: Window,
    prior: Prior,
    estimate: Array,
    dt: float,
) -> None:
    """Count a change of the arm; forget window and latch.  The `estimate` (m,) becomes the anchor.

    The third of three changes that soon follow one another is attributed to a torque that lasts:
    the rows' noise is raised, so that learning goes on.  `dt` [s] is the sample time.
    """
    window_settings = sliding.settings
    age = sliding.state.rows[0] * window_settings.row_interval * dt
    state.changes[0] += 1.0
    state.hasty[0] = state.hasty[0] + 1.0 if age < _SOON_TIME else 0.0
    if state.hasty[0] >= _HASTY_CHANGES:
        innovation.raise_noise(state.innovation)
    state.contradiction[0] = state.recent_residual[0]
    state.recent_residual[0] = 0.0
    excitation.unlatch(latch, estimate)
    window.forget(sliding.state)
    innovation.forget_recent(state.innovation)
    fit_rows(state, sliding, prior, window_settings.row_interval * dt)
