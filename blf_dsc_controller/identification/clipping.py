# SPDX-License-Identifier: Apache-2.0
"""Torques that a sensor or a drive has clipped: rows that contain them are left out.

A torque that is free to vary takes its extreme value once, or, if it is recorded in
steps, not much longer than the step next to it.  A clipped one stays there.
"""

from __future__ import annotations

import numpy as np

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
    clipped = rows.over_windows(is_clipped) > 0.0
    weight = np.where(clipped, 0.0, rows.weight)
    return rows._replace(clipped=clipped, weight=weight)


def _limits(rows: Rows, sign: float) -> Floats:
    """Return for each joint (n,) the value at which sign times its torque is clipped.

    Infinity where it is not.
    """
    is_moving = (np.abs(rows.dq[:]) > STILL).any(axis=1)
    torque = sign * rows.torque[is_moving]
    largest = torque.max(axis=0, initial=-np.inf)
    below = torque.max(axis=0, initial=-np.inf, where=torque < largest)
    at_largest = np.sum(torque == largest, axis=0)
    at_next = np.sum(torque == below, axis=0)
    often = np.maximum(_FEWEST, _LEAST * len(torque))
    is_clipped = (at_largest >= often) & (at_largest >= _TIMES * at_next)
    return np.where(is_clipped & (largest > below), largest, np.inf)
