# SPDX-License-Identifier: Apache-2.0
"""Velocity of the joints where it is not measured: the difference of two positions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]


class Velocity:
    """Fills in velocities, if so configured.

    Args:
        source: `measured` leaves the velocities as they come; `estimated` replaces them.
        n: joints.
    """

    def __init__(self, source: str, n: int) -> None:
        self._estimated = source == 'estimated'
        self._stamp = -1
        self._q = np.zeros(n)
        self._dq = np.zeros(n)

    def forget(self) -> None:
        """The next state is the first: the arm is taken to be at rest there."""
        self._stamp = -1

    def replace(self, stamp: int, q: Vector, dq: Vector) -> None:
        """Overwrite dq (n,) [rad/s] by the difference of q (n,) [rad] and the last positions."""
        if not self._estimated:
            return
        if self._stamp < 0:
            self._dq[:] = 0.0
        elif stamp > self._stamp:
            self._dq[:] = (q - self._q) / ((stamp - self._stamp) * 1e-9)
        self._stamp = stamp
        self._q[:] = q
        dq[:] = self._dq
