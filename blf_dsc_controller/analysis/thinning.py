# SPDX-License-Identifier: Apache-2.0
"""Thinning of long series for plotting, without losing a peak."""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.run import Floats

PIECES = 1500
_MOST = 1e100


def drawable(values: Floats) -> Floats:
    """Return the values, with NaN for those that no axis can show, such as infinity."""
    return np.where(np.abs(values) < _MOST, values, np.nan)


def thin(time: Floats, values: Floats, pieces: int = PIECES) -> tuple[Floats, Floats]:
    """Thin a series without losing a peak; a mostly constant one is reduced to its corners."""
    values = drawable(values)
    changes = np.flatnonzero(np.diff(values) != 0.0)
    if changes.size < values.size // 100:
        kept = np.unique(np.concatenate([[0], changes, changes + 1, [values.size - 1]]))
        return time[kept], values[kept]
    return envelope(time, values, pieces)


def envelope(time: Floats, values: Floats, pieces: int = PIECES) -> tuple[Floats, Floats]:
    """Return the lowest and highest sample of each piece of a series (N,), in order of time.

    NaN is unknown; a piece without known values stays a gap. A series of at most two samples per
    piece is returned unchanged.
    """
    if values.size <= 2 * pieces:
        return time, values
    edges = np.linspace(0, values.size, pieces + 1).astype(np.intp)[:-1]
    low = _extreme(np.where(np.isnan(values), np.inf, values), edges, np.minimum)
    high = _extreme(np.where(np.isnan(values), -np.inf, values), edges, np.maximum)
    kept = np.sort(np.stack([low, high]), axis=0).T.ravel()
    return time[kept], values[kept]


def _extreme(values: Floats, edges: np.ndarray, reduction: np.ufunc) -> np.ndarray:
    """Return the index of the first extreme sample of each piece."""
    extremes = np.repeat(reduction.reduceat(values, edges), np.diff([*edges, values.size]))
    found = np.where(values == extremes, np.arange(values.size), values.size)
    return np.asarray(np.minimum.reduceat(found, edges))
