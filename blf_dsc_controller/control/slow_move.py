# SPDX-License-Identifier: Apache-2.0
"""How long a straight move from rest to rest takes, below given speeds and accelerations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_PEAK_SPEED, _PEAK_ACCELERATION = 1.875, 5.774  # of minimum jerk, over a unit of time


def duration_of(far: Floats, speed: Floats, acceleration: Floats) -> float:
    """Return the time [s] of minimum jerk over distances `far` (n,) [rad].

    No joint is faster than `speed` (n,) [rad/s] or `acceleration` (n,) [rad/s^2].
    """
    by_speed = float((_PEAK_SPEED * far / speed).max())
    by_acceleration = float(np.sqrt(_PEAK_ACCELERATION * far / acceleration).max())
    return max(by_speed, by_acceleration)
