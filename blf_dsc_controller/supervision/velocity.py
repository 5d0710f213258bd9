# SPDX-License-Identifier: Apache-2.0
"""Joint velocities from positions, for arms that do not measure them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]


class Velocity:
    """Replaces velocities with finite differences of positions."""

    def __init__(self, n: int) -> None:
        self._stamp = -1
        self._q = np.zeros(n)
        self._dq = np.zeros(n)

    def reset(self) -> None:
        """Forget the last state: the arm is assumed to be at rest in the next one."""
        self._stamp = -1

    def replace(self, stamp: int, measurement: Vector) -> None:
        """Overwrite dq in [q (n,) rad, dq (n,) rad/s, torque (n,)] with a stamp [ns]."""
        q, dq, _ = measurement.reshape(3, -1)
        if self._stamp < 0 or stamp < self._stamp:
            self._dq[:] = 0.0
        elif stamp > self._stamp:
            self._dq[:] = (q - self._q) / ((stamp - self._stamp) * 1e-9)
        self._stamp = stamp
        self._q[:] = q
        dq[:] = self._dq
