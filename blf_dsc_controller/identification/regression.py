# SPDX-License-Identifier: Apache-2.0
"""The weighted least-squares problem of a recording, with its folds.

Each joint is weighted by the inverse deviation of its own residual, the delay of the
torques is linearised about its last estimate, and the load friction computed with the
last estimate of gravity: a few passes until the deviations agree, fewer from the solution of
a problem that is much like it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.identification.physical import most_likely, solve
from blf_dsc_controller.identification.prior import Prior
from blf_dsc_controller.identification.recording import Indices
from blf_dsc_controller.identification.windows import HOP, Rows
from blf_dsc_controller.run import Floats

FOLDS = 5
"""Parts of the recording for cross-validation."""

_PASSES = 10  # at most: five or six are needed from afar, two or three from nearby
_AGREE = 1e-4  # relative change of a deviation; values then agree to some 1e-6
_DEVIATION = 0.1  # of a joint's torque, of its residual at first
_FLOOR = 1e-3  # of that, least deviation


class Regression(NamedTuple):
    """The problem |A z - b|^2 + |z|^2 of k unknowns z, normalised by deviations of the joints."""

    # (parts, n, k + 1, k + 1) [A | b]^T [A | b] of successive windows, for each joint
    folds: Floats
    theta: Floats  # (m + 1,) solution without bounds: unknowns of `Rows`, delay in s
    lasting: Floats  # (n,) correlation length of each joint's residual, s
    deviation: Floats  # (n,) of each joint's residual, N m or N
    delay: float  # s, of the torques in A
    rows: Rows  # of A: with the load friction of the values before

    @property
    def products(self) -> Floats:
        """[A | b]^T [A | b] (k + 1, k + 1)."""
        return np.asarray(self.folds.sum(axis=(0, 1)))


def regression(
    rows: Rows,
    fit: Indices,
    prior: Prior,
    near: Regression | None = None,
    *,
    parts: int = FOLDS,
) -> Regression:
    """Return the problem of the prior's z (k,), with deviations and gravity of its own solution.

    It is that of the windows `fit`.  The solution is looked for from that of a problem `near` it.
    """
    T = prior.T
    theta = -T[:-1, -1]
    deviation = _DEVIATION * np.sqrt(np.mean(rows.u(0.0)[fit] ** 2, axis=0))
    floor = _FLOOR * deviation + 1e-12
    if near:
        theta = near.theta
        deviation = np.maximum(near.deviation, floor)
    counted = np.sum(rows.weight[fit] ** 2, axis=0) - theta.size / deviation.size
    counted = np.maximum(counted, 1.0)
    for _ in range(_PASSES):
        loaded = rows.with_load(theta)
        weighted = Weighted(loaded, fit, float(theta[-1]))
        folds = np.array(list(weighted.products(parts)))
        of_joints = folds.sum(axis=0)
        z = most_likely(of_prior(of_joints, deviation, T))
        theta = T[:-1] @ np.append(z, -1.0)
        weights = np.append(theta, -1.0)
        left = np.einsum('a,iab,b->i', weights, of_joints, weights)
        found = np.sqrt(np.maximum(left, 0.0) / counted)
        deviation_used = deviation
        deviation = np.maximum(found, floor)
        if (np.abs(deviation - deviation_used) <= _AGREE * deviation).all():
            break
    residuals = sums_of(weighted.blocks(), np.tile(weights, (deviation.size, 1)))
    return Regression(
        T.T @ (folds / deviation_used[:, None, None] ** 2) @ T,
        theta,
        HOP * correlation_lengths(residuals),
        deviation_used,
        weighted.delay,
        loaded,
    )


def of_prior(products: Floats, deviation: Floats, T: Floats) -> Floats:
    """Return [A | b]^T [A | b] (k + 1, k + 1) of `Prior.T`, with all joints by their deviations.

    `products` (n, m + 2, m + 2) are those of the rows of `Weighted`.
    """
    return np.asarray(T.T @ np.tensordot(deviation**-2.0, products, 1) @ T)


class Weighted:
    """The rows [X | -du/dt | u] (k, n, m + 2), the last of torques without their delay.

    They are those of some windows (k,), times the weights, and computed block by block.

    Attributes:
        delay: of the torques, about which they are linearised [s].
    """

    def __init__(self, rows: Rows, windows: Indices, delay: float) -> None:
        u, rate = (each[windows] for each in rows.u_and_rate(delay))
        self._columns = np.stack((-rate, u - delay * rate), axis=2)
        self._rows = rows
        self._windows = windows
        self.delay = delay

    def blocks(self) -> Iterator[Floats]:
        """Yield all of them, one after the other."""
        return self._of(np.arange(self._windows.size))

    def _of(self, part: Indices) -> Iterator[Floats]:
        windows = self._windows[part]
        for block in self._rows.blocks(windows):
            X = self._rows.matrix(windows[block])
            weight = self._rows.weight[windows[block]]
            rows = np.concatenate((X, self._columns[part[block]]), axis=2)
            yield weight[:, :, None] * rows

    def products(self, parts: int) -> Iterator[Floats]:
        """Yield the products (n, m + 2, m + 2) of the columns in each of successive parts."""
        n, c = self._rows.speed.size, self._rows.unknowns + 2
        for part in np.array_split(np.arange(self._windows.size), parts):
            yield sum(map(products_of, self._of(part)), np.zeros((n, c, c)))


def products_of(block: Floats) -> Floats:
    """Return the products (n, c, c) of the columns of a block (k, n, c), for each joint."""
    of_joints = np.moveaxis(block, 1, 0)
    return np.swapaxes(of_joints, 1, 2) @ of_joints


def sums_of(blocks: Iterable[Floats], weights: Floats) -> Floats:
    """Return the sums (., n) of the columns of blocks (., n, c), times the weights (n, c)."""
    return np.concatenate([np.einsum('kic,ic->ki', each, weights) for each in blocks])


def correlation_lengths(residuals: Floats) -> Floats:
    """Return `correlation_length` of each column (n,) of residuals (N, n)."""
    return np.array([correlation_length(column) for column in residuals.T])


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
    """The most likely values over physical bodies, and the problem without this bound."""

    values: Floats  # (17 n + 14,) in the order of `Parts`
    theta: Floats  # (m + 1,) unknowns of `Rows`, and the delay [s]
    problem: Regression
    rows: Rows  # with the load friction of these values


def fitted(
    rows: Rows,
    windows: Indices,
    prior: Prior,
    near: Regression | None = None,
) -> Fit:
    """Return the fit to these windows."""
    problem = regression(rows, windows, prior, near)
    z = solve(problem.products, prior.cones, prior.start)
    values = prior.mean + prior.D @ z
    theta = prior.G @ values
    return Fit(values, theta, problem, rows.with_load(theta))
