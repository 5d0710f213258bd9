# SPDX-License-Identifier: Apache-2.0
"""A motion planned beside the loop, to be adopted between two samples."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.messages.journal import trajectory_content
from blf_dsc_controller.reference.retargeting import (
    PlannedMotion,
    Target,
    TrajectoryError,
    plan_target,
    state_at,
)
from blf_dsc_controller.reference.trajectory import Trajectory, plan_trajectory


class LatePlanError(TrajectoryError):
    """The time at which a trajectory should take effect passed while it was planned."""


class Plan(NamedTuple):
    """A planned trajectory, or a target of a stream."""

    command: Trajectory | Target
    at: float  # s since the start, when it takes effect
    before: np.ndarray  # packed reference that it continues
    motion: PlannedMotion
    content: dict[str, Any]  # of its event

    def check(self, reference_vector: np.ndarray, now: float) -> None:
        """Check that a loop with this packed reference can still adopt it now [s].

        Raises:
            LatePlanError: it begins in the past.
            TrajectoryError: it continues another reference.
        """
        if self.before is not reference_vector:
            raise TrajectoryError(
                ['the reference was replaced while it was planned: send it again']
            )
        if self.at < now:
            due = f'it should begin at {self.at:.6g} s'
            raise LatePlanError([f'{due}, but was planned only at {now:.6g} s'])


def plan_motion(
    command: Trajectory | Target,
    before: np.ndarray,
    at: float,
    config: ControllerConfig,
) -> Plan:
    """Return the plan that continues a packed reference from the time `at` [s] on.

    It uses `limits.scale` of the limits.

    Raises:
        TrajectoryError: it cannot be followed.
    """
    config = _scaled(config, command, before, at)
    if isinstance(command, Trajectory):
        motion = plan_trajectory(command, before, at, config)
        joints, points, begin = command
        given = [point._asdict() for point in points]
        content: dict[str, Any] = trajectory_content(joints, given, begin, at)
    else:
        motion = plan_target(command, before, at, config)
        content = {**command._asdict(), 'at': at}
    return Plan(command, at, before, motion, content)


def _scaled(
    config: ControllerConfig,
    command: Trajectory | Target,
    before: np.ndarray,
    at: float,
) -> ControllerConfig:
    """Return the configuration with the limits of a motion that begins then."""
    if config.limits.scale == 1.0:
        return config
    begin = at
    if isinstance(command, Trajectory) and command.begin is not None:
        begin = max(at, command.begin)
    limits = config.limits.scaled(state_at(before, begin))
    return replace(config, limits=limits)
