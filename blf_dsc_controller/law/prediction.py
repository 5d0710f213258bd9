# SPDX-License-Identifier: Apache-2.0
"""Rows [X | u] of the prediction error: X theta = u holds for the true theta = [P; d].

d/dt(Yp P) + Yr P + D d = tau, integrated over a sample of held
torque, gives

    X_k = (Yp_k - Yp_{k-1}) / T + (Yr_k + Yr_{k-1}) / 2,      X_k P + D_k d = tau on [k-1, k]

up to O(T^2).  Both sides pass through the same two cascaded poles, which preserves the
identity and filters the noise of the difference quotient.  No acceleration is needed.

Besides P, the learning estimates the coefficients d of the disturbance `columns` D.
`learning.form_row` calls these functions in order.
"""

from math import sqrt
from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.law.lag import filter_gain
from blf_dsc_controller.law.sums import clear

SETTLED = 6.0
"""Time constants of the poles after which a row shows nothing of what was before."""


class Settings(NamedTuple):
    """The parameters `learning.*` of a row, and what follows from others."""

    filter_pole: float  # of both poles, rad/s
    motion_scale: float  # reference velocity below which rows count less, rad/s; 0: off
    lag: float  # of measured velocities and applied torques together, s
    # of a joint's rows: smaller where more torque is unmodelled
    row_weight: Annotated[Array, 'n']


class State(NamedTuple):
    """What is kept from one sample to the next."""

    Yp: Annotated[Array, 'n', 'p']  # of the last sample
    Yr: Annotated[Array, 'n', 'm']  # [Yr | D] of the last sample
    lagged: Annotated[
        Array, 2, 'n'
    ]  # applied torque behind half of `lag`, and all, N m
    filter1: Annotated[Array, 'n', 'm + 1']  # first pole
    filter2: Annotated[Array, 'n', 'm + 1']  # second pole


class Workspace(NamedTuple):
    """Values of one sample: regressors of the momentum, and the row."""

    Yp: Annotated[Array, 'n', 'p']  # Yp P = M dq
    Yr: Annotated[Array, 'n', 'm']  # [Yr | D], Yr P = G - C^T dq
    Xu: Annotated[Array, 'n', 'm + 1']  # [X | u], the row


@inner
def delay_torque(
    settings: Settings, state: State, applied: Array, begins: bool, dt: float
) -> None:
    """Pass the `applied` torque (n,) [N m] through the lags of drives and sensors.

    A measured motion is that of a torque of `robot.lag` ago: half of it is the drives', half the
    velocity filter's.  The result is `state.lagged`.  Where it `begins`, the torque has always
    been applied.  `dt` [s] is the sample time.
    """
    passes = settings.lag == 0.0 or begins
    gain = 0.0
    if not passes:
        gain = filter_gain(0.5 * settings.lag, dt)
    for i in range(applied.size):
        torque = applied[i]
        for k in range(2):
            if passes:
                state.lagged[k, i] = torque
            torque = state.lagged[k, i] + gain * (torque - state.lagged[k, i])
            state.lagged[k, i] = torque


@inner
def fill_interval(state: State, workspace: Workspace, dt: float) -> None:
    """Compute [X | u] (n, m + 1) [N m] of the last interval, `dt` [s], as `workspace.Xu`.

    It is that between the last regressors, in `state`, and these, in `workspace`.
    """
    Yp, Yr, row = workspace.Yp, workspace.Yr, workspace.Xu
    n, m = Yr.shape
    for i in range(n):
        for j in range(m):
            row[i, j] = 0.5 * (Yr[i, j] + state.Yr[i, j])
        for j in range(Yp.shape[1]):
            row[i, j] += (Yp[i, j] - state.Yp[i, j]) * (1.0 / dt)
        row[i, m] = state.lagged[1, i]


@inner
def motion_weight(settings: Settings, dqr: float, i: int) -> float:
    """Return the weight of the row of joint i, whose reference has the velocity dqr [rad/s].

    Rows of a joint that hardly moves count less: its stiction would be mistaken for gravity.
    """
    weight = settings.row_weight[i]
    if settings.motion_scale > 0.0:
        weight *= abs(dqr) / sqrt(dqr**2 + settings.motion_scale**2)
    return float(weight)


@inner
def square_weight(speed: float, motion_scale: float) -> float:
    """Return the squared weight of a joint's row by its speed [rad/s]: 1 in motion, 0 at rest."""
    square = speed**2
    return square / (square + motion_scale**2 + 1e-12)


@inner
def mean_square_weight(dqr: Array, motion_scale: float) -> float:
    """Return the mean square weight of the joints' rows, w^2: 1 in motion, 0 at rest.

    dqr (n,) [rad/s] is the velocity of the reference.
    """
    mean = 0.0
    for i in range(dqr.size):
        mean += square_weight(dqr[i], motion_scale) / dqr.size
    return mean


@inner
def pass_poles(
    settings: Settings, state: State, workspace: Workspace, dqr: Array, dt: float
) -> None:
    """Pass [X | u] of the last interval, `dt` [s], through both poles, and weight it.

    dqr (n,) [rad/s] is the velocity of the reference.
    """
    row = workspace.Xu
    gain = filter_gain(1.0 / settings.filter_pole, dt)
    for i in range(dqr.size):
        weight = motion_weight(settings, dqr[i], i)
        for j in range(row.shape[1]):
            state.filter1[i, j] += gain * (row[i, j] - state.filter1[i, j])
            state.filter2[i, j] += gain * (state.filter1[i, j] - state.filter2[i, j])
            row[i, j] = weight * state.filter2[i, j]


@inner
def forget(state: State) -> None:
    """Empty the poles."""
    clear(state.filter1)
    clear(state.filter2)


@inner
def keep_regressors(state: State, workspace: Workspace) -> None:
    """Keep Yp and [Yr | D] of this sample for the next interval."""
    Yp, Yr = workspace.Yp, workspace.Yr
    for i in range(Yr.shape[0]):
        for j in range(Yr.shape[1]):
            state.Yr[i, j] = Yr[i, j]
            if j < Yp.shape[1]:
                state.Yp[i, j] = Yp[i, j]
