# SPDX-License-Identifier: Apache-2.0
"""The virtual control (15), (18), and its rate as far as it is known.

    beta2 = -(K/2) xi1 sinc(pi xi1^2 / k_c^2) - mu xi1 + dqr                  [rad/s]
    f = ddqr + (d beta2 / d xi1) (dq - dqr^),    dqr^ = dqr - (lag / 2) ddqr  [rad/s^2]

f is what is known of beta2' before the filter (13): only the changes of a funnel's k'/k
are left out.  Measured velocities come half of `robot.lag` late, so they are compared
with the reference of that time, dqr^, in beta2 as well: on the reference xi2 is then
zero.
"""

from math import pi
from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.numerics.elementary import cos, sin


class Settings(NamedTuple):
    """The parameters `surface.*`, and what follows from others."""

    gain: Annotated[Array, 'n']  # K, 1/s
    mu: Annotated[Array, 'n']  # 1/s
    time_constant: float  # lambda of (13), s
    known_rate: int  # 1: the surface filter follows the known rate of beta2
    lag: float  # of measured velocities and applied torques together, s


class Workspace(NamedTuple):
    """Values of one sample that the law passes on to the filter."""

    beta2: Annotated[Array, 'n']  # virtual control, rad/s
    # its rate as far as it is known before the filter (13); else zero, rad/s^2
    rate: Annotated[Array, 'n']


@inner
def sinc(x: float) -> float:
    """Return sin(x) / x, by its series where the quotient would lose precision."""
    if abs(x) < 1e-4:
        return 1.0 - x * x / 6.0
    return sin(x) / x


@inner
def virtual_control(
    xi1: float,
    bound: float,
    barrier_gain: float,
    linear_gain: float,
    reference_velocity: float,
) -> float:
    """Return beta2 = -(K/2) xi1 sinc(pi xi1^2 / k_c^2) - mu xi1 + dqr   [rad/s], (15) and (18).

    (15) is printed as a quotient that is 0/0 at xi1 = 0; sin s cos s = sin(2 s)/2 turns it into a
    sinc.  Its barrier part falls to zero at the bound, where only mu acts; beyond, it would change
    sign and is set to zero.

    Args:
        xi1: error [rad].
        bound: k(t) [rad].
        barrier_gain: K [1/s].
        linear_gain: mu [1/s].
        reference_velocity: dqr, with xi1 k'/k of a funnel [rad/s].
    """
    ratio = xi1 / bound
    barrier_part = 0.0
    if abs(ratio) < 1.0:
        barrier_part = 0.5 * barrier_gain * xi1 * sinc(pi * ratio * ratio)
    return reference_velocity - barrier_part - linear_gain * xi1


@inner
def virtual_slope(
    xi1: float, bound: float, barrier_gain: float, linear_gain: float
) -> float:
    """Return -d beta2 / d xi1 = (K/2) (2 cos x - sinc x) + mu,  x = pi xi1^2 / k_c^2   [1/s].

    The arguments are those of `virtual_control`.
    """
    ratio = xi1 / bound
    barrier_part = 0.0
    if abs(ratio) < 1.0:
        x = pi * ratio * ratio
        barrier_part = 0.5 * barrier_gain * (2.0 * cos(x) - sinc(x))
    return barrier_part + linear_gain


@inner
def known_rate(
    settings: Settings,
    xi1: float,
    bound: float,
    narrowing: float,
    dq: float,
    dqr: float,
    ddqr: float,
    i: int,
) -> tuple[float, float]:
    """Return f of joint i [rad/s^2], and dqr - dqr^ = (lag / 2) ddqr [rad/s].

    `narrowing` is k'/k [1/s] of the bound.
    """
    lag_offset = 0.5 * settings.lag * ddqr
    slope = virtual_slope(xi1, bound, settings.gain[i], settings.mu[i])
    slope -= narrowing
    rate = dq - dqr + lag_offset
    return ddqr - slope * rate, lag_offset
