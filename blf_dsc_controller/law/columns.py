# SPDX-License-Identifier: Apache-2.0
"""Disturbance columns D, whose coefficients d are learned with the parameters P.

    tau_dist = D d,    D = [ I | diag(dq) | diag(tanh(dq / v_c)) | I sin(w t) | I cos(w t) | ... ]

for each block that is configured, and those of `load_friction` and `ripple`.  (22)-(24) instead
subtract the estimate d^3 from the torque, which hides the parameter error.
"""

from typing import Annotated, NamedTuple

from blf_dsc_controller.arms.friction import sliding
from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.numerics.elementary import cos, sin


class Settings(NamedTuple):
    """The parameters `learning.*` that say which columns there are."""

    first: int  # index of the first column in theta: p
    bias: int  # 1: a constant column per joint
    viscous: int  # 1: a column dq_i per joint
    coulomb: int  # 1: a column tanh(dq_i / coulomb_velocity) per joint
    coulomb_velocity: float  # rad/s
    load_friction: int  # 1: the column of `load_friction` per joint
    tones: int  # number of frequencies, each with a sine and a cosine column per joint
    # number of ripple cycles, each with a sine and a cosine column per joint
    ripples: int
    # of the sine and cosine columns, rad/s
    frequencies: Annotated[Array, 'columns.tones']
    ripple_cycles: Annotated[Array, 'columns.ripples']  # periods per turn


@inner
def set_block(Yr: Array, at: int, i: int, value: float) -> None:
    """Set entry (i, i) of the block that starts at column `at`; zero the others of its row."""
    for k in range(Yr.shape[0]):
        Yr[i, at + k] = 0.0
    Yr[i, at + i] = value


@inner
def fill_columns(settings: Settings, t: float, dq: Array, Yr: Array) -> None:
    """Fill D, the last columns of [Yr | D] (n, m), at time t [s] and velocity dq (n,) [rad/s]."""
    n = dq.size
    for i in range(n):
        at = settings.first
        if settings.bias == 1:
            set_block(Yr, at, i, 1.0)
            at += n
        if settings.viscous == 1:
            set_block(Yr, at, i, dq[i])
            at += n
        if settings.coulomb == 1:
            set_block(Yr, at, i, sliding(dq[i], settings.coulomb_velocity))
            at += n
        at += n * settings.load_friction
        for k in range(settings.tones):
            set_block(Yr, at, i, sin(settings.frequencies[k] * t))
            set_block(Yr, at + n, i, cos(settings.frequencies[k] * t))
            at += 2 * n
