# SPDX-License-Identifier: Apache-2.0
"""Covariance of the values, with doubt about the model itself.

A fit cannot tell that its model is not the arm's: it finds other values, with narrow
intervals.  So what it leaves of the torques is fitted, without bounds, by a wider model
that has the columns of `left_out` as well.  How large each kind of them is, as a standard
deviation over its columns, is estimated together with them, so that kinds that the
recording does not show vanish (empirical Bayes: MacKay, Bayesian interpolation, 1992).
The covariance is that of the wider model, and what it adds to the values, d:

    (I + sum_i A_i^T A_i / l_i)^-1 + d d^T

with the rows A_i of each joint, of which one in a correlation length l_i counts.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from blf_dsc_controller.identification.left_out import KINDS, LARGEST, LeftOut, left_out
from blf_dsc_controller.identification.prior import Prior
from blf_dsc_controller.identification.problem import Problem
from blf_dsc_controller.identification.regression import (
    Fit,
    Weighted,
    correlation_length,
    to_z,
)
from blf_dsc_controller.identification.windows import HOP
from blf_dsc_controller.run import Floats

_FIRST = 0.3  # size of each kind, at first
_LEAST = 1e-5  # size of each kind, at last
_ROUNDS = 5  # of residuals ...
_STEPS = 3  # ... and in each, of sizes
_FLOOR = 1e-4  # of a joint's torque, least residual


class Doubt(NamedTuple):
    """What the wider model says of the values, and of what the model leaves out."""

    covariance: Floats  # (17 n + 14, 17 n + 14) of the values
    # (kinds, n) rms torque of each kind of `left_out`, N m or N
    torques: Floats


def doubt(problem: Problem, prior: Prior, fit: Fit, distances: Floats) -> Doubt:
    """Return the doubt in a fit to all motion with this prior, and these distances of contacts."""
    rows = problem.rows
    model = problem.parameters.model
    columns = left_out(rows, model, problem.G, fit.values, distances)
    k = prior.mean.size
    kinds = np.concatenate((np.full(k, len(KINDS)), columns.kind))
    products = _products(_blocks(problem, prior, fit, columns))
    deviation = fit.problem.deviation
    lengths = fit.problem.lasting / HOP
    # the size of what the model has is that of its prior
    sizes = np.append(np.full(len(KINDS), _FIRST), 1.0)
    narrow, _ = _solved(products, (kinds == len(KINDS)) * 1.0, deviation**2)
    to_rest = np.eye(len(products[0]))
    to_rest[:-1, -1] = -narrow
    products = to_rest.T @ products @ to_rest
    for _ in range(_ROUNDS):
        for _ in range(_STEPS):
            z, H = _solved(products, sizes[kinds], deviation**2 * lengths)
            sizes[:-1] = _sizes(kinds, z, H, sizes)
        blocks = _blocks(problem, prior, fit, columns)
        left = np.concatenate([each @ np.append(narrow + z, -1.0) for each in blocks])
        deviation, lengths = _residual(problem, prior, fit, left)
    z, H = _solved(products, sizes[kinds], deviation**2 * lengths)
    d = prior.D @ z[:k]
    covariance = prior.D @ H[:k, :k] @ prior.D.T + np.outer(d, d)
    return Doubt(covariance, _torques(problem, columns, z[k:]))


def _blocks(
    problem: Problem, prior: Prior, fit: Fit, columns: LeftOut
) -> Iterator[Floats]:
    """Yield the weighted rows [A | columns left out | b] (., n, k + e n + n + 1) of all motion."""
    rows = problem.rows
    moving = problem.windows.moving
    T = to_z(problem.G, prior)
    weighted = Weighted(rows, moving, fit.problem.delay)
    for block, own in zip(rows.blocks(moving), weighted.blocks(), strict=True):
        windows = moving[block]
        A, b = np.split(own @ T, (prior.mean.size,), axis=2)
        others = rows.weight[windows][:, :, None] * columns.matrix(windows)
        yield np.concatenate((A, others, b), axis=2)


def _products(blocks: Iterator[Floats]) -> Floats:
    """Return the products (n, c, c) of the columns of blocks (., n, c), for each joint."""
    products: Any = 0.0
    for block in blocks:
        of_joints = np.moveaxis(block, 1, 0)
        products = products + np.swapaxes(of_joints, 1, 2) @ of_joints
    return np.asarray(products)


def _solved(products: Floats, scale: Floats, variance: Floats) -> tuple[Floats, Floats]:
    """Return values and their covariance, with deviations `scale` at first.

    `variance` (n,) is that of the rows of each joint.
    """
    M = np.tensordot(1.0 / variance, products, 1)
    S = np.outer(scale, scale)
    H = S * np.linalg.inv(S * M[:-1, :-1] + np.eye(scale.size))
    return H @ M[:-1, -1], H


def _sizes(kinds: Floats, z: Floats, H: Floats, sizes: Floats) -> Floats:
    """Return the size of each kind: its sum of squares over the number of values that are shown."""
    found = []
    for kind, size in enumerate(sizes[:-1]):
        own = kinds == kind
        shown = np.sum(1.0 - np.diag(H)[own] / size**2)
        found.append(np.sqrt(np.sum(z[own] ** 2) / max(shown, _LEAST)))
    return np.asarray(np.clip(found, _LEAST, LARGEST))


def _residual(
    problem: Problem, prior: Prior, fit: Fit, left: Floats
) -> tuple[Floats, Floats]:
    """Return the deviation (n,) of a residual (., n), and its correlation length in windows."""
    weight = problem.rows.weight[problem.windows.moving]
    counted = np.sum(weight**2, axis=0) - prior.D.any(axis=0).sum() / left.shape[1]
    deviation = np.sqrt(np.sum(left**2, axis=0) / np.maximum(counted, 1.0))
    floor = _FLOOR * fit.problem.deviation + 1e-12
    lengths = [correlation_length(column) for column in left.T]
    return np.maximum(deviation, floor), np.array(lengths)


def _torques(problem: Problem, columns: LeftOut, z: Floats) -> Floats:
    """Return `Doubt.torques` for the values z of the columns left out."""
    moving = problem.windows.moving
    found = np.zeros((len(KINDS), moving.size, problem.rows.speed.size))
    for block in problem.rows.blocks(moving):
        X = columns.matrix(moving[block]) * z
        for kind, torques in enumerate(found):
            torques[block] = X[:, :, columns.kind == kind].sum(axis=2)
    return problem.rows.rms(found, moving)
