# SPDX-License-Identifier: Apache-2.0
"""A trajectory planned ahead, beside the loop, and what must still hold when it is followed."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from blf_dsc_controller.reference.approach import Motion
from blf_dsc_controller.reference.trajectory import Trajectory, TrajectoryError


class LatePlanError(TrajectoryError):
    """The time from which on a trajectory was to be followed has passed while it was planned."""

    def __init__(self, at: float, now: float) -> None:
        super().__init__([f'it was to begin at {at:.6g} s and was planned at {now:.6g} s'])


class Plan(NamedTuple):
    """A planned trajectory."""

    trajectory: Trajectory
    at: float  # s since the start, from which on it has an effect
    before: np.ndarray  # packed reference that it continues
    motion: Motion

    @property
    def content(self) -> dict[str, Any]:
        """Content of its event in the journal."""
        joints, points, begin = self.trajectory
        given = [point._asdict() for point in points]
        return {'joints': joints, 'points': given, 'begin': begin, 'at': self.at}
