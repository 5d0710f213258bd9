# SPDX-License-Identifier: Apache-2.0
"""Motions that are commanded while the law is in command: planned, followed, braked."""

from __future__ import annotations

from blf_dsc_controller.messages.journal import EventType
from blf_dsc_controller.reference.retargeting import Target
from blf_dsc_controller.reference.trajectory import Trajectory
from blf_dsc_controller.supervision.contact import Contacts
from blf_dsc_controller.supervision.in_command import InCommand
from blf_dsc_controller.supervision.plan import Plan, plan_motion
from blf_dsc_controller.supervision.supervisor import Phase


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
            TrajectoryError: it does not continue the current reference, which stays in force.
        """
        command, reference = self._command, self._command.reference
        command.check_running()
        planned.check(command.controller.reference_vector, reference.time)
        if isinstance(planned.command, Target):
            self._adopt_target(planned)
            return
        command.end_silence()
        command.journal.add(EventType.TRAJECTORY, planned.content)
        reference.follow(planned.motion.vector)
        self._contacts.hold = False
        reference.settled = planned.motion.settled
        is_settled = reference.settled <= reference.time
        command.supervisor.enter(Phase.TRACKING if is_settled else Phase.APPROACHING)

    def _adopt_target(self, planned: Plan) -> None:
        """Follow a target; raise TrajectoryError if the arm holds after a contact."""
        self._contacts.check_target()
        self._command.note(EventType.TARGET, **planned.content)
        self._command.reference.follow(planned.motion.vector)

    def brake(self) -> float:
        """Bring the reference to rest within the limits; return when it rests [s].

        Raises:
            TrajectoryError: the controller is not in command.
        """
        command = self._command
        command.check_running()
        command.note(EventType.BRAKE)
        return command.reference.brake(command.config)
