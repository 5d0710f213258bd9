# SPDX-License-Identifier: Apache-2.0
"""What the model is, by cross-validation: contacts, optional terms, and widths of the prior.

The recording is cut into five parts; each is predicted by the values found from the
others.  For optional terms there are ten parts: the motion that shows a term may be short, and
then less of it is missing in the parts that predict.  Only the recording that is fitted is
used, never the part held back for the score.  Bounds are ignored here.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.identification.physical import most_likely
from blf_dsc_controller.identification.prior import Entry, Prior
from blf_dsc_controller.identification.recording import Indices
from blf_dsc_controller.identification.regression import FOLDS, Regression, regression
from blf_dsc_controller.identification.sliding import DISTANCES
from blf_dsc_controller.identification.windows import Rows
from blf_dsc_controller.run import Floats

# of the squared error of cross-validation, least reduction by what is not the default
# ...
_WORTH = 0.01
_WORTH_OF_TERM = 0.003  # ... and by an optional term
_WIDTHS = (1.0, 3.0, 10.0, 30.0)  # of the prior
_OF_REPEATED = 2  # of them, if all folds have the same motion: they reward overfitting
_SAME = 0.1  # of the standard deviations of positions and speeds, from other folds
_WAY = 0.0, 0.25, 0.5, 0.75  # places between two windows
_TINY = 1e-9
_PARTS = 2 * FOLDS  # for optional terms


class Selected(NamedTuple):
    """A choice of the model."""

    distances: Floats  # (n,) x_s of `sliding`, rad or m
    rows: Rows  # with these contacts
    prior: Prior  # with the terms that are kept, and their widths
    widths: dict[str, float]  # factors of the groups of the prior
    found: Regression  # with all terms


def select(rows: Rows, fit: Indices, full: Prior) -> Selected:
    """Return the model that predicts best."""
    distances = _contacts(rows, fit, full)
    rows = rows.with_sliding(distances)
    found = regression(rows, fit, full, parts=_PARTS)
    folds = found.folds.sum(axis=1, keepdims=True)
    prior = full.only(_worthwhile(found._replace(folds=folds), full))
    pairs = folds[::2] + folds[1::2]
    tried = _WIDTHS[:_OF_REPEATED] if repeats(rows, fit) else _WIDTHS
    widths = prior_widths(found._replace(folds=pairs), prior, tried)
    widened = prior.widened(_factors(prior, widths))
    return Selected(distances, rows, widened, widths, found)


def _contacts(rows: Rows, fit: Indices, full: Prior) -> Floats:
    """Return for each joint the distance x_s with which its own torque is predicted best."""
    errors = []
    found: Regression | None = None
    every = np.ones(full.mean.size)
    for distance in DISTANCES:
        slid = rows.with_sliding(np.full(rows.speed.size, distance))
        found = regression(slid, fit, full, found)
        of_joints = cross_validated(found, every).sum(axis=0)
        errors.append(of_joints * found.deviation**2)
    table = np.array(errors)
    table[0] *= 1.0 - _WORTH
    best = np.argmin(table, axis=0)
    return np.asarray(np.array(DISTANCES)[best])


def _worthwhile(found: Regression, prior: Prior) -> list[Entry]:
    """Return the optional entries of z that predict the folds better.

    Entries that cannot be negative must be positive in each prediction.
    """
    optional = prior.optional
    _, terms = prior.cones
    positive = [k for entry in optional for k in entry if k in terms.entries]

    def error(kept: Sequence[Entry]) -> float:
        used = np.ones(prior.mean.size)
        used[[k for entry in optional if entry not in kept for k in entry]] = 0.0
        return float(cross_validated(found, used, positive).sum())

    kept: list[Entry] = []
    least = error(kept)
    left = list(optional)
    while left:
        errors = [error([*kept, entry]) for entry in left]
        best = int(np.argmin(errors))
        if errors[best] > (1.0 - _WORTH_OF_TERM) * least:
            break
        least = errors[best]
        kept.append(left.pop(best))
    return kept


def repeats(rows: Rows, fit: Indices) -> bool:
    """Return whether most states of each fifth of the motion are also in the others.

    Between two windows the motion is nearly straight: a period of it need not be a multiple of
    their distance.
    """
    from scipy.spatial import cKDTree

    states = np.hstack([rows.postures, rows.speeds])[fit]
    states = states / np.maximum(states.std(axis=0), _TINY)
    folds = np.array_split(states, FOLDS)
    ways = [
        np.concatenate([fold[:-1] + each * np.diff(fold, axis=0) for each in _WAY])
        for fold in folds
    ]
    distances = []
    for k, fold in enumerate(folds):
        others = np.concatenate([*ways[:k], *ways[k + 1 :]])
        distances.append(cKDTree(others).query(fold)[0])
    return bool(np.median(np.concatenate(distances)) < _SAME)


def prior_widths(
    found: Regression, prior: Prior, tried: Sequence[float]
) -> dict[str, float]:
    """Return the factor of each group's width, raised as long as that predicts better.

    Every fold must agree: a disturbance that lasts for a part of the recording looks
    like other inertias there, and only there.
    """
    used = prior.D.any(axis=0).astype(float)
    widths = dict.fromkeys(prior.groups, 1.0)
    least = cross_validated(found, used).sum(axis=1)
    for group in prior.groups:
        for width in tried[1:]:
            wider = widths | {group: width}
            errors = cross_validated(found, used * _factors(prior, wider)).sum(axis=1)
            is_worth_it = errors.sum() < (1.0 - _WORTH) * least.sum()
            if is_worth_it and (errors < least).all():
                widths = wider
                least = errors
    return widths


def _factors(prior: Prior, widths: dict[str, float]) -> Floats:
    """Return the factor of each entry of z."""
    factors = np.ones(prior.mean.size)
    for group, entries in prior.groups.items():
        factors[list(entries)] = widths[group]
    return factors


def cross_validated(
    found: Regression, factors: Floats, positive: list[int] | None = None
) -> Floats:
    """Return the squared error (parts, n) of each fold and joint, predicted by the other folds.

    `factors` (k,) are widths of the prior, 0 for what is not in the model.  The error
    is infinite where an entry of the model that must be `positive` is not.
    """
    used = np.flatnonzero(factors)
    scale = np.append(factors[used], 1.0)
    at = np.append(used, factors.size)
    folds = found.folds[:, :, at[:, None], at] * np.outer(scale, scale)
    of_joints = folds.sum(axis=1)
    rest = of_joints.sum(axis=0) - of_joints
    must = np.isin(used, positive or [])
    errors = np.zeros(folds.shape[:2])
    for k, (own, others) in enumerate(zip(folds, rest, strict=True)):
        z = most_likely(others)
        if (z[must] <= 0.0).any():
            return np.full(errors.shape, np.inf)
        both = np.append(z, -1.0)
        errors[k] = np.einsum('a,iab,b->i', both, own, both)
    return errors
