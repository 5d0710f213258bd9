# SPDX-License-Identifier: Apache-2.0
"""The weighted least-squares problem of a recording, with its folds.

Each joint is weighted by the inverse deviation of its own residual, the delay of the
torques is linearised about its last estimate, and the load friction computed with the
last estimate of gravity: a few passes until the deviations agree, fewer from the solution of
a problem that is much like it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from blf_dsc_controller.identification.physical import solve
from blf_dsc_controller.identification.prior import Prior
from blf_dsc_controller.identification.windows import HOP, Indices, Rows
from blf_dsc_controller.run import Floats

FOLDS = 5
"""Parts of the recording for cross-validation."""

_PASSES = 10  # at most: five or six are needed from afar, two or three from nearby
_AGREE = 1e-4  # relative change of a deviation; values then agree to some 1e-6
_DEVIATION = 0.1  # of a joint's torque, of its residual at first
_FLOOR = 1e-3  # of that, least deviation
_AT_ONCE = 8  # times the columns, rows of a triangle that are reduced at once


class Regression(NamedTuple):
    """The problem |A z - b|^2 + |z|^2 of k unknowns z, normalised by deviations of the joints."""

    A: Floats  # (., k)
    b: Floats  # (.,)
    # (parts, n, k + 1, k + 1) [A | b]^T [A | b] of successive windows, for each joint
    folds: Floats
    theta: Floats  # (m + 1,) solution without bounds: unknowns of `Rows`, delay in s
    lasting: Floats  # (n,) correlation length of each joint's residual, s
    deviation: Floats  # (n,) of each joint's residual, N m or N
    delay: float  # s, of the torques in A
    rows: Rows  # of A: with the load friction of the values before


def regression(
    rows: Rows,
    fit: Indices,
    G: Floats,
    prior: Prior,
    near: Regression | None = None,
    *,
    parts: int = FOLDS,
) -> Regression:
    """Return the problem of the prior's z (k,), with deviations and gravity of its own solution.

    It is that of the windows `fit`; G (m + 1, k) are the unknowns of `Rows`, and the delay [s], by
    the values of the prior.  The solution is looked for from that of a problem `near` it.
    """
    mean = G @ prior.mean
    B = G @ prior.D
    theta = mean
    deviation = _DEVIATION * np.sqrt(np.mean(rows.u(0.0)[fit] ** 2, axis=0))
    floor = _FLOOR * deviation + 1e-12
    if near:
        theta = near.theta
        deviation = np.maximum(near.deviation, floor)
    counted = np.sum(rows.weight[fit] ** 2, axis=0) - theta.size / deviation.size
    counted = np.maximum(counted, 1.0)
    for _ in range(_PASSES):
        loaded = rows.with_load(theta[: rows.p])
        weighted = Weighted(loaded, fit, float(theta[-1]))
        of_joints = triangle(np.moveaxis(each, 1, 0) for each in weighted.blocks())
        A, b = _of_prior(of_joints / deviation[:, None, None], mean, B)
        theta = mean + B @ np.linalg.solve(A.T @ A + np.eye(A.shape[1]), A.T @ b)
        left = of_joints @ np.append(theta, -1.0)
        found = np.sqrt(np.sum(left**2, axis=1) / counted)
        deviation_used = deviation
        deviation = np.maximum(found, floor)
        if (np.abs(deviation - deviation_used) <= _AGREE * deviation).all():
            break
    solved = Regression(
        A,
        b,
        np.empty(0),
        theta,
        _lasting(weighted, theta),
        deviation_used,
        weighted.delay,
        loaded,
    )
    folds = np.array(list(successive(fit, G, prior, solved, parts)))
    return solved._replace(folds=folds)


def _of_prior(triangles: Floats, mean: Floats, B: Floats) -> tuple[Floats, Floats]:
    """Return A (., k) and b (.,) of the prior's z, where theta = mean + B z.

    `triangles` (n, ., m + 2) has for each joint [columns of theta | torque], by its deviation.
    """
    R = triangle([triangles.reshape(-1, mean.size + 1)])
    return R[:, :-1] @ B, R[:, -1] - R[:, :-1] @ mean


def successive(
    fit: Indices, G: Floats, prior: Prior, found: Regression, parts: int
) -> Iterator[Floats]:
    """Yield the products of `Regression.folds` for so many parts."""
    weighted = Weighted(found.rows, fit, found.delay)
    T = to_z(G, prior)
    for products in weighted.products(parts):
        yield T.T @ (products / found.deviation[:, None, None] ** 2) @ T


def to_z(G: Floats, prior: Prior) -> Floats:
    """Return T (m + 2, k + 1): the rows of `Weighted` times T are [A | b] of the prior's z."""
    B = G @ prior.D
    T = np.zeros((B.shape[0] + 1, B.shape[1] + 1))
    T[:-1, :-1] = B
    T[:-1, -1] = -G @ prior.mean
    T[-1, -1] = 1.0
    return T


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
        for block in self._rows.blocks(self._windows):
            X = self._rows.matrix(self._windows[block])
            weight = self._rows.weight[self._windows[block]]
            rows = np.concatenate((X, self._columns[block]), axis=2)
            yield weight[:, :, None] * rows

    def products(self, parts: int) -> Iterator[Floats]:
        """Yield the products (n, m + 2, m + 2) of the columns in each of successive parts."""
        ends = np.cumsum([part.size for part in np.array_split(self._windows, parts)])
        done = 0
        products: Any = 0.0
        for block in self.blocks():
            of_joints = np.moveaxis(block, 1, 0)
            inside = ends[(ends > done) & (ends <= done + len(block))] - done
            *whole, rest = np.split(of_joints, inside, axis=1)
            for part in whole:
                yield products + np.swapaxes(part, 1, 2) @ part
                products = 0.0
            products = products + np.swapaxes(rest, 1, 2) @ rest
            done += len(block)


def triangle(blocks: Iterable[Floats]) -> Floats:
    """Return the R of the QR decomposition of the rows in blocks (..., k, m), one below another.

    R^T R is that of all rows.
    """
    waiting: list[Floats] = []
    for block in blocks:
        waiting.append(block)
        if sum(each.shape[-2] for each in waiting) > _AT_ONCE * block.shape[-1]:
            waiting = [_triangle(waiting)]
    return _triangle(waiting)


def _triangle(blocks: Sequence[Floats]) -> Floats:
    return np.asarray(np.linalg.qr(np.concatenate(blocks, axis=-2), mode='r'))


def _lasting(weighted: Weighted, theta: Floats) -> Floats:
    """Return the correlation length (n,) [s] of each joint's residual."""
    solution = np.append(theta, -1.0)
    residual = np.concatenate([each @ solution for each in weighted.blocks()])
    return HOP * np.array([correlation_length(column) for column in residual.T])


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
    problem: Regression
    rows: Rows  # with the load friction of these values


def fitted(
    rows: Rows,
    windows: Indices,
    G: Floats,
    prior: Prior,
    near: Regression | None = None,
) -> Fit:
    """Return the fit to these windows."""
    problem = regression(rows, windows, G, prior, near)
    z = solve(problem.A, problem.b, prior.cones, prior.start)
    values = prior.mean + prior.D @ z
    return Fit(values, problem, rows.with_load((G @ values)[: rows.p]))
