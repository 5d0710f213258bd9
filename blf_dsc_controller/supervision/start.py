# SPDX-License-Identifier: Apache-2.0
"""Where the law can take over, and a start that was planned before the first state."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.errors import StartError
from blf_dsc_controller.reference.approach import (
    AT_REST,
    BlendedReference,
    check_takeover,
    plan_start,
)

Vector = NDArray[np.float64]
_SAME_PLACE = 0.05  # of the bound


class PreparedStart(NamedTuple):
    """A start that was planned before the first state."""

    positions: Vector  # rad, from which it begins at rest
    motion: BlendedReference

    def fits(
        self, config: ControllerConfig, bound: Vector, q: Vector, dq: Vector
    ) -> bool:
        """Whether it can be used for an arm at q (n,) [rad] with dq (n,) [rad/s].

        The bound (n,) [rad] is the one at the start.
        """
        moved = np.abs(q - self.positions)
        if not np.all(moved < _SAME_PLACE * np.array(config.barrier.bound)):
            return False
        if np.abs(dq).max() > AT_REST:
            return False
        return can_take_over(config, bound, q, dq, self.motion.vector, 0.0)


def prepared_start(
    config: ControllerConfig, bound: Vector, positions: Vector
) -> PreparedStart:
    """Return the start from rest at `positions` (n,) [rad] inside `bound`.

    Raises:
        StartError: the law cannot take over there.
        MotionError: no approach from there keeps the limits.
    """
    motion = plan_start(config, bound, positions, np.zeros(positions.size))
    return PreparedStart(np.array(positions), motion)


def can_take_over(
    config: ControllerConfig,
    bound: Vector,
    q: Vector,
    dq: Vector,
    reference_vector: Vector,
    t: float,
) -> bool:
    """Whether the law can take over at time t [s]: `check_takeover` as an answer."""
    try:
        check_takeover(config, bound, q, dq, reference_vector, t)
    except StartError:
        return False
    return True
