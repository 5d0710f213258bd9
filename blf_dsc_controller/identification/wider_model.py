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

A gain of a joint's torque multiplies all its values, so that the model is not linear in
both.  It is linearised about the last solution, again and again.

Torques show how gains differ, but not a factor that all have in common: whatever the
prior prefers there, such as bodies that are nearer to those of the fit, is no knowledge.
So gains are those relative to their mean.  With a spread s of n gains, their mean is
unknown by s / sqrt(n), and so is a common factor of all values x:  t^2 s^2 / n  x x^T  is
added to the covariance, where t is how much wider a 95 % interval is if the spread is
that of n gains only (Student, The probable error of a mean, 1908).

Load friction is one value for gears that drive and that are driven; the difference looks
like another such factor.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from blf_dsc_controller.identification.left_out import KINDS, LARGEST, LeftOut, left_out
from blf_dsc_controller.identification.prior import Prior
from blf_dsc_controller.identification.problem import Problem
from blf_dsc_controller.identification.recording import Indices
from blf_dsc_controller.identification.regression import (
    Fit,
    Weighted,
    correlation_lengths,
    products_of,
    sums_of,
)
from blf_dsc_controller.identification.values import LOAD_FRICTION, parts
from blf_dsc_controller.identification.windows import HOP
from blf_dsc_controller.numerics.intervals import TWO_SIDED
from blf_dsc_controller.run import Floats

_FIRST = 0.3  # size of each kind, at first
_LEAST = 1e-5  # size of each kind, at last
_ROUNDS = 5  # of residuals ...
_MOST_ROUNDS = 10  # ... if gains still change ...
_AGREE = 0.01  # ... by more than this
_STEPS = 3  # in each, of sizes
_QUANTILE = 0.975  # that half of a 95 % interval reaches
_LOST = 0.6  # of the mean load friction: gears lose more driving than driven
_FLOOR = 1e-4  # of a joint's torque, least residual


def doubt(problem: Problem, prior: Prior, fit: Fit) -> tuple[Floats, Floats]:
    """Return what the wider model says of a fit to all motion with this prior.

    That is the covariance of its values (17 n + 14, 17 n + 14), and the rms torque of each kind
    of `left_out` (kinds, n) [N m or N].
    """
    from scipy.special import stdtrit

    model = problem.parameters.model
    columns = left_out(fit.rows, model, prior.G, fit.values)
    z, H, spread = _wider_fit(problem, prior, fit, columns)
    k = prior.mean.size
    d = prior.D @ z[:k]
    covariance = prior.D @ H[:k, :k] @ prior.D.T + np.outer(d, d)
    scaled = fit.values.copy()
    parts(scaled).delay[:] = 0.0
    n = problem.rows.speed.size
    factor = 0.0  # deviation of the mean of the gains; of a single one nothing is known
    if n > 1:
        factor = float(stdtrit(n - 1, _QUANTILE)) / TWO_SIDED * spread / np.sqrt(n)
    lost = _LOST * float(parts(fit.values).terms[LOAD_FRICTION].mean())
    covariance += (factor**2 + lost**2) * np.outer(scaled, scaled)
    return covariance, _torques(problem, columns, z[k:])


