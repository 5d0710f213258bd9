# SPDX-License-Identifier: Apache-2.0
"""Velocities of arms that measure none: finite differences of their positions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
_MOVING = 3e-4  # rad in a sample: three counts of an encoder of 16 bits
# ns without states, after which the arm is at rest, as at the start
_PAUSE = 1_000_000_000


class Velocity:
    """Replaces velocities with finite differences of positions.

    An arm in motion whose positions do not change for a sample has sent its last
    reading once more, with a new stamp: it is continued at its velocity.
    """

    def __init__(self, n: int) -> None:
        # ns, of the last new reading and of the last state
        self._stamp = self._seen = -1
        self._q = np.zeros(n)
        self._dq = np.zeros(n)
        self._repeated = False

    def begin(self, stamp: int, q: Vector) -> None:
        """Difference the next positions from q (n,) [rad] with its stamp [ns]."""
        self._stamp = self._seen = stamp
        self._q[:] = q

    def replace(self, stamp: int, measurement: Vector) -> None:
        """Overwrite dq in [q, dq, torque] (3n,) with a stamp [ns]."""
        q, dq, _ = measurement.reshape(3, -1)
        if self._stamp < 0 or not 0 <= stamp - self._stamp < _PAUSE:
            self._dq[:] = 0.0
        elif stamp > self._seen:
            step = (stamp - self._stamp) * 1e-9
            self._seen = stamp
            is_moving = float(np.abs(self._dq).max()) * step > _MOVING
            self._repeated = (
                is_moving and not self._repeated and bool((q == self._q).all())
            )
            if self._repeated:
                q += step * self._dq
                dq[:] = self._dq
                return
            self._dq[:] = (q - self._q) / step
        self._stamp = self._seen = stamp
        self._q[:] = q
        dq[:] = self._dq
