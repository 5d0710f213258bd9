# SPDX-License-Identifier: Apache-2.0
"""What a law remembers between two samples, and what it computes in one: two flat vectors.

Saving, restoring and comparing a controller is copying and comparing its state vector; nothing else
in the package remembers anything about the loop.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.layout import Array, Cell, size_of, view_of


class State(NamedTuple):
    """Views on a state vector. One-element arrays are scalars that the kernels write."""

    samples: Cell  # samples answered
    cursor: Cell  # oldest row of the window
    rows: Cell  # rows in the window
    latched: Cell  # 1 once (Phi_e, b_e) is kept
    latch_time: Cell  # T_e, s
    lambda_min: Cell  # of Phi at the last look
    latched_lambda: Cell  # lambda_min of the latched window
    judged: Cell  # 1 once the disturbance columns are accepted or refused
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
    running: Annotated[Array, 'm', 'm + 1']  # S of the window
    fresh: Annotated[Array, 'm', 'm + 1']  # F of the window
    Phi: Annotated[Array, 'm', 'm']  # latched Phi_e
    b: Annotated[Array, 'm']  # latched b_e
    factor: Annotated[Array, 'm', 'm']  # Cholesky factor of Phi_e + rho I
    weakest: Annotated[Array, 'm']  # unit vector of the least excited direction
    active: Annotated[Array, 'm']  # 0 where a disturbance column has been refused
    ring: Annotated[Array, 'window', 'n', 'm + 1']  # the window's rows


class Signals(NamedTuple):
    """Views on what one sample computes; nothing in it outlives the sample."""

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
    H: Annotated[Array, 'n', 'p']
    momentum: Annotated[Array, 'n', 'p']  # Yp
    rest: Annotated[Array, 'n', 'm']  # [Yr | columns]
    row: Annotated[Array, 'n', 'm + 1']  # filtered [X | u]
    Phi: Annotated[Array, 'm', 'm']  # of the present window
    b: Annotated[Array, 'm']
    factor: Annotated[Array, 'm', 'm']
    rate: Annotated[Array, 'm']  # theta^' [1/s]
    look: Annotated[Array, 'm']  # scratch of the look at the excitation


state_of, state_size = view_of(State), size_of(State)
signals_of, signals_size = view_of(Signals), size_of(Signals)
