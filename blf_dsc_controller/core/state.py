# SPDX-License-Identifier: Apache-2.0
"""What a law remembers between two samples, and what it computes in one: two flat vectors.

Saving, restoring and comparing a controller is copying and comparing its state vector; nothing else
in the package remembers anything about the loop.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blf_dsc_controller.core.kernel import kernel
from blf_dsc_controller.core.settings import Settings


class State(NamedTuple):
    """Views on a state vector. One-element arrays are scalars that the kernels write."""

    samples: np.ndarray  # (1,) samples answered
    cursor: np.ndarray  # (1,) oldest row of the window
    rows: np.ndarray  # (1,) rows in the window
    latched: np.ndarray  # (1,) 1 once (Phi_e, b_e) is kept
    latch_time: np.ndarray  # (1,) T_e, s
    lambda_min: np.ndarray  # (1,) of Phi at the last look
    alpha2: np.ndarray  # (n,) rad/s
    torque: np.ndarray  # (n,) torque commanded last, N m
    disturbance: np.ndarray  # (n,) d^3, N m
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
    demand: np.ndarray  # (n,) torque (28) before the limit, N m
    torque: np.ndarray  # (n,) torque commanded, N m
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
    return 6 + 3 * n + m + n * p + n * m + 2 * row + 4 * m * (m + 1) + ring


def signals_size(settings: Settings) -> int:
    """Length of a signals vector."""
    n, p, m = settings.n, settings.p, settings.m
    return 9 * n + 2 * n * p + n * m + n * (m + 1) + 2 * m * m + 3 * m


@kernel
def state_of(vector: np.ndarray, settings: Settings) -> State:
    """Name the parts of a state vector."""
    n = settings.n
    p = settings.p
    m = settings.m
    joint = vector[6 : 6 + 3 * n].reshape(3, n)
    at = 6 + 3 * n
    estimate = vector[at : at + m]
    at += m
    momentum = vector[at : at + n * p].reshape(n, p)
    at += n * p
    rest = vector[at : at + n * m].reshape(n, m)
    at += n * m
    filters = vector[at : at + 2 * n * (m + 1)].reshape(2, n, m + 1)
    at += 2 * n * (m + 1)
    sums = vector[at : at + 2 * m * (m + 1)].reshape(2, m, m + 1)
    at += 2 * m * (m + 1)
    squares = vector[at : at + 2 * m * m].reshape(2, m, m)
    at += 2 * m * m
    columns = vector[at : at + 2 * m].reshape(2, m)
    at += 2 * m
    return State(
        samples=vector[0:1],
        cursor=vector[1:2],
        rows=vector[2:3],
        latched=vector[3:4],
        latch_time=vector[4:5],
        lambda_min=vector[5:6],
        alpha2=joint[0],
        torque=joint[1],
        disturbance=joint[2],
        estimate=estimate,
        momentum=momentum,
        rest=rest,
        filter1=filters[0],
        filter2=filters[1],
        running=sums[0],
        fresh=sums[1],
        Phi=squares[0],
        factor=squares[1],
        b=columns[0],
        weakest=columns[1],
        ring=vector[at:].reshape(settings.window, n, m + 1),
    )


@kernel
def signals_of(vector: np.ndarray, settings: Settings) -> Signals:
    """Name the parts of a signals vector."""
    n = settings.n
    p = settings.p
    m = settings.m
    joint = vector[0 : 9 * n].reshape(9, n)
    at = 9 * n
    models = vector[at : at + 2 * n * p].reshape(2, n, p)
    at += 2 * n * p
    rest = vector[at : at + n * m].reshape(n, m)
    at += n * m
    row = vector[at : at + n * (m + 1)].reshape(n, m + 1)
    at += n * (m + 1)
    squares = vector[at : at + 2 * m * m].reshape(2, m, m)
    at += 2 * m * m
    columns = vector[at : at + 3 * m].reshape(3, m)
    return Signals(
        qr=joint[0],
        dqr=joint[1],
        ddqr=joint[2],
        xi1=joint[3],
        beta2=joint[4],
        dalpha2=joint[5],
        xi2=joint[6],
        demand=joint[7],
        torque=joint[8],
        H=models[0],
        momentum=models[1],
        rest=rest,
        row=row,
        Phi=squares[0],
        factor=squares[1],
        b=columns[0],
        rate=columns[1],
        look=columns[2],
    )
