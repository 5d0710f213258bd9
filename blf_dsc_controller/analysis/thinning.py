# SPDX-License-Identifier: Apache-2.0
"""Long series with fewer samples, for pictures that lose no peak."""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.run import Floats

PIECES = 1500
_MOST = 1e100


def drawable(values: Floats) -> Floats:
    """Values with gaps for what no axis can show, such as infinity."""
    return np.where(np.abs(values) < _MOST, values, np.nan)


def thin(time: Floats, values: Floats, pieces: int = PIECES) -> tuple[Floats, Floats]:
    """Thin a series without losing a peak; of a mostly constant one the corners remain."""
    values = drawable(values)
    changes = np.flatnonzero(np.diff(values) != 0.0)
    if changes.size < values.size // 100:
        kept = np.unique(np.concatenate([[0], changes, changes + 1, [values.size - 1]]))
        return time[kept], values[kept]
    return envelope(time, values, pieces)


def envelope(time: Floats, values: Floats, pieces: int = PIECES) -> tuple[Floats, Floats]:
    """Lowest and highest sample of each piece of a series (N,), in their order.

    NaN is unknown; a piece in which nothing is known stays a gap. At most two samples of each piece
    remain, all of them if they are so few.
    """
    if values.size <= 2 * pieces:
        return time, values
    edges = np.linspace(0, values.size, pieces + 1).astype(np.intp)[:-1]
    low = _extreme(np.where(np.isnan(values), np.inf, values), edges, np.minimum)
    high = _extreme(np.where(np.isnan(values), -np.inf, values), edges, np.maximum)
    kept = np.sort(np.stack([low, high]), axis=0).T.ravel()
    return time[kept], values[kept]


def _extreme(values: Floats, edges: np.ndarray, reduction: np.ufunc) -> np.ndarray:
    """Index of the first sample of each piece that is its extreme one."""
    extremes = np.repeat(reduction.reduceat(values, edges), np.diff([*edges, values.size]))
    found = np.where(values == extremes, np.arange(values.size), values.size)
    return np.asarray(np.minimum.reduceat(found, edges))
