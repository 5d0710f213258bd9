# SPDX-License-Identifier: Apache-2.0
"""Projection (4) of the parameter update onto a ball, in the metric of the adaptation gain.

(4) as printed acts where |P^| equals the radius, which a sampled update never does: it steps over
and never returns.  Here the outward part is removed on and beyond the sphere, in the metric that
the Lyapunov function (29) measures P~ with, and the step ends inside the ball.
"""

from math import sqrt

import numpy as np

from blf_dsc_controller.core.kernel import inner

_ON_SPHERE = 1.0 - 1e-12  # of radius^2: `rescale` ends a rounding inside or outside


@inner
def project(estimate: np.ndarray, rate: np.ndarray, gain: np.ndarray, radius: float) -> None:
    """Remove from `rate` (p,) what leads out of the ball:  v - Gamma w w^T v / (w^T Gamma w).

    Args:
        estimate: P^ (p,), the direction w.
        rate: wanted rate v of P^ (p,), changed in place.
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
def rescale(estimate: np.ndarray, size: int, radius: float) -> None:
    """Bring the first `size` entries of `estimate` back onto the ball, if a step has left it."""
    square = 0.0
    for j in range(size):
        square += estimate[j] * estimate[j]
    if square > radius * radius:
        shrink = radius / sqrt(square)
        for j in range(size):
            estimate[j] *= shrink
