# SPDX-License-Identifier: Apache-2.0
"""Wrench at the tip that an external torque of the joints stands for, if it acts there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.urdf import Chain

Floats = NDArray[np.float64]

_USUAL = np.array((100.0,) * 3 + (20.0,) * 3)
"""Standard deviations of a wrench [N, N m] before it is seen.

They decide where the joints do not show it, as in a singular posture.
"""


def _cross(a: Floats, b: Floats) -> Floats:
    """Return a x b of rows (n, 3): np.cross takes ten times as long for a few."""
    return a[:, [1, 2, 0]] * b[:, [2, 0, 1]] - a[:, [2, 0, 1]] * b[:, [1, 2, 0]]


class TipWrench:
    """The most likely force and moment at the tip of a chain."""

    def __init__(self, chain: Chain) -> None:
        joints = chain.joints
        self._axis = np.array([joint.axis for joint in joints])
        self._turns = np.array([joint.kind != 'prismatic' for joint in joints])
        self._fixed = np.array([joint.placement for joint in joints])
        self._tip = chain.tip_placement
        # a turn by q about the axis: along + cos q across + sin q turned
        self._along = self._axis[:, :, np.newaxis] * self._axis[:, np.newaxis, :]
        self._across = np.eye(3) - self._along
        self._turned = np.cross(np.eye(3), self._axis[:, np.newaxis, :])

    def jacobian(self, q: Floats) -> Floats:
        """Return J (6, n) at positions q (n,): velocity and turn of the tip, in its axes."""
        turn = np.where(self._turns, q, 0.0)[:, np.newaxis, np.newaxis]
        motion = np.zeros((q.size, 4, 4))
        motion[:, :3, :3] = (
            self._along + np.cos(turn) * self._across + np.sin(turn) * self._turned
        )
        motion[:, :3, 3] = np.where(self._turns, 0.0, q)[:, np.newaxis] * self._axis
        motion[:, 3, 3] = 1.0
        placements = self._fixed @ motion
        for i in range(1, q.size):
            placements[i] = placements[i - 1] @ placements[i]
        tip = placements[-1] @ self._tip
        axes = (placements[:, :3, :3] @ self._axis[:, :, np.newaxis])[:, :, 0]
        arms = tip[:3, 3] - placements[:, :3, 3]
        turns = self._turns[:, np.newaxis]
        moves = np.where(turns, _cross(axes, arms), axes)
        rows = moves @ tip[:3, :3], np.where(turns, axes, 0.0) @ tip[:3, :3]
        J: Floats = np.hstack(rows).T
        return J

    def of(self, q: Floats, torque: Floats, interval: Floats) -> Floats:
        """Return force [N] and moment [N m] (6,) at the tip, in its axes.

        `torque` (n,) [N m] is the external torque at positions q (n,), `interval` (n,)
        its uncertainty: joints that are known better count more.
        """
        J = self.jacobian(q)
        weighted = J / interval**2
        usual = np.diag(1.0 / _USUAL**2)
        found: Floats = np.linalg.solve(weighted @ J.T + usual, weighted @ torque)
        return found
