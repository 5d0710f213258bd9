# SPDX-License-Identifier: Apache-2.0
"""Motions that are commanded while the law is in command: planned, followed, braked."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.messages.journal import EventType, trajectory_content
from blf_dsc_controller.reference.retargeting import (
    PlannedMotion,
    Target,
    TrajectoryError,
    plan_target,
    state_at,
)
from blf_dsc_controller.reference.trajectory import Trajectory, plan_trajectory
from blf_dsc_controller.supervision.contact import Contacts
from blf_dsc_controller.supervision.in_command import InCommand
from blf_dsc_controller.supervision.supervisor import Phase


class LatePlanError(TrajectoryError):
    """The time at which a trajectory should take effect passed while it was planned."""


class Plan(NamedTuple):
    """A planned trajectory, or a target of a stream."""

    command: Trajectory | Target
    at: float  # s since the start, when it takes effect
    before: np.ndarray  # packed reference that it continues
    motion: PlannedMotion
    content: dict[str, Any]  # of its event

    def check(self, reference_vector: np.ndarray, t: float) -> None:
        """Check that a loop with this packed reference can still adopt it at t [s].

        Raises:
            LatePlanError: it begins in the past.
            TrajectoryError: it continues another reference.
        """
        if self.before is not reference_vector:
            raise TrajectoryError(
                ['the reference was replaced while it was planned: send it again']
            )
        if self.at < t:
            due = f'it should begin at {self.at:.6g} s'
            raise LatePlanError([f'{due}, but was planned only at {t:.6g} s'])


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
        contents = [point._asdict() for point in points]
        content: dict[str, Any] = trajectory_content(joints, contents, begin, at)
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


class Motions:
    """The motions of one arm."""

    def __init__(self, command: InCommand, contacts: Contacts) -> None:
        """Move the arm of `command`; it holds after some of its contacts."""
        self._command = command
        self._contacts = contacts

    def plan(self, motion: Trajectory | Target, at: float | None = None) -> Plan:
        """Plan a motion, in any thread, to `adopt` by the time `at` [s] (now).

        Raises:
            TrajectoryError: it cannot be followed.
        """
        command = self._command
        command.check_running()
        at = command.reference.time if at is None else at
        before = command.controller.reference_vector
        return plan_motion(motion, before, at, command.config)

    def adopt(self, planned: Plan) -> None:
        """Follow a planned motion.

        Raises:
            LatePlanError: it begins in the past.
            TrajectoryError: it does not continue the current reference, which stays in force, or
                it is a target and the arm holds after a contact.
        """
        command, reference = self._command, self._command.reference
        command.check_running()
        planned.check(command.controller.reference_vector, reference.time)
        if isinstance(planned.command, Target):
            self._contacts.check_target()
            command.note(EventType.TARGET, **planned.content)
            reference.follow(planned.motion.vector)
            return
        command.end_silence()
        command.journal.add(EventType.TRAJECTORY, planned.content)
        reference.follow(planned.motion.vector)
        self._contacts.hold = False
        reference.settled = planned.motion.settled
        is_settled = reference.settled <= reference.time
        command.supervisor.enter(Phase.TRACKING if is_settled else Phase.APPROACHING)

    def brake(self) -> float:
        """Bring the reference to rest within the limits; return when it rests [s].

        Raises:
            TrajectoryError: the controller is not in command.
        """
        command = self._command
        command.check_running()
        command.note(EventType.BRAKE)
        return command.reference.brake(command.config)
