# SPDX-License-Identifier: Apache-2.0
"""Torques that a sensor or a drive has clipped: rows that contain them are left out.

A torque that is free to vary takes its extreme value once, or, if it is recorded in
steps, not much longer than the step next to it.  A clipped one stays there.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from blf_dsc_controller.identification.on_disk import blocks_of
from blf_dsc_controller.identification.windows import STILL, Rows
from blf_dsc_controller.run import Floats

_LEAST = 0.002  # of the samples in motion at an extreme value ...
_TIMES = 10.0  # ... and so many times those at the value next to it
_FEWEST = 10  # samples


def without_clipped(rows: Rows) -> Rows:
    """Return the rows with no weight where a joint's torque is clipped."""
    lowest = _limits(rows, -1.0)
    highest = _limits(rows, 1.0)

    def is_clipped(at: slice) -> Floats:
        torque = np.asarray(rows.torque[at])
        return np.asarray((torque >= highest) | (torque <= -lowest), dtype=np.float64)

    if not np.isfinite((lowest, highest)).any():
        return rows
    clipped = rows.over_windows(is_clipped, np.ones_like(rows.g)) > 0.0
    weight = np.where(clipped, 0.0, rows.weight)
    return rows._replace(clipped=clipped, weight=weight)


def _limits(rows: Rows, sign: float) -> Floats:
    """Return for each joint (n,) the value at which sign times its torque is clipped.

    Infinity where it is not.
    """
    largest, next_to_it = _two_largest(rows, sign)
    at_largest = np.zeros(largest.size)
    at_next = np.zeros(largest.size)
    moving = 0
    for torque in _in_motion(rows, sign):
        at_largest += np.sum(torque == largest, axis=0)
        at_next += np.sum(torque == next_to_it, axis=0)
        moving += len(torque)
    often = np.maximum(_FEWEST, _LEAST * moving)
    is_clipped = (at_largest >= often) & (at_largest >= _TIMES * at_next)
    return np.where(is_clipped & (largest > next_to_it), largest, np.inf)


def _two_largest(rows: Rows, sign: float) -> tuple[Floats, Floats]:
    """Return the largest value of sign times each joint's torque (n,), and the next below."""
    largest = np.full(rows.speed.size, -np.inf)
    for torque in _in_motion(rows, sign):
        largest = np.maximum(largest, torque.max(axis=0, initial=-np.inf))
    next_to_it = np.full(rows.speed.size, -np.inf)
    for torque in _in_motion(rows, sign):
        below = np.where(torque < largest, torque, -np.inf)
        next_to_it = np.maximum(next_to_it, below.max(axis=0, initial=-np.inf))
    return largest, next_to_it


def _in_motion(rows: Rows, sign: float) -> Iterator[Floats]:
    """Yield sign times the torques (k, n) of the samples in which a joint moves."""
    for at in blocks_of(len(rows.q)):
        is_moving = (np.abs(rows.dq[at]) > STILL).any(axis=1)
        yield sign * np.asarray(rows.torque[at])[is_moving]
