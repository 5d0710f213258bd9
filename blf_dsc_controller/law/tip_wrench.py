# SPDX-License-Identifier: Apache-2.0
"""Wrench at the tip that an external torque of the joints stands for, if it acts there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.urdf import Chain, frames
from blf_dsc_controller.compiled.algebra import inverse, product

Floats = NDArray[np.float64]

_USUAL = np.array((100.0,) * 3 + (20.0,) * 3)
"""Standard deviations of a wrench [N, N m] before it is seen.

They decide where the joints do not show it, as in a singular posture.
"""


class TipWrench:
    """The most likely force and moment at the tip of a chain."""

    def __init__(self, chain: Chain) -> None:
        self.chain = chain

    def jacobian(self, q: Floats) -> Floats:
        """Return J (6, n) at positions q (n,): velocity and turn of the tip, in its axes."""
        placements = frames(self.chain, q)
        tip = placements[-1]
        columns = []
        for joint, placement in zip(self.chain.joints, placements[1:-1], strict=True):
            axis = placement[:3, :3] @ joint.axis
            if joint.kind == 'prismatic':
                columns.append(np.concatenate((axis, np.zeros(3))))
            else:
                arm = tip[:3, 3] - placement[:3, 3]
                columns.append(np.concatenate((np.cross(axis, arm), axis)))
        rows = np.transpose(columns).reshape(2, 3, -1)
        return np.concatenate([product(tip[:3, :3].T, each) for each in rows])

    def of(self, q: Floats, torque: Floats, interval: Floats) -> Floats:
        """Return force [N] and moment [N m] (6,) at the tip, in its axes.

        `torque` (n,) [N m] is the external torque at positions q (n,), `interval` (n,) its
        uncertainty: joints that are known better count more.
        """
        J = self.jacobian(q)
        weighted = J / interval**2
        usual = np.diag(1.0 / _USUAL**2)
        found = product(
            inverse(product(weighted, J.T) + usual),
            (weighted * torque).sum(axis=1)[:, np.newaxis],
        )
        return np.asarray(found[:, 0])
