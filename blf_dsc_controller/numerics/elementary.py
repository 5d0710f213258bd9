# SPDX-License-Identifier: Apache-2.0
"""Sine, cosine, exponential and tanh in IEEE additions, multiplications and divisions alone.

Those of the C library depend on its release and on the processor, for which it chooses
among several versions: they differ in the last digit, and so would every number after
it.  These give the same bits everywhere, compiled or not, within 0.9 units of the last
place.

Each reduces its argument to a small remainder by a constant in parts (Cody and Waite,
Software Manual for the Elementary Functions, 1980): the products of a whole number with
all parts but the last are exact.  On the remainder it evaluates a polynomial of least
largest relative error, below 2^-57, and adds its leading terms last, with what their
rounding lost.
"""

from math import copysign, inf, isnan, ldexp, nan
from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic, overload

from blf_dsc_controller.compiled.jit import INLINED, inner

_WHOLE = 1.5 * 2.0**52  # added and subtracted, it rounds to the nearest integer

_PER_TURN = 0.6366197723675814  # 2 / pi
# pi / 2 in parts of 33, 33, 33 and 53 bits
_RIGHT_1 = float.fromhex('0x1.921fb544p+0')
_RIGHT_2 = float.fromhex('0x1.0b4611a6p-34')
_RIGHT_3 = float.fromhex('0x1.3198a2e0p-69')
_RIGHT_4 = float.fromhex('0x1.b839a252049c1p-104')
_FARTHEST = 2.0**50  # rad, where floats are 0.25 rad apart

_PER_DOUBLING = 1.4426950408889634  # 1 / log 2
# log 2 in parts of 42 and 53 bits
_LOG_1 = float.fromhex('0x1.62e42fefa38p-1')
_LOG_2 = float.fromhex('0x1.ef35793c7673p-45')
_LEAST_EXPONENT = -708.0
_LARGEST_EXPONENT = 709.782712893384  # log of the largest float


@inner
def sine_and_cosine(x: float) -> tuple[float, float]:
    """Return sin x and cos x.

    Above 1.6e6 rad, they are those of an angle within a unit of the last place of x,
    and above 2^50 rad those of 0, which is as good: x has no digit left after the
    point.
    """
    if not abs(x) < _FARTHEST:
        return (0.0, 1.0) if abs(x) < inf else (nan, nan)
    turns = (x * _PER_TURN + _WHOLE) - _WHOLE  # right angles
    rest = x - turns * _RIGHT_1
    part = turns * _RIGHT_2
    a = rest - part
    lost = (rest - a) - part
    part = turns * _RIGHT_3
    r = a - part
    lost += ((a - r) - part) - turns * _RIGHT_4  # the remainder is r + lost
    z = r * r
    w = z * z
    s = -0.16666666666666630 + z * 0.008333333333322118
    s += w * (-1.9841269829589704e-4 + z * 2.7557313621429417e-6)
    s += w * w * (-2.5050747768189882e-8 + z * 1.5896230401812324e-10)
    c = 0.04166666666666660 + z * -0.0013888888888874138
    c += w * (2.4801587289491905e-5 + z * -2.7557314355264246e-7)
    c += w * w * (2.0875723687413286e-9 + z * -1.1359670015897748e-11)
    half = 0.5 * z
    most = 1.0 - half
    s = r + (r * z * s + lost * most)
    c = most + (((1.0 - most) - half) + (w * c - r * lost))
    quadrant = int(turns)
    if quadrant & 1:
        s, c = c, -s
    if quadrant & 2:
        s, c = -s, -c
    return s, c


@inner
def sin(x: float) -> float:
    """Return sin x, see `sine_and_cosine`."""
    return sine_and_cosine(x)[0]


@inner
def cos(x: float) -> float:
    """Return cos x, see `sine_and_cosine`."""
    return sine_and_cosine(x)[1]


@inner
def scaled_exponential(x: float) -> tuple[float, float, int]:
    """Return a, b and k of exp(x) = (a + b) 2^k, where b is what the rounding of a lost."""
    doublings = (x * _PER_DOUBLING + _WHOLE) - _WHOLE
    rest = x - doublings * _LOG_1
    part = doublings * _LOG_2
    r = rest - part
    lost = (rest - r) - part
    z = r * r
    w = z * z
    p = 0.5000000000000012 + r * 0.16666666666666700
    p += z * (0.041666666666515535 + r * 0.008333333333307238)
    q = 0.0013888888946982899 + r * 1.9841269917313583e-4
    q += z * (2.4801489979361804e-5 + r * 2.7557216360099614e-6)
    q += w * (2.7631266142691230e-7 + r * 2.5117843362238444e-8)
    most = 1.0 + r
    rest = ((1.0 - most) + r) + (z * (p + w * q) + lost)
    a = most + rest
    return a, (most - a) + rest, int(doublings)


@inner
def exp(x: float) -> float:
    """Return exp x, which is 0 below x = -708 and infinite where it exceeds the largest float."""
    if x < _LEAST_EXPONENT:
        return 0.0
    if x > _LARGEST_EXPONENT:
        return inf
    if isnan(x):
        return x
    a, _, k = scaled_exponential(x)
    return a * 2.0 * power_of_two(k - 1)


@inner
def tanh(x: float) -> float:
    """Return tanh x = 1 - 2 / (exp 2x + 1), near zero by a quotient of polynomials."""
    size = abs(x)
    if size < 0.55:
        z = x * x
        above = 1.0 / 3.0 + z * (0.020500386365353156 + z * 0.00019924838273231179)
        below = 0.4615011590960552 + z * (
            0.023293446881950782 + z * 0.00020660907807196698
        )
        return x - x * z * (above / (1.0 + z * below))
    if size > 20.0:
        return copysign(1.0, x)
    if isnan(x):
        return x
    a, b, k = scaled_exponential(2.0 * size)
    scale = power_of_two(k)
    whole = a * scale + 1.0
    lost = (a * scale - whole) + 1.0 + b * scale
    q = 2.0 / whole
    most = 1.0 - q
    return copysign(most + (((1.0 - most) - q) + 0.5 * q * q * lost), x)


def power_of_two(k: int) -> float:
    """Return 2^k for -1022 <= k <= 1023."""
    return ldexp(1.0, k)


@intrinsic
def _power_of_two(_typing: Any, k: Any) -> Any:
    def generate(
        _context: Any, builder: ir.IRBuilder, _signature: Any, args: Any
    ) -> ir.Value:
        exponent = builder.shl(
            builder.add(args[0], args[0].type(1023)), args[0].type(52)
        )
        return builder.bitcast(exponent, ir.DoubleType())

    return types.float64(k), generate


@overload(power_of_two, strict=False, jit_options=INLINED)
def _compiled_power_of_two(k: Any) -> Any:  # noqa: ARG001 - numba looks at the names
    return lambda k: _power_of_two(k)  # noqa: PLW0108
