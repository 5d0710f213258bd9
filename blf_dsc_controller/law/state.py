# SPDX-License-Identifier: Apache-2.0
"""State of a law between two samples, signals within one, and the telemetry sample: flat vectors.

Saving, restoring and comparing a controller is copying and comparing its state vector: the package
keeps no other state of the loop.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.layout import Array, Cell, size_of, view_of


class State(NamedTuple):
    """What a law keeps from one sample to the next."""

    samples: Cell  # samples so far
    cursor: Cell  # oldest row of the window
    rows: Cell  # rows in the window
    latched: Cell  # 1 once (Phi_e, b_e) is kept
    latch_time: Cell  # T_e, s
    lambda_min: Cell  # of Phi at the last check
    latched_lambda: Cell  # lambda_min of the latched window
    best_lambda: Cell  # the largest of a full window since the last change
    columns_checked: Cell  # 1 once the disturbance columns are accepted or rejected
    residual: Cell  # mean square torque residual of the latched window, (N m)^2
    least_residual: Cell  # the lowest of any full window, (N m)^2
    recent_residual: Cell  # of the last rows to `solution`, (N m)^2
    changes: Cell  # times that the arm was found to have changed
    change_time: Cell  # of the last, s
    contradiction: Cell  # `recent_residual` at the last change, (N m)^2
    alpha2: Annotated[Array, 'n']  # rad/s
    torque: Annotated[Array, 'n']  # torque commanded last, N m
    disturbance: Annotated[Array, 'n']  # d^3, N m
    observed: Annotated[Array, 'n']  # xi2 through the filter (8), rad/s
    observed_rate: Annotated[Array, 'n']  # its derivative, rad/s^2
    level_cuts: Annotated[Array, 'n']  # samples in which the torque was cut at its limit
    rate_cuts: Annotated[Array, 'n']  # samples in which it was cut at the limit of its rate
    estimate: Annotated[Array, 'm']  # theta^ = [P^; columns]
    momentum: Annotated[Array, 'n', 'p']  # Yp of the last sample
    rest: Annotated[Array, 'n', 'm']  # [Yr | columns] of the last sample
    filter1: Annotated[Array, 'n', 'm + 1']  # first pole of the regressor filter
    filter2: Annotated[Array, 'n', 'm + 1']  # second pole
    running: Annotated[Array, 'm + 1', 'm + 1']  # S of the window
    fresh: Annotated[Array, 'm + 1', 'm + 1']  # F of the window
    Phi: Annotated[Array, 'm', 'm']  # latched Phi_e
    b: Annotated[Array, 'm']  # latched b_e
    factor: Annotated[Array, 'm', 'm']  # Cholesky factor of Phi_e + rho I
    solution: Annotated[Array, 'm']  # of the latched window, (Phi_e + rho I)^-1 b_e
    anchor: Annotated[Array, 'm']  # theta^ that windows of little information are pulled to
    min_eigenvector: Annotated[Array, 'm']  # of Phi, a unit vector
    active: Annotated[Array, 'm']  # 0 where a disturbance column has been rejected
    ring: Annotated[Array, 'window', 'n', 'm + 1']  # the window's rows


class Signals(NamedTuple):
    """What a law computes in one sample."""

    qr: Annotated[Array, 'n']  # rad
    dqr: Annotated[Array, 'n']  # rad/s
    ddqr: Annotated[Array, 'n']  # rad/s^2
    xi1: Annotated[Array, 'n']  # rad
    beta2: Annotated[Array, 'n']  # rad/s
    dalpha2: Annotated[Array, 'n']  # rad/s^2
    xi2: Annotated[Array, 'n']  # rad/s
    known: Annotated[Array, 'n']  # disturbance known to the law, N m
    acceleration: Annotated[Array, 'n']  # estimated ddq, rad/s^2
    demand: Annotated[Array, 'n']  # torque (28) before the limit, N m
    torque: Annotated[Array, 'n']  # torque commanded, N m
    cuts: Annotated[Array, 'n']  # how the torque was cut: 0, LEVEL_CUT, RATE_CUT, or their sum
    bound: Annotated[Array, 'n']  # k(t), rad
    knee: Annotated[Array, 'n']  # knee of the barrier of that bound, rad
    narrowing: Annotated[Array, 'n']  # k'/k, 1/s
    H: Annotated[Array, 'n', 'm']  # [H | columns that are compensated]
    momentum: Annotated[Array, 'n', 'p']  # Yp
    rest: Annotated[Array, 'n', 'm']  # [Yr | columns]
    row: Annotated[Array, 'n', 'm + 1']  # filtered [X | u]
    Phi: Annotated[Array, 'm', 'm']  # of the present window
    b: Annotated[Array, 'm']
    factor: Annotated[Array, 'm', 'm']
    inertia: Annotated[Array, 'n', 'n']  # M^(q) less its least admissible, or its factor
    unit: Annotated[Array, 'n']  # scratch
    rate: Annotated[Array, 'm']  # theta^' [1/s]
    work: Annotated[Array, 'm']  # scratch


class Sample(NamedTuple):
    """Telemetry of one sample; a run is a matrix of such rows."""

    qr: Annotated[Array, 'n']  # rad
    dqr: Annotated[Array, 'n']  # rad/s
    xi1: Annotated[Array, 'n']  # rad
    xi2: Annotated[Array, 'n']  # rad/s
    torque: Annotated[Array, 'n']  # commanded, after the limit, N m
    disturbance: Annotated[Array, 'n']  # d^3 and the learned friction, N m
    bound: Annotated[Array, 'n']  # k(t), rad
    cuts: Annotated[Array, 'n']  # 0, or LEVEL_CUT + RATE_CUT as the torque was cut in this sample
    estimate: Annotated[Array, 'm']  # theta^; NaN for a disturbance column that has been rejected
    lyapunov: Annotated[Array, 4]  # terms of (29): error, kinetic, parameters, disturbance; or NaN
    lambda_min: Cell  # of the present window's Phi
    latched: Cell  # 0 or 1
    changes: Cell  # times that the arm was found to have changed


state_of, state_size = view_of(State), size_of(State)
signals_of, signals_size = view_of(Signals), size_of(Signals)
sample_of, sample_size = view_of(Sample), size_of(Sample)
