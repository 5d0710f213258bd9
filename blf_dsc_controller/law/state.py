# SPDX-License-Identifier: Apache-2.0
"""What a law remembers between two samples, and what it computes in one: two flat vectors.

Saving, restoring and comparing a controller is copying and comparing its state vector; nothing else
in the package remembers anything about the loop.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.views import part
from blf_dsc_controller.law.settings import Settings


class State(NamedTuple):
    """Views on a state vector. One-element arrays are scalars that the kernels write."""

    samples: np.ndarray  # (1,) samples answered
    cursor: np.ndarray  # (1,) oldest row of the window
    rows: np.ndarray  # (1,) rows in the window
    latched: np.ndarray  # (1,) 1 once (Phi_e, b_e) is kept
    latch_time: np.ndarray  # (1,) T_e, s
    lambda_min: np.ndarray  # (1,) of Phi at the last look
    latched_lambda: np.ndarray  # (1,) lambda_min of the latched window
    judged: np.ndarray  # (1,) 1 once the disturbance columns are accepted or refused
    alpha2: np.ndarray  # (n,) rad/s
    torque: np.ndarray  # (n,) torque commanded last, N m
    disturbance: np.ndarray  # (n,) d^3, N m
    observed: np.ndarray  # (n,) xi2 through the filter (8), rad/s
    observed_rate: np.ndarray  # (n,) its derivative, rad/s^2
    level_cuts: np.ndarray  # (n,) samples in which the torque was cut at its limit
    rate_cuts: np.ndarray  # (n,) samples in which it was cut at the limit of its rate
    estimate: np.ndarray  # (m,) theta^ = [P^; columns]
    momentum: np.ndarray  # (n, p) Yp of the last sample
    rest: np.ndarray  # (n, m) [Yr | columns] of the last sample
    filter1: np.ndarray  # (n, m + 1) first pole of the regressor filter
    filter2: np.ndarray  # (n, m + 1) second pole
    running: np.ndarray  # (m, m + 1) S of the window
    fresh: np.ndarray  # (m, m + 1) F of the window
    Phi: np.ndarray  # (m, m) latched Phi_e
    b: np.ndarray  # (m,) latched b_e
    factor: np.ndarray  # (m, m) Cholesky factor of Phi_e + rho I
    weakest: np.ndarray  # (m,) unit vector of the least excited direction
    active: np.ndarray  # (m,) 0 where a disturbance column has been refused
    ring: np.ndarray  # (N, n, m + 1) the window's rows


class Signals(NamedTuple):
    """Views on what one sample computes; nothing in it outlives the sample."""

    qr: np.ndarray  # (n,) rad
    dqr: np.ndarray  # (n,) rad/s
    ddqr: np.ndarray  # (n,) rad/s^2
    xi1: np.ndarray  # (n,) rad
    beta2: np.ndarray  # (n,) rad/s
    dalpha2: np.ndarray  # (n,) rad/s^2
    xi2: np.ndarray  # (n,) rad/s
    known: np.ndarray  # (n,) disturbance known to the law, N m
    acceleration: np.ndarray  # (n,) estimated ddq, rad/s^2
    demand: np.ndarray  # (n,) torque (28) before the limit, N m
    torque: np.ndarray  # (n,) torque commanded, N m
    cuts: np.ndarray  # (n,) how the torque was cut: 0, LEVEL_CUT, RATE_CUT, or their sum
    bound: np.ndarray  # (n,) k(t), rad
    knee: np.ndarray  # (n,) knee of the barrier of that bound, rad
    narrowing: np.ndarray  # (n,) k'/k, 1/s
    H: np.ndarray  # (n, p)
    momentum: np.ndarray  # (n, p) Yp
    rest: np.ndarray  # (n, m) [Yr | columns]
    row: np.ndarray  # (n, m + 1) filtered [X | u]
    Phi: np.ndarray  # (m, m) of the present window
    b: np.ndarray  # (m,)
    factor: np.ndarray  # (m, m)
    rate: np.ndarray  # (m,) theta^' [1/s]
    look: np.ndarray  # (m,) scratch of the look at the excitation


def state_size(settings: Settings) -> int:
    """Length of a state vector."""
    n, p, m = settings.n, settings.p, settings.m
    row = n * (m + 1)
    ring = settings.window * row
    return 8 + 7 * n + m + n * p + n * m + 2 * row + 4 * m * (m + 1) + m + ring


def signals_size(settings: Settings) -> int:
    """Length of a signals vector."""
    n, p, m = settings.n, settings.p, settings.m
    return 15 * n + 2 * n * p + n * m + n * (m + 1) + 2 * m * m + 3 * m


@inner
def state_of(vector: np.ndarray, settings: Settings) -> State:
    """Name the parts of a state vector."""
    n = settings.n
    p = settings.p
    m = settings.m
    row = n * (m + 1)
    estimate = 8 + 7 * n
    momentum = estimate + m
    rest = momentum + n * p
    filters = rest + n * m
    sums = filters + 2 * row
    squares = sums + 2 * m * (m + 1)
    columns = squares + 2 * m * m
    return State(
        samples=part(vector, 0, (1,)),
        cursor=part(vector, 1, (1,)),
        rows=part(vector, 2, (1,)),
        latched=part(vector, 3, (1,)),
        latch_time=part(vector, 4, (1,)),
        lambda_min=part(vector, 5, (1,)),
        latched_lambda=part(vector, 6, (1,)),
        judged=part(vector, 7, (1,)),
        alpha2=part(vector, 8, (n,)),
        torque=part(vector, 8 + n, (n,)),
        disturbance=part(vector, 8 + 2 * n, (n,)),
        observed=part(vector, 8 + 3 * n, (n,)),
        observed_rate=part(vector, 8 + 4 * n, (n,)),
        level_cuts=part(vector, 8 + 5 * n, (n,)),
        rate_cuts=part(vector, 8 + 6 * n, (n,)),
        estimate=part(vector, estimate, (m,)),
        momentum=part(vector, momentum, (n, p)),
        rest=part(vector, rest, (n, m)),
        filter1=part(vector, filters, (n, m + 1)),
        filter2=part(vector, filters + row, (n, m + 1)),
        running=part(vector, sums, (m, m + 1)),
        fresh=part(vector, sums + m * (m + 1), (m, m + 1)),
        Phi=part(vector, squares, (m, m)),
        factor=part(vector, squares + m * m, (m, m)),
        b=part(vector, columns, (m,)),
        weakest=part(vector, columns + m, (m,)),
        active=part(vector, columns + 2 * m, (m,)),
        ring=part(vector, columns + 3 * m, (settings.window, n, m + 1)),
    )


@inner
def signals_of(vector: np.ndarray, settings: Settings) -> Signals:
    """Name the parts of a signals vector."""
    n = settings.n
    p = settings.p
    m = settings.m
    regressor = 15 * n
    rest = regressor + 2 * n * p
    row = rest + n * m
    squares = row + n * (m + 1)
    columns = squares + 2 * m * m
    return Signals(
        qr=part(vector, 0, (n,)),
        dqr=part(vector, n, (n,)),
        ddqr=part(vector, 2 * n, (n,)),
        xi1=part(vector, 3 * n, (n,)),
        beta2=part(vector, 4 * n, (n,)),
        dalpha2=part(vector, 5 * n, (n,)),
        xi2=part(vector, 6 * n, (n,)),
        known=part(vector, 7 * n, (n,)),
        acceleration=part(vector, 8 * n, (n,)),
        demand=part(vector, 9 * n, (n,)),
        torque=part(vector, 10 * n, (n,)),
        cuts=part(vector, 11 * n, (n,)),
        bound=part(vector, 12 * n, (n,)),
        knee=part(vector, 13 * n, (n,)),
        narrowing=part(vector, 14 * n, (n,)),
        H=part(vector, regressor, (n, p)),
        momentum=part(vector, regressor + n * p, (n, p)),
        rest=part(vector, rest, (n, m)),
        row=part(vector, row, (n, m + 1)),
        Phi=part(vector, squares, (m, m)),
        factor=part(vector, squares + m * m, (m, m)),
        b=part(vector, columns, (m,)),
        rate=part(vector, columns + m, (m,)),
        look=part(vector, columns + 2 * m, (m,)),
    )
