# SPDX-License-Identifier: Apache-2.0
"""The dynamic surface: virtual control (18) with (15), and the filter (13) that follows it."""

from math import exp, pi, sin

from blf_dsc_controller.compiled.jit import inner


@inner
def sinc(x: float) -> float:
    """sin(x) / x, by its series where the quotient would lose its digits."""
    if abs(x) < 1e-4:
        return 1.0 - x * x / 6.0
    return sin(x) / x


@inner
def virtual_control(
    xi1: float, bound: float, barrier_gain: float, linear_gain: float, reference_velocity: float
) -> float:
    """beta2 = -(K/2) xi1 sinc(pi xi1^2 / k_c^2) - mu xi1 + dqr   [rad/s], (15) and (18).

    (15) is printed as a quotient that is 0/0 at xi1 = 0; sin s cos s = sin(2 s)/2 turns it into a
    sinc.  Its barrier part falls to zero AT the bound, where mu alone carries it, and would change
    sign beyond: it is left at zero there.
    """
    ratio = xi1 / bound
    barrier_part = 0.0
    if abs(ratio) < 1.0:
        barrier_part = 0.5 * barrier_gain * xi1 * sinc(pi * ratio * ratio)
    return reference_velocity - barrier_part - linear_gain * xi1


@inner
def filter_gain(time_constant: float, dt: float) -> float:
    """Share of the way to its held input that a first-order lag goes in `dt` [s], exactly."""
    return 1.0 - exp(-dt / time_constant)
