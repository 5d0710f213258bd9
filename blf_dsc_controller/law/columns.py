# SPDX-License-Identifier: Apache-2.0
"""Disturbance columns D, whose coefficients d are learned with the parameters P.

    tau_dist = D d,    D_k = diag(a_k)                                                 [N m]

Each block k of D has a column per joint, with the entry a_k of its kind:

    kind                      entry a_k             compensated
    BIAS                      1                     by d^3
    SINE, COSINE              sin w t, cos w t      by d^3
    RIPPLE_SINE, _COSINE      sin N q, cos N q      at the reference
    VISCOUS                   dq                    at the reference
    LOAD_FRICTION             |tau_L| s(dq)         at the reference
    COULOMB                   s(dq)                 by `friction`, with s(v) = tanh(v / v_c)

A kind is one entry here, and one of `factory.estimate` with its name, unit and prior.  (22)-(24)
instead subtract the estimate d^3 from the torque, which hides the parameter error.

*Torque ripple.*  Strain-wave gears and motors with poles disturb a joint by a torque that repeats
N times in each turn of it.

*Friction that grows with the load.*  The teeth of a gear rub the more, the more torque it carries:
a fraction of the torque tau_L, which the learned model has along the reference, is lost.  The
measured torque in place of tau_L would explain itself.  Reversals identify the sum of this and of
Coulomb friction where they happen to be.  What varies with posture and load along the motion is
left to this column.
"""

from typing import Annotated, NamedTuple

from blf_dsc_controller.arms.friction import sliding
from blf_dsc_controller.compiled.jit import inner, kernel
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.numerics.elementary import cos, sin

BIAS = 0
SINE, COSINE = 1, 2
RIPPLE_SINE, RIPPLE_COSINE = 3, 4
VISCOUS = 5
LOAD_FRICTION = 6
COULOMB = 7

# first and last kind
ALL = BIAS, COULOMB
COMPENSATED = RIPPLE_SINE, LOAD_FRICTION
FRICTION = VISCOUS, COULOMB


class Settings(NamedTuple):
    """The blocks of columns, in the order that they have in theta."""

    first: int  # index of the first column in theta: p
    blocks: int  # their number
    coulomb_velocity: float  # v_c, rad/s
    kinds: Annotated[Array, 'columns.blocks']
    # of sines and cosines: w in rad/s, or N per turn
    rates: Annotated[Array, 'columns.blocks']


class Point(NamedTuple):
    """Where and when the entries of one joint are evaluated."""

    t: float  # s
    q: float  # rad
    dq: float  # rad/s
    sign: float  # s(dq)
    load: float  # tau_L, N m


@inner
def entry(kind: int, rate: float, at: Point) -> float:
    """Return the entry a_k of a joint in its column of a block, by the `kind` of the block.

    `rate` is w [rad/s] of a sine or cosine over time, N [1/turn] of one over position.
    """
    if kind == BIAS:
        return 1.0
    if kind == VISCOUS:
        return at.dq
    if kind == LOAD_FRICTION:
        return abs(at.load) * at.sign
    if kind == COULOMB:
        return at.sign
    angle = rate * (at.t if kind <= COSINE else at.q)
    return sin(angle) if kind in (SINE, RIPPLE_SINE) else cos(angle)


@inner
def fill(
    settings: Settings, kinds: tuple[int, int], i: int, at: Point, H: Array
) -> None:
    """Fill row i of the blocks of some kinds in a regressor H (n, m).

    `kinds` are the first and the last kind, `at` is where the joint is.
    """
    n = H.shape[0]
    for k in range(settings.blocks):
        kind = int(settings.kinds[k])
        if kinds[0] <= kind <= kinds[1]:
            begin = settings.first + k * n
            for j in range(begin, begin + n):
                H[i, j] = 0.0
            H[i, begin + i] = entry(kind, settings.rates[k], at)


@kernel
def fill_motion(
    settings: Settings, t: Array, q: Array, dq: Array, load: Array, rows: Array
) -> None:
    """Fill D of rows [H | D] (k, n, m) at times t (k,) of a motion q, dq (k, n).

    `load` (k, n) is tau_L [N m].
    """
    for k in range(t.size):
        for i in range(q.shape[1]):
            sign = sliding(dq[k, i], settings.coulomb_velocity)
            at = Point(t[k], q[k, i], dq[k, i], sign, load[k, i])
            fill(settings, ALL, i, at, rows[k])


@inner
def torque_of(
    settings: Settings,
    kinds: tuple[int, int],
    i: int,
    at: Point,
    estimate: Array,
    n: int,
) -> float:
    """Return the torque of joint i by its columns of some kinds, sum_k d_k a_k [N m].

    `kinds` are the first and the last kind, `estimate` is theta (m,), n the number of joints.
    """
    torque = 0.0
    for k in range(settings.blocks):
        kind = int(settings.kinds[k])
        if kinds[0] <= kind <= kinds[1]:
            learned = estimate[settings.first + k * n + i]
            torque += learned * entry(kind, settings.rates[k], at)
    return torque


def first_column(settings: Settings, kind: int, n: int) -> int:
    """Return the index in theta of the first column of a kind; m if there is none."""
    kinds = settings.kinds.tolist()
    blocks = kinds.index(kind) if kind in kinds else len(kinds)
    return settings.first + n * blocks
