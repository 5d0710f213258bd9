# SPDX-License-Identifier: Apache-2.0
"""The weighted least-squares problem of a recording, with its folds and its covariance.

Each joint is weighted by the inverse deviation of its own residual, the delay of the torques is
linearised about its last estimate, and the load friction computed with the last estimate of
gravity: a few passes until they agree.

The covariance allows for residuals that are correlated,

    H^-1 (I + sum_i l_i A_i^T A_i) H^-1,       H = I + sum_i A_i^T A_i,

with the correlation lengths l_i of the joints (Liang and Zeger, Longitudinal data analysis using
generalized linear models, 1986), and ignores the bounds, which can only reduce it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blf_dsc_controller.identification.physical import solve
from blf_dsc_controller.identification.prior import Prior
from blf_dsc_controller.identification.windows import HOP, Indices, Rows
from blf_dsc_controller.run import Floats

FOLDS = 5
"""Parts of the recording for cross-validation."""

_PASSES = 6
_DEVIATION = 0.1  # of a joint's torque, of its residual at first
_FLOOR = 1e-3  # of that, least deviation


class Regression(NamedTuple):
    """The problem |A z - b|^2 + |z|^2 of k unknowns z, normalised by deviations of the joints."""

    A: Floats  # (., k)
    b: Floats  # (.,)
    # (parts, n, k + 1, k + 1) [A | b]^T [A | b] of successive windows, for each joint
    folds: Floats
    scatter: Floats  # (k, k) covariance of A^T b
    lasting: Floats  # (n,) correlation length of each joint's residual, s
    deviation: Floats  # (n,) of each joint's residual, N m or N


def regression(
    rows: Rows, fit: Indices, G: Floats, prior: Prior, parts: int = FOLDS
) -> Regression:
    """Return the problem of the prior's z, with deviations and gravity of its own solution."""
    n = rows.speed.size
    mean = G @ prior.mean
    B = G @ prior.D
    theta = mean
    deviation = _DEVIATION * np.sqrt(np.mean(rows.u(0.0)[fit] ** 2, axis=0))
    floor = _FLOOR * deviation + 1e-12
    counted = np.sum(rows.weight[fit] ** 2, axis=0) - theta.size / n
    counted = np.maximum(counted, 1.0)
    for _ in range(_PASSES):
        rows.set_load(theta[: rows.p])
        weighted = _weighted(rows, fit, float(theta[-1]))
        scaled = weighted / deviation[:, None]
        R = np.asarray(np.linalg.qr(scaled.reshape(-1, theta.size + 1), mode='r'))
        A = R[:, :-1] @ B
        b = R[:, -1] - R[:, :-1] @ mean
        theta = mean + B @ np.linalg.solve(A.T @ A + np.eye(A.shape[1]), A.T @ b)
        residual = weighted[:, :, :-1] @ theta - weighted[:, :, -1]
        found = np.sqrt(np.sum(residual**2, axis=0) / counted)
        deviation_used = deviation
        deviation = np.maximum(found, floor)
    lengths = np.array([correlation_length(column) for column in residual.T])
    folds = _folds(scaled, B, mean, parts)
    of_joints = folds.sum(axis=0)[:, :-1, :-1]
    scatter = np.tensordot(lengths, of_joints, 1)
    return Regression(A, b, folds, scatter, lengths * HOP, deviation_used)


def _weighted(rows: Rows, fit: Indices, delay: float) -> Floats:
    """Return [X | -du/dt | u] (R, n, m + 2), the last of torques without their delay."""
    rate = rows.rate(delay)[fit][:, :, None]
    u = rows.u(delay)[fit][:, :, None]
    columns = (rows.X[fit], -rate, u - delay * rate)
    weight = rows.weight[fit][:, :, None]
    return np.asarray(weight * np.concatenate(columns, axis=2))


def _folds(scaled: Floats, B: Floats, mean: Floats, parts: int) -> Floats:
    """Return the products (parts, n, k + 1, k + 1) of the columns [A | b]."""
    n = scaled.shape[1]
    k = B.shape[1] + 1
    to_z = np.zeros((scaled.shape[2], k))
    to_z[:-1, :-1] = B
    to_z[:-1, -1] = -mean
    to_z[-1, -1] = 1.0
    folds = np.zeros((parts, n, k, k))
    for fold, part in zip(folds, np.array_split(scaled, parts), strict=True):
        for i in range(n):
            own = part[:, i]
            fold[i] = to_z.T @ (own.T @ own) @ to_z
    return folds


def correlation_length(residual: Floats) -> float:
    """Return 1 + 2 sum of the autocorrelation of (N,) up to its first zero, in samples."""
    size = 2 ** int(np.ceil(np.log2(2 * residual.size)))
    spectrum = np.abs(np.fft.rfft(residual, size)) ** 2
    correlation = np.fft.irfft(spectrum)[: residual.size]
    if correlation[0] <= 0.0:
        return 1.0
    negative = np.flatnonzero(correlation <= 0.0)
    end = int(negative[0]) if negative.size else correlation.size
    return float(1.0 + 2.0 * correlation[1:end].sum() / correlation[0])


class Fit(NamedTuple):
    """The most likely values, and their covariance."""

    values: Floats  # (17 n + 14,) in the order of `Parts`
    covariance: Floats  # (17 n + 14, 17 n + 14)
    lasting: Floats  # (n,) correlation length of each joint's residual, s


def fitted(rows: Rows, windows: Indices, G: Floats, prior: Prior) -> Fit:
    """Return the most likely values over physical bodies, from these windows."""
    problem = regression(rows, windows, G, prior)
    z = solve(problem.A, problem.b, prior.cones, prior.start)
    values = prior.mean + prior.D @ z
    one = np.eye(z.size)
    H = np.linalg.inv(problem.A.T @ problem.A + one)
    covariance = prior.D @ H @ (one + problem.scatter) @ H @ prior.D.T
    rows.set_load((G @ values)[: rows.p])
    return Fit(values, covariance, problem.lasting)