def _wider_fit(
    problem: Problem, prior: Prior, fit: Fit, columns: LeftOut
) -> tuple[Floats, Floats, float]:
    """Return the values z of a wider model, their covariance, and the spread of the gains.

    z are k values of the model, relative to those of the fit, and one for each column
    left out.  Sizes of the kinds, residuals and the linearisation follow from one
    another, in turns.
    """
    k = prior.mean.size
    kinds = np.append(np.full(k, len(KINDS)), columns.kind)
    gains = np.flatnonzero(kinds == KINDS.index('gain'))
    blocks = _blocks(problem, prior, fit, columns)
    products = np.asarray(sum(map(products_of, blocks)))
    deviation = fit.problem.deviation
    lengths = fit.problem.lasting / HOP
    # the size of what the model has is that of its prior
    narrow, _ = _solved(products, (kinds == len(KINDS)) * 1.0, deviation**2)
    sizes = np.append(np.full(len(KINDS), _FIRST), 1.0)
    z = np.zeros(kinds.size)
    relative = np.eye(kinds.size + 1)  # to columns of gains relative to their mean
    relative[np.ix_(gains, gains)] -= 1.0 / gains.size
    for turn in range(_MOST_ROUNDS):
        about = _linearised(narrow, z, k, gains) @ relative
        linear = np.swapaxes(about, 1, 2) @ products @ about
        before = z[gains]
        for _ in range(_STEPS):
            z, H = _solved(linear, sizes[kinds], deviation**2 * lengths)
            sizes[:-1] = _sizes(kinds, z, H, sizes)
        blocks = _blocks(problem, prior, fit, columns)
        left = sums_of(blocks, about @ np.append(z, -1.0))
        deviation, lengths = _residual(problem, prior, fit, left)
        change = np.abs(z[gains] - before).max()
        if turn >= _ROUNDS - 1 and change < _AGREE:
            break
    z, H = _solved(linear, sizes[kinds], deviation**2 * lengths)
    return z, H, float(sizes[KINDS.index('gain')])


def _linearised(narrow: Floats, z: Floats, k: int, of_gains: Indices) -> Floats:
    """Return T (n, c, c): columns of each joint, times T, are linear about the solution z.

    They are of k values relative to `narrow`, and of what is left out, which has gains:
    the torque over the gain of joint i is (1 + gain) A_i z.
    """
    size = narrow.size + 1
    T = np.tile(np.eye(size), (of_gains.size, 1, 1))
    T[:, :-1, -1] = -narrow
    for at, own in zip(of_gains, T, strict=True):
        own[:k, :k] *= 1.0 + z[at]
        own[:k, at] = z[:k]
        own[:k, -1] += z[at] * z[:k]
    return T


def _blocks(
    problem: Problem, prior: Prior, fit: Fit, columns: LeftOut
) -> Iterator[Floats]:
    """Yield the weighted rows [A | columns left out | b] (., n, k + e n + n + 1) of all motion."""
    rows = fit.rows
    moving = problem.windows.moving
    T = prior.T
    weighted = Weighted(rows, moving, fit.problem.delay)
    for block, own in zip(rows.blocks(moving), weighted.blocks(), strict=True):
        windows = moving[block]
        A, b = np.split(own @ T, (prior.mean.size,), axis=2)
        others = rows.weight[windows][:, :, None] * columns.matrix(windows)
        yield np.concatenate((A, others, b), axis=2)


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
    squares, shown = (
        np.bincount(kinds, each)[:-1]
        for each in (z**2, 1.0 - np.diag(H) / sizes[kinds] ** 2)
    )
    found = np.sqrt(squares / np.maximum(shown, _LEAST))
    return np.clip(found, _LEAST, LARGEST)


def _residual(
    problem: Problem, prior: Prior, fit: Fit, left: Floats
) -> tuple[Floats, Floats]:
    """Return the deviation (n,) of a residual (., n), and its correlation length in windows."""
    weight = problem.rows.weight[problem.windows.moving]
    counted = np.sum(weight**2, axis=0) - prior.D.any(axis=0).sum() / left.shape[1]
    deviation = np.sqrt(np.sum(left**2, axis=0) / np.maximum(counted, 1.0))
    floor = _FLOOR * fit.problem.deviation + 1e-12
    return np.maximum(deviation, floor), correlation_lengths(left)


def _torques(problem: Problem, columns: LeftOut, z: Floats) -> Floats:
    """Return the rms torque (kinds, n) of the values z of the columns left out."""
    moving = problem.windows.moving
    of_kinds = columns.kind[:, None] == np.arange(len(KINDS))
    found = np.concatenate(
        [
            columns.matrix(moving[block]) * z @ of_kinds
            for block in problem.rows.blocks(moving)
        ]
    )
    return problem.rows.rms(np.moveaxis(found, 2, 0), moving)
