# SPDX-License-Identifier: Apache-2.0
"""The barrier (3), whose bound is constant or a funnel.

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
from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.numerics.elementary import cos, exp, sin

_BISECTIONS = 60


class Settings(NamedTuple):
    """The parameters `barrier.*`, and what follows from them."""

    bound: Annotated[Array, 'n']  # k_c, rad
    initial_bound: Annotated[Array, 'n']  # k_0, rad; k_c: constant bound
    funnel_rate: float  # a, rate at which the bound narrows, 1/s
    weight: Annotated[Array, 'n']  # w, N m/rad
    slope_limit: Annotated[Array, 'n']  # S_lim, N m/rad
    # error at which the slope reaches S_lim if the bound is k_c, rad
    knee: Annotated[Array, 'n']


class Workspace(NamedTuple):
    """Values of one sample."""

    knee: Annotated[Array, 'n']  # knee of the barrier for k(t), rad
    narrowing: Annotated[Array, 'n']  # k'/k, 1/s


@inner
def angle(xi: float, bound: float) -> float:
    """Return s = pi xi^2 / (2 k^2) [rad] of an error xi [rad] and its bound k [rad]."""
    ratio = xi / bound
    return 0.5 * pi * (ratio * ratio)


@inner
def slope(xi: float, bound: float, weight: float) -> float:
    """Return d^2V/dxi^2 = w (1 + 4 s tan s) / cos^2 s [N m/rad], the stiffness of the barrier.

    The error |xi| [rad] is below its bound [rad]; `weight` is w [N m/rad].
    """
    s = angle(xi, bound)
    c = cos(s)
    return weight * (1.0 + 4.0 * s * sin(s) / c) / (c * c)


@inner
def knee(bound: float, weight: float, slope_limit: float) -> float:
    """Return the error [rad] at which the stiffness reaches `slope_limit` [N m/rad] (>= weight).

    The barrier is that of a bound [rad] and a weight w [N m/rad].  Found by bisection, since
    `slope` grows with the error.
    """
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
    """Return dV/dxi [N m] at an error xi [rad]; its negative is tau_c of (16), (28).

    Up to the `knee` [rad] it is w xi / cos^2 s; beyond, a straight line of the slope `slope_limit`
    [N m/rad].  `bound` is k(t) [rad], `weight` is w [N m/rad].
    """
    edge = min(abs(xi), knee)
    c = cos(angle(edge, bound))
    torque = weight * edge / (c * c) + slope_limit * (abs(xi) - edge)
    return torque if xi >= 0.0 else -torque


@inner
def potential(
    xi: float, bound: float, weight: float, slope_limit: float, knee: float
) -> float:
    """Return V [J] of (3) at an error xi [rad]: w (k^2 / pi) tan s up to the `knee` [rad].

    Beyond, it is the parabola whose slope is `gradient`, with the same arguments.
    """
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
def update_bound(
    settings: Settings, workspace: Workspace, t: float, bound: Array
) -> None:
    """Write k(t) (n,) [rad] at time t [s] to `bound`, and its knee and k'/k to `workspace`."""
    for i in range(settings.bound.size):
        final = settings.bound[i]
        above = (settings.initial_bound[i] - final) * exp(-settings.funnel_rate * t)
        bound[i] = final + above
        workspace.knee[i] = settings.knee[i] * (bound[i] / final)
        workspace.narrowing[i] = -settings.funnel_rate * above / bound[i]


def bound_at(settings: Settings, t: float) -> Array:
    """Return k(t) (n,) [rad] at time t [s] since the start, as `update_bound` computes it."""
    above = (settings.initial_bound - settings.bound) * exp(-settings.funnel_rate * t)
    bound: Array = settings.bound + above
    return bound


@inner
def joint_potential(
    settings: Settings, workspace: Workspace, xi: float, bound: float, i: int
) -> float:
    """Return V [J] of (3) of joint i with an error xi [rad] and its bound k(t) [rad]."""
    weight, limit = settings.weight[i], settings.slope_limit[i]
    return potential(xi, bound, weight, limit, workspace.knee[i])
