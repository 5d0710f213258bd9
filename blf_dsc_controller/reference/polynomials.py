# SPDX-License-Identifier: Apache-2.0
"""Splines through given points, with given derivatives there or of minimum jerk.

The quintic with given position, velocity and acceleration at both ends minimises the integrated
squared jerk between them (Flash and Hogan, 1985).  Through several points, the optimum is the
spline of such pieces whose jerk and snap are also continuous.
"""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.reference.terms import Term, spline_term


def quintics(h: np.ndarray, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return coefficients (pieces, n, 6) of quintics of durations h (pieces,) [s].

    `begin` and `end` are the positions, velocities and accelerations (3, pieces, n) at the ends.
    """
    h = np.asarray(h, dtype=np.float64)[:, np.newaxis]
    p, v, a = begin
    dp = end[0] - p - v * h - 0.5 * a * h**2
    dv = (end[1] - v - a * h) * h
    da = 0.5 * (end[2] - a) * h**2
    c3 = (10.0 * dp - 4.0 * dv + da) / h**3
    c4 = (-15.0 * dp + 7.0 * dv - 2.0 * da) / h**4
    c5 = (6.0 * dp - 3.0 * dv + da) / h**5
    return np.stack((p, v, 0.5 * a, c3, c4, c5), axis=-1)


def cubics(h: np.ndarray, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return coefficients (pieces, n, 6) of cubics of durations h (pieces,) [s].

    `begin` and `end` are the positions and velocities (2, pieces, n) at the ends.
    """
    h = np.asarray(h, dtype=np.float64)[:, np.newaxis]
    mean = (end[0] - begin[0]) / h
    c2 = (3.0 * mean - 2.0 * begin[1] - end[1]) / h
    c3 = (begin[1] + end[1] - 2.0 * mean) / h**2
    zero = np.zeros_like(mean)
    return np.stack((begin[0], begin[1], c2, c3, zero, zero), axis=-1)


def at_rest(position: np.ndarray) -> np.ndarray:
    """Return coefficients (1, n, 6) of the piece that stays at `position` (n,) [rad]."""
    coefficients = np.zeros((1, len(position), 6))
    coefficients[0, :, 0] = position
    return coefficients


def ending_at_rest(knots: np.ndarray, coefficients: np.ndarray, position: np.ndarray) -> Term:
    """Return the spline of pieces between knots (k,) [s] that then stays at `position` (n,)."""
    return spline_term(knots, np.concatenate((coefficients, at_rest(position))))


def hermite(times: np.ndarray, points: np.ndarray) -> Term:
    """Return quintics through positions, velocities, accelerations (3, k, n) at times (k,) [s]."""
    pieces = quintics(np.diff(times), points[:, :-1], points[:, 1:])
    return ending_at_rest(times, pieces, points[0, -1])


def minimum_jerk(times: np.ndarray, positions: np.ndarray, begin: np.ndarray | None = None) -> Term:
    """Return the minimum jerk through positions (k, n) [rad] at times (k,) [s], ending at rest.

    Times increase. `begin` is velocity and acceleration (2, n) at the first point, zero by default.
    """
    k, n = positions.shape
    points = np.zeros((3, k, n))
    points[0] = positions
    if begin is not None:
        points[1:, 0] = begin
    if k > 2:
        _solve_inner_points(np.diff(times), points)
    return hermite(times, points)


def _solve_inner_points(h: np.ndarray, points: np.ndarray) -> None:
    """Fill in the velocities and accelerations that make jerk and snap continuous.

    This is a block tridiagonal system with two equations per inner point, solved by elimination.
    """
    rise = np.diff(points[0], axis=0)
    inner = range(1, len(h))
    upper, right = [np.zeros((2, 2))], [points[1:, 0]]
    for k in inner:
        l, r = h[k - 1], h[k]
        before = np.array([[-24.0 / l**2, -3.0 / l], [-168.0 / l**3, -24.0 / l**2]])
        after = np.array([[24.0 / r**2, -3.0 / r], [-168.0 / r**3, 24.0 / r**2]])
        here = np.array(
            [
                [-36.0 / l**2 + 36.0 / r**2, 9.0 / l + 9.0 / r],
                [-192.0 / l**3 - 192.0 / r**3, 36.0 / l**2 - 36.0 / r**2],
            ]
        )
        jerk = 60.0 * (rise[k] / r**3 - rise[k - 1] / l**3)
        snap = -360.0 * (rise[k] / r**4 + rise[k - 1] / l**4)
        here = here - before @ upper[-1]
        upper.append(np.linalg.solve(here, after))
        right.append(np.linalg.solve(here, np.stack((jerk, snap)) - before @ right[-1]))
    for k in reversed(inner):
        points[1:, k] = right[k] - upper[k] @ points[1:, k + 1]
