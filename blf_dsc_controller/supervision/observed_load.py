# SPDX-License-Identifier: Apache-2.0
"""The load besides the model, observed from the motion of an arm.

    residual' = L1 (tau - H(q, dq, dq, ddq) P^ - friction - residual)
    load' = L2 (residual - load),   |load| <= half the torque limit

On a joint that is lighter than its model by m, the model's acceleration comes back m - 1
times too large.  With the delay T of the torques it is stable while

    m T L1 L2 < L1 + L2

A sample counts as no more than the torque limit, so that one wrong reading changes little, and as
what the steps of the encoders explain, whose accelerations add up to nothing.  Limited to less,
they would hide those of the arm, and its own damping would pass for a load.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]

OBSERVER = 60.0, 30.0
"""L1 and L2 [rad/s] of the load: slow against the lag of velocities and torques."""

_LARGEST_LOAD = 0.5  # of the torque limit


class ObservedLoad:
    """Observer of the load of an arm.

    Attributes:
        load: torque (n,) [N m] beyond the model.
    """

    def __init__(self, n: int, rates: tuple[float, float]) -> None:
        """Observe with the rates L1 and L2 [rad/s]."""
        self.load = np.zeros(n)
        self._residual = np.zeros(n)
        self._rates = rates

    def begin(self, load: Vector | float) -> None:
        """Begin with a load (n,) [N m]."""
        self.load[:] = self._residual[:] = load

    def update(
        self, unmodelled: Vector, limit: Vector, dt: float, noise: Vector | float = 0.0
    ) -> None:
        """Advance by `dt` [s] with the torque beyond the model (n,) [N m] in it.

        `limit` (n,) [N m] is the torque limit, `noise` (n,) [N m] what the steps of the encoders
        add to the torque of a sample.
        """
        first, second = (min(1.0, rate * dt) for rate in self._rates)
        widest = limit + noise
        self._residual += first * np.clip(unmodelled - self._residual, -widest, widest)
        self.load += second * (self._residual - self.load)
        largest = _LARGEST_LOAD * limit
        np.clip(self.load, -largest, largest, out=self.load)
