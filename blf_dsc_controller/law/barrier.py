# SPDX-License-Identifier: Apache-2.0
"""The barrier (3), constant or a funnel, and the virtual control (15), (18).

The weighted tan-type barrier is continued linearly past the stiffness a sampled loop
can hold:

    V(xi) = w (k_c^2 / pi) tan s,      s = pi xi^2 / (2 k_c^2)                        [J]
    dV/dxi = w xi / cos^2 s                                                            [N m]

The paper's w = 1 makes V1 (11) add rad^2 to J; the weight [N m/rad] corrects the unit
and lets the barrier act before the last microradian.  dV/dxi has slope w (1 + 4 s tan
s) / cos^2 s, unbounded at the bound, but a torque held for one sample can only
stabilise a finite stiffness.  Past the error at which the slope reaches `slope_limit`
(the knee), the torque continues as a straight line of that slope: continuous with its
derivative, strong enough to return the arm, and defined everywhere.

The bound is constant, or a funnel that narrows to k_c:

    k(t) = k_c + (k_0 - k_c) exp(-a t)                                                 [rad]

The potential has the form k^2 v(xi / k), including its continuation past the knee, so
that V' = dV/dxi (xi1' - xi1 k'/k) + 2 (k'/k) V.  With xi1 k'/k added to the virtual
control, V' is that of a constant bound plus 2 (k'/k) V, which is not positive while the
bound narrows (doc/stability.md, 'A bound that narrows').
"""

from math import pi

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.law.state import Settings, Signals
from blf_dsc_controller.numerics.elementary import cos, exp, sin

_BISECTIONS = 60


@inner
def angle(xi: float, bound: float) -> float:
    """Return s = pi xi^2 / (2 k_c^2) [rad] of the error [rad] and its bound [rad]."""
    ratio = xi / bound
    return 0.5 * pi * (ratio * ratio)


@inner
def slope(xi: float, bound: float, weight: float) -> float:
    """Return the stiffness w (1 + 4 s tan s) / cos^2 s [N m/rad] at |xi| < bound [rad]."""
    s = angle(xi, bound)
    c = cos(s)
    return weight * (1.0 + 4.0 * s * sin(s) / c) / (c * c)


@inner
def knee(bound: float, weight: float, slope_limit: float) -> float:
    """Return the error [rad] at which the stiffness reaches `slope_limit` [N m/rad] (>= weight)."""
    low = 0.0
    high = bound
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        if slope(middle, bound, weight) < slope_limit:
            low = middle
        else:
            high = middle
    return low


@inner
def gradient(
    xi: float, bound: float, weight: float, slope_limit: float, knee: float
) -> float:
    """Return dV/dxi [N m]; its negative is the barrier torque tau_c of (16), (28)."""
    edge = min(abs(xi), knee)
    c = cos(angle(edge, bound))
    torque = weight * edge / (c * c) + slope_limit * (abs(xi) - edge)
    return torque if xi >= 0.0 else -torque


@inner
def potential(
    xi: float, bound: float, weight: float, slope_limit: float, knee: float
) -> float:
    """Return V [J]: (3) up to the knee, a parabola past it."""
    edge = min(abs(xi), knee)
    past = abs(xi) - edge
    s = angle(edge, bound)
    inside = weight * bound * bound / pi * (sin(s) / cos(s))
    if past == 0.0:
        return inside
    return inside + past * (
        gradient(edge, bound, weight, slope_limit, knee) + 0.5 * slope_limit * past
    )


@inner
def update_bound(settings: Settings, signals: Signals, t: float) -> None:
    """Compute k(t), the knee of its barrier and k'/k [1/s] at time t [s]."""
    for i in range(settings.n):
        final = settings.bound[i]
        above = (settings.initial_bound[i] - final) * exp(-settings.funnel_rate * t)
        signals.bound[i] = final + above
        signals.knee[i] = settings.knee[i] * (signals.bound[i] / final)
        signals.narrowing[i] = -settings.funnel_rate * above / signals.bound[i]


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

    (15) is printed as a quotient that is 0/0 at xi1 = 0; sin s cos s = sin(2 s)/2 turns
    it into a sinc.  Its barrier part falls to zero at the bound, where only mu acts;
    beyond, it would change sign and is set to zero.
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
    """Return -d beta2 / d xi1 = (K/2) (2 cos x - sinc x) + mu,  x = pi xi1^2 / k_c^2   [1/s]."""
    ratio = xi1 / bound
    barrier_part = 0.0
    if abs(ratio) < 1.0:
        x = pi * ratio * ratio
        barrier_part = 0.5 * barrier_gain * (2.0 * cos(x) - sinc(x))
    return barrier_part + linear_gain
