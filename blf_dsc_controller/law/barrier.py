# SPDX-License-Identifier: Apache-2.0
"""The tan-type barrier (3), weighted, and continued past a stiffness that a sampled loop can hold.

    V(xi) = w (k_c^2 / pi) tan s,      s = pi xi^2 / (2 k_c^2)                        [J]
    dV/dxi = w xi / cos^2 s                                                            [N m]

The paper's w = 1 N m/rad makes V1 (11) add rad^2 to J; the weight repairs the unit and lets the
barrier act before the last microradian.  dV/dxi has slope w (1 + 4 s tan s) / cos^2 s, unbounded at
the bound, while a torque that is held for a sample can only stabilise a finite stiffness.  Past the
error where the slope reaches `slope_limit` (the knee) the torque goes on as a straight line of that
slope: continuous with its derivative, strong enough to throw the arm back, and defined everywhere.
"""

from math import cos, pi, tan

from blf_dsc_controller.compiled.jit import inner

_BISECTIONS = 60


@inner
def slope(xi: float, bound: float, weight: float) -> float:
    """Stiffness w (1 + 4 s tan s) / cos^2 s   [N m/rad] of the barrier at |xi| < bound [rad]."""
    s = 0.5 * pi * (xi / bound) ** 2
    c = cos(s)
    return weight * (1.0 + 4.0 * s * tan(s)) / (c * c)


@inner
def knee(bound: float, weight: float, slope_limit: float) -> float:
    """Error [rad] at which the stiffness reaches `slope_limit` [N m/rad] (>= weight)."""
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
def gradient(xi: float, bound: float, weight: float, slope_limit: float, knee: float) -> float:
    """dV/dxi [N m]; the barrier torque tau_c of (16), (28) is its negative."""
    edge = min(abs(xi), knee)
    c = cos(0.5 * pi * (edge / bound) ** 2)
    torque = weight * edge / (c * c) + slope_limit * (abs(xi) - edge)
    return torque if xi >= 0.0 else -torque


@inner
def potential(xi: float, bound: float, weight: float, slope_limit: float, knee: float) -> float:
    """V [J]: (3) up to the knee, a parabola past it."""
    edge = min(abs(xi), knee)
    past = abs(xi) - edge
    inside = weight * bound * bound / pi * tan(0.5 * pi * (edge / bound) ** 2)
    return inside + past * (
        gradient(edge, bound, weight, slope_limit, knee) + 0.5 * slope_limit * past
    )
