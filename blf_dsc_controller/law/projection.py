# SPDX-License-Identifier: Apache-2.0
"""Projection (4) of the parameter update onto a ball, in the metric of the adaptation gain.

As printed, (4) acts where |P^| equals the radius, which a sampled update never hits: it steps over
and never returns.  Here the outward part is removed on and beyond the sphere, in the metric that
the Lyapunov function (29) uses for P~, and a step that leaves the ball ends at the nearest point of
the ball in that metric, which is never farther from a true P inside.
"""

from math import isfinite, sqrt

import numpy as np

from blf_dsc_controller.compiled.jit import inner

_ON_SPHERE = 1.0 - 1e-12  # of radius^2: `retract` ends within rounding of the sphere
_ROUNDED = 1.0 + 1e-14
_MOST_STEPS = 20  # of Newton's method; 12 for Gamma spanning eight decades, ten radii outside


@inner
def project(estimate: np.ndarray, rate: np.ndarray, gain: np.ndarray, radius: float) -> None:
    """Remove the outward part from `rate` v (p,):  v - Gamma w w^T v / (w^T Gamma w).

    `estimate` P^ (p,) is the direction w, `rate` is modified in place, `gain` (p,) is the diagonal
    of Gamma and `radius` omega_a.
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
def retract(estimate: np.ndarray, gain: np.ndarray, radius: float) -> None:
    """Replace a P^ (p,) outside the ball by the nearest point in it, in the metric of Gamma.

    That is P^_j / (1 + nu Gamma_j) with the nu > 0 that gives it the length omega_a, found by
    Newton's method on 1 / length: exact after one step for equal gains, monotone otherwise.
    """
    square = 0.0
    for j in range(gain.size):
        square += estimate[j] * estimate[j]
    if not (square > radius * radius and isfinite(square)):
        return
    nu = 0.0
    length = radius
    for _ in range(_MOST_STEPS):
        length, slope = _shrunk(estimate, gain, nu)
        if not (length > _ROUNDED * radius and slope > 0.0):
            break
        nu += (length / radius - 1.0) * length * length / slope
    rounding = min(1.0, radius / length)
    for j in range(gain.size):
        estimate[j] *= rounding / (1.0 + nu * gain[j])


@inner
def _shrunk(estimate: np.ndarray, gain: np.ndarray, nu: float) -> tuple[float, float]:
    """Return the length of P^_j / (1 + nu Gamma_j) and minus half the slope of its square."""
    square = 0.0
    slope = 0.0
    for j in range(gain.size):
        entry = estimate[j] / (1.0 + nu * gain[j])
        square += entry * entry
        slope += gain[j] * entry * entry / (1.0 + nu * gain[j])
    return sqrt(square), slope
