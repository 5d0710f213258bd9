# SPDX-License-Identifier: Apache-2.0
"""The torques that reach the plant: which are taken, and how old the last one is.

The mirror of what the controller does with joint states: a motor that goes on with a command from
long ago, or takes one that is no number, is as dangerous as a law that does.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class Reception:
    """The last torque taken, and what was not taken.

    Args:
        joints: names of the n joints.

    Attributes:
        torque: (n,) taken last [N m].
        wrong_length: commands passed over because they were not of n values.
        not_finite: commands passed over because of a value that is no number.
        complaint: what was wrong with the last command that was passed over.
        stale_steps: steps for which the torque was too old.
    """

    def __init__(self, joints: tuple[str, ...]) -> None:
        self._joints = joints
        self.torque = np.zeros(len(joints))
        self.complaint = ''
        self.wrong_length = 0
        self.not_finite = 0
        self.stale_steps = 0
        self._taken_at = 0

    @property
    def rejected(self) -> int:
        """Commands passed over."""
        return self.wrong_length + self.not_finite

    def take(self, size: int, torque: NDArray[np.float64], sample: int) -> bool:
        """Take a command, or say in `complaint` why not.

        Args:
            size: number of values that came.
            torque: (n,) the values, where there were n.
            sample: of the plant.
        """
        if size != self.torque.size:
            self.wrong_length += 1
            self.complaint = f'command passed over: {size} values, {self.torque.size} expected'
            return False
        if not np.isfinite(torque).all():
            self.not_finite += 1
            broken = [
                name
                for name, value in zip(self._joints, torque, strict=True)
                if not np.isfinite(value)
            ]
            self.complaint = f'command passed over: not finite: {torque} (for {", ".join(broken)})'
            return False
        self.torque[:] = torque
        self._taken_at = sample
        return True

    def is_stale(self, sample: int, limit: int) -> bool:
        """Whether the torque is older than `limit` samples at `sample`; counted if so."""
        stale = sample - self._taken_at > limit
        self.stale_steps += stale
        return stale

    def restart(self) -> None:
        """Forget the torque; sample 0 comes next."""
        self.torque[:] = 0.0
        self._taken_at = 0

    def renew(self, sample: int) -> None:
        """Count the age of the torque from `sample` on."""
        self._taken_at = sample
