# SPDX-License-Identifier: Apache-2.0
"""When a load is picked up within a recording, and put down again.

All of the motion is looked at, also the part that is held back for the score of the model.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import combinations

import numpy as np

from blf_dsc_controller.identification.physical import left_of, most_likely
from blf_dsc_controller.identification.prior import Prior
from blf_dsc_controller.identification.recording import Indices
from blf_dsc_controller.identification.regression import Weighted, of_prior, regression
from blf_dsc_controller.identification.windows import Carried, Rows, Split
from blf_dsc_controller.run import Floats

_PER_STEP = 10  # windows from one time to the next at which a load may change, at least
_MOST_STEPS = 400
_COARSE = 24  # parts, of which all intervals are tried


def carried_load(rows: Rows, windows: Split, prior: Prior) -> Carried:
    """Return when a load is carried, so that the torques are explained best.

    Of a recording in parts all intervals are tried, then all steps around both ends of the best.
    """
    moving = windows.moving
    steps = max(moving.size // _per_step(moving), 2)
    found = regression(rows, moving, prior)
    load = prior.at.load
    added = [
        _columns(of_prior(products, found.deviation, prior.T), load)
        for products in Weighted(found.rows, moving, found.delay).products(steps)
    ]
    # of the load in all steps before each
    before = np.cumsum([np.zeros_like(added[0]), *added], axis=0)
    empty = found.products - before[-1]

    def cost(begin: int, end: int) -> float:
        products = empty + before[end] - before[begin]
        z = most_likely(products)
        mass = (prior.mean + prior.D @ z)[load[0]]
        return left_of(products, z) + float(z @ z) if mass >= 0.0 else np.inf

    begin, end = _best_interval(cost, steps)
    first = rows.time[[part[0] for part in np.array_split(moving, steps)]]
    return Carried(
        float(first[begin]) if begin else -np.inf,
        float(first[end]) if end < steps else np.inf,
    )


def without_changes(windows: Split, rows: Rows, carried: Carried) -> Split:
    """Return the windows but those a step around a pick-up or put-down."""
    per_step = _per_step(windows.moving)
    time = rows.time[windows.moving]
    changing = np.zeros(time.size, dtype=bool)
    for at in carried:
        if np.isfinite(at):
            k = int(np.searchsorted(time, at))
            changing[max(k - per_step, 0) : k + per_step] = True
    left_out = windows.moving[changing]
    return Split(*(each[~np.isin(each, left_out)] for each in windows))


def _per_step(moving: Indices) -> int:
    return max(_PER_STEP, -(-moving.size // _MOST_STEPS))


def _best_interval(cost: Callable[[int, int], float], steps: int) -> tuple[int, int]:
    """Return begin and end of the interval of least cost, which is a part of so many steps."""

    def best(intervals: Iterable[tuple[int, int]]) -> tuple[int, int]:
        parts = (each for each in intervals if each != (0, steps))
        return min(parts, key=lambda each: cost(*each))

    part = -(-steps // _COARSE)
    edges = [*range(0, steps, part), steps]
    begin, end = best(combinations(edges, 2))

    def around(k: int) -> range:
        return range(max(k - part, 0), min(k + part, steps) + 1)

    for _ in range(2):
        begin, _ = best((k, end) for k in around(begin) if k < end)
        _, end = best((begin, k) for k in around(end) if k > begin)
    return begin, end


def _columns(products: Floats, load: Floats) -> Floats:
    """Return the part of [A | b]^T [A | b] that has columns of the load."""
    others = products.copy()
    others[load] = 0.0
    others[:, load] = 0.0
    return np.asarray(products - others)
