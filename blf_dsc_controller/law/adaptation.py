# SPDX-License-Identifier: Apache-2.0
"""Composite learning: the update law (20) with the latched prediction error (26).

    eps = b_e - Phi_e theta^                                theta^ = [P^; d^], the current estimate
    theta^' = Proj( -Gamma (H^T xi2 - kappa W eps) )                    W = (Phi_e + rho R)^-1

As printed, (20) has + kappa eps, which drives P^ to the projection ball as soon as
learning starts.  H^T xi2 acts on P^ alone.  With the Newton W every excited direction
converges at the rate Gamma kappa; with the paper's W = I the rates vary with the
eigenvalues of Phi_e.

The update stays in a ball, in the metric of the adaptation gain.  As printed, (4) acts
where |P^| equals the radius, which a sampled update never hits: it steps over and never
returns.  Here the outward part is removed on and beyond the sphere, in the metric that
the Lyapunov function (29) uses for P~, and a step that leaves the ball ends at the
nearest point of the ball in that metric, which is never farther from a true P inside.
"""

from math import isfinite, sqrt
from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.compiled.views import part
from blf_dsc_controller.law import excitation
from blf_dsc_controller.law.clipping import clip
from blf_dsc_controller.numerics.algebra import cholesky_solve

_ON_SPHERE = 1.0 - 1e-12  # of radius^2: `retract` ends within rounding of the sphere
_LENGTH_ROUNDED = 1.0 + 1e-14
# of Newton's method; 12 for Gamma spanning eight decades, ten radii outside
_MAX_STEPS = 20


class Settings(NamedTuple):
    """The parameters `learning.*` of the update, and the prior and range of theta."""

    weight: float  # kappa, of the prediction error
    radius: float  # omega_a of (4)
    adaptation_gain: Annotated[Array, 'm']  # diagonal of Gamma
    variance: Annotated[Array, 'm']  # diagonal of R^-1, of the prior
    lower: Annotated[Array, 'm']  # value that theta^ can have: friction is not negative
    upper: Annotated[Array, 'm']  # value that theta^ can have


class Workspace(NamedTuple):
    """Values of one sample that the update computes."""

    rate: Annotated[Array, 'm']  # eps or W eps, then theta^' [1/s]
    tracked: Annotated[Array, 'm']  # theta^ after the tracking error alone


@inner
def project(estimate: Array, rate: Array, gain: Array, radius: float) -> None:
    """Remove the outward part of a rate v (p,), as (4) does, in the metric of Gamma.

        v - Gamma w w^T v / (w^T Gamma w)

    It is removed on and outside the sphere |w| = omega_a, if v points outwards.

    Args:
        estimate: P^ (p,), which is w.
        rate: v = P^' (p,) [1/s times the units of P], modified in place.
        gain: diagonal of Gamma (p,).
        radius: omega_a.
    """
    square = 0.0
    outward = 0.0
    metric = 0.0
    for j in range(gain.size):
        square += estimate[j] * estimate[j]
        outward += estimate[j] * rate[j]
        metric += estimate[j] * gain[j] * estimate[j]
    if square >= _ON_SPHERE * radius * radius and outward > 0.0 and metric > 0.0:
        for j in range(gain.size):
            rate[j] -= gain[j] * estimate[j] * outward / metric


@inner
def retract(estimate: Array, gain: Array, radius: float) -> None:
    """Replace a P^ (p,) outside the ball by the nearest point in it, in the metric of Gamma.

    That point is P^_j / (1 + nu Gamma_j) with the nu > 0 that gives it the length omega_a.
    Newton's method on 1 / length finds nu: exact after one step for equal gains, monotone
    otherwise.

    Args:
        estimate: P^ (p,), modified in place; unchanged inside the ball, or if not finite.
        gain: diagonal of Gamma (p,).
        radius: omega_a.
    """
    square = 0.0
    for j in range(gain.size):
        square += estimate[j] * estimate[j]
    if not (square > radius * radius and isfinite(square)):
        return
    nu = 0.0
    length = radius
    for _ in range(_MAX_STEPS):
        # of the length of P^_j / (1 + nu Gamma_j): minus half the slope
        square, slope = 0.0, 0.0
        for j in range(gain.size):
            shrink = 1.0 + nu * gain[j]
            entry = estimate[j] / shrink
            square += entry * entry
            slope += gain[j] * entry * entry / shrink
        length = sqrt(square)
        if not (length > _LENGTH_ROUNDED * radius and slope > 0.0):
            break
        nu += (length / radius - 1.0) * length * length / slope
    rounding = min(1.0, radius / length)
    for j in range(gain.size):
        estimate[j] *= rounding / (1.0 + nu * gain[j])


@inner
def fill_prediction_error(
    workspace: Workspace, latch: excitation.State, estimate: Array
) -> None:
    """Write eps = b_e - Phi_e theta^ (m,) of (26) to `workspace.rate`.

    It is zero while no window is latched.  `estimate` is theta^ (m,).
    """
    m = estimate.size
    for i in range(m):
        workspace.rate[i] = 0.0
    if latch.latched[0] == 0.0:
        return
    for i in range(m):
        workspace.rate[i] = latch.b[i]
        for j in range(m):
            workspace.rate[i] -= latch.Phi[i, j] * estimate[j]


@inner
def fill_newton_step(
    workspace: Workspace, latch: excitation.State, estimate: Array
) -> None:
    """Write the Newton step W eps (m,), W = (Phi_e + rho R)^-1, to `workspace.rate`.

    It is zero while no window is latched.  `estimate` is theta^ (m,).
    """
    fill_prediction_error(workspace, latch, estimate)
    if latch.latched[0] == 1.0:
        cholesky_solve(latch.factor, workspace.rate)


@inner
def adapt(
    settings: Settings,
    workspace: Workspace,
    estimate: Array,
    H: Array,
    xi2: Array,
    p: int,
    tracks: bool,
    dt: float,
) -> None:
    """Advance theta^ by `dt` [s], by the update law (20) and its projection.

    `workspace.rate` has eps or W eps (m,), and afterwards theta^'.  `workspace.tracked` is left
    with theta^ as the tracking error alone would have advanced it.

    Args:
        estimate: theta^ (m,), modified in place and kept in its range [lower, upper].
        H: regressor (n, m) of what is learned.
        xi2: velocity error (n,) [rad/s].
        p: number of parameters P, which alone H^T xi2 adapts.
        tracks: whether the tracking error adapts at all.
    """
    gain = settings.adaptation_gain
    # all rates before any estimate: the projection takes them together
    for j in range(estimate.size):
        tracking = 0.0
        if j < p and tracks:
            for i in range(xi2.size):
                tracking += H[i, j] * xi2[i]
            tracking = settings.variance[j] * tracking
        workspace.tracked[j] = estimate[j] - dt * gain[j] * tracking
        workspace.rate[j] = gain[j] * (settings.weight * workspace.rate[j] - tracking)
    parameters = part(estimate, 0, (p,))
    parameter_gain = part(gain, 0, (p,))
    project(parameters, part(workspace.rate, 0, (p,)), parameter_gain, settings.radius)
    for j in range(estimate.size):
        moved = estimate[j] + dt * workspace.rate[j]
        estimate[j] = clip(moved, settings.lower[j], settings.upper[j])
    retract(parameters, parameter_gain, settings.radius)
