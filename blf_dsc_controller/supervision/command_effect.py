# SPDX-License-Identifier: Apache-2.0
"""Whether the arm accelerates after a stop: if so, commands or a load act on it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]

_SETTLING_TIME = 0.01  # s, for which the velocities lag behind the stop
_SPEED_TIME = 0.02  # s, against their noise
_NOTICED_TORQUE = 0.05  # of the torque limit
# of it: a command that changes by more would have accelerated the arm
_CHANGED_COMMAND = 0.2
_EFFECT_TIME = 0.1  # s, for which commands may have no effect


class CommandEffect:
    """Average of the torque M ddq that accelerates the arm.

    An arm held by brakes, or by drives whose effort controller is inactive, does not
    accelerate, whatever is commanded.  One that brakes by the commanded damping does,
    or that falls with a load that is not in the model.
    """

    def __init__(self, n: int) -> None:
        self._average = np.zeros(n)
        self.restart()

    def restart(self) -> None:
        """Forget the torques so far."""
        self._elapsed = 0.0
        self._without_effect = 0.0
        self._average[:] = 0.0
        self.is_proven = False

    def update(self, accelerating: Vector, limit: Vector, dt: float) -> None:
        """Average the torque M ddq (n,) [N m] that has accelerated the arm for `dt` [s].

        `is_proven` becomes true once it exceeds 5 % of the torque `limit` (n,) [N m] on a joint.
        """
        self._elapsed += dt
        if self._elapsed < _SETTLING_TIME:
            return
        gain = min(1.0, dt / _SPEED_TIME)
        self._average += gain * (accelerating - self._average)
        largest = float((np.abs(self._average) / limit).max())
        self.is_proven = self.is_proven or largest > _NOTICED_TORQUE

    def await_effect(self, change: Vector, limit: Vector, dt: float) -> bool:
        """Wait for an effect of commands that changed by these torques (n,) [N m].

        Return whether the wait has just been too long, once.  `dt` [s] is the time since
        the last call.  Call it until an effect is proven.
        """
        has_changed = bool((np.abs(change) > _CHANGED_COMMAND * limit).any())
        if not has_changed or self._without_effect > _EFFECT_TIME:
            return False
        self._without_effect += dt
        return self._without_effect > _EFFECT_TIME
