# SPDX-License-Identifier: Apache-2.0
"""Joint velocities from positions, for arms that do not measure them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]


class Velocity:
    """Replaces velocities by difference quotients if the source is `estimated`, not `measured`."""

    def __init__(self, source: str, n: int) -> None:
        self._estimated = source == 'estimated'
        self._stamp = -1
        self._q = np.zeros(n)
        self._dq = np.zeros(n)

    def reset(self) -> None:
        """Forget the last state: the arm is taken to be at rest in the next one."""
        self._stamp = -1

    def replace(self, stamp: int, q: Vector, dq: Vector) -> None:
        """Overwrite dq (n,) [rad/s] by the difference quotient of q (n,) [rad]; stamp in ns."""
        if not self._estimated:
            return
        if self._stamp < 0 or stamp < self._stamp:
            self._dq[:] = 0.0
        elif stamp > self._stamp:
            self._dq[:] = (q - self._q) / ((stamp - self._stamp) * 1e-9)
        self._stamp = stamp
        self._q[:] = q
        dq[:] = self._dq
