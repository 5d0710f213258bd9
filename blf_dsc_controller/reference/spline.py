# SPDX-License-Identifier: Apache-2.0
"""Piecewise quintic polynomials of time: minimum jerk, trajectories, and rest.

Piece k holds from knot k to knot k + 1, the last one for ever:

    qr_i = sum_j c_kij (t - knot_k)^j,   j = 0 .. 5

Before the first knot the spline stands where it begins.  A spline that ends is one whose last piece
is a constant.
"""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.views import part


def spline_content(knots: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """Pack a spline for `spline`.

    Args:
        knots: start of each piece (pieces,) [s], increasing.
        coefficients: (pieces, n, 6), c_kij [rad/s^j].
    """
    return np.concatenate(([float(len(knots))], knots, np.ravel(coefficients)))


@inner
def piece_at(knots: np.ndarray, t: float) -> int:
    """Last piece that has begun at time t; the first before the first knot."""
    low = 0
    high = knots.size
    while high - low > 1:
        middle = (low + high) // 2
        if knots[middle] <= t:
            low = middle
        else:
            high = middle
    return low


@inner
def spline(vector: np.ndarray, at: int, n: int, i: int, t: float) -> tuple[float, float, float]:
    """Joint i of n at time t [s] of the spline that is packed from entry `at` on: q, q', q''."""
    pieces = int(vector[at])
    knots = part(vector, at + 1, (pieces,))
    if t < knots[0]:
        return vector[at + 1 + pieces + 6 * i], 0.0, 0.0
    k = piece_at(knots, t)
    x = t - knots[k]
    c = part(vector, at + 1 + pieces + 6 * (k * n + i), (6,))
    position = c[5]
    velocity = 0.0
    curvature = 0.0
    for j in range(4, -1, -1):
        curvature = curvature * x + velocity
        velocity = velocity * x + position
        position = position * x + c[j]
    return position, velocity, 2.0 * curvature
