# SPDX-License-Identifier: Apache-2.0
"""Goals of the action `~/follow_joint_trajectory`, from acceptance to result.

They become trajectories like those of the topic. The newest motion wins, whoever sent
it: a goal ends when its trajectory is no longer the reference. What clients see is
`action_server`'s.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from blf_dsc_controller.control.goal_messages import (
    GOAL_VIOLATED,
    INVALID,
    PATH_VIOLATED,
    SUCCESSFUL,
    Answer,
    Cancel,
    End,
    Feedback,
    Goal,
    Message,
    Outcome,
)
from blf_dsc_controller.control.goal_tolerances import Tolerances, tolerances
from blf_dsc_controller.control.log import Log
from blf_dsc_controller.control.motion_input import MotionInput
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.reference.retargeting import TrajectoryError
from blf_dsc_controller.reference.trajectory import Trajectory
from blf_dsc_controller.supervision.guard import Guard
from blf_dsc_controller.supervision.motions import Plan
from blf_dsc_controller.supervision.supervisor import Reason

_FEEDBACK_PERIOD = 0.05  # s
_SOURCE = 'a goal'


class _Followed(NamedTuple):
    """A goal that is followed."""

    goal: Goal
    path: Tolerances
    arrival: Tolerances
    begin: float  # s since the start
    end: float  # s, when the reference is at the last point
    latest: float  # s, when the arm must be there; inf: ever
    note: str
    vector: np.ndarray  # packed reference


class Goals:
    """Follows the goals of one action, the newest one.

    `poll` never waits: what it cannot do between two samples is done by others.
    """

    def __init__(
        self,
        inputs: MotionInput,
        joints: Sequence[str],
        send: Callable[[Any], None],
        log: Log,
    ) -> None:
        """Follow through `inputs`; `send` passes a message to the clients' side."""
        self._inputs = inputs
        self._joints = joints
        self._send = send
        self._log = log
        self._followed: _Followed | None = None
        self._next_feedback = 0.0

    def take(self, guard: Guard | None, message: Message) -> None:
        """Begin or cancel the goal of a client."""
        if isinstance(message, Cancel):
            self._cancel(guard, message.number)
        elif not isinstance(message, Goal):
            return
        elif guard is None:
            reason = 'the controller is not configured'
            self._log.warning(f'goal rejected: {reason}')
            self._send(Answer(message.number, accepted=False, reason=reason))
        else:
            self.follow(guard, message, message.trajectory)

    def follow(
        self,
        guard: Guard,
        goal: Goal,
        trajectory: bytes | Callable[[], Trajectory],
        by: str = _SOURCE,
    ) -> None:
        """Begin a goal of a client whose trajectory came by another way."""
        self._inputs.follow(
            guard,
            trajectory,
            by,
            partial(_check_time, goal),
            partial(self._on_plan, guard, goal),
        )

    def watch(self, guard: Guard | None) -> None:
        """Compare the arm with the reference, after each sample and in a silence."""
        followed = self._followed
        if followed is None:
            return
        if guard is None or not guard.supervisor.running:
            self._end(Outcome.ABORTED, *_why_out_of_command(guard))
        elif guard.controller.reference_vector is not followed.vector:
            by = self._inputs.source or 'a reset'
            if guard.findings.contacts.hold:
                by = 'a contact'
            self._end(Outcome.ABORTED, INVALID, f'pre-empted by {by}')
        elif guard.has_sample:
            self._watch_sample(guard, followed)

    def close(self) -> None:
        """End the goal, since the node ends."""
        if self._followed is not None:
            self._end(Outcome.ABORTED, INVALID, 'the controller ends')

    def _on_plan(
        self, guard: Guard, goal: Goal, plan: Plan | None, reason: str
    ) -> None:
        """Accept the goal whose trajectory is the reference now, or reject it."""
        self._send(Answer(goal.number, accepted=plan is not None, reason=reason))
        if plan is None:
            return
        if self._followed is not None:
            self._end(Outcome.ABORTED, INVALID, 'pre-empted by another goal')
        self._inputs.source = ''
        path, arrival = self._tolerances(goal)
        self._followed = _Followed(
            goal,
            path,
            arrival,
            _begin(plan),
            plan.motion.end,
            _last_point(plan) + goal.time if goal.time > 0.0 else np.inf,
            plan.motion.note,
            guard.controller.reference_vector,
        )
        self._next_feedback = guard.reference.time

    def _tolerances(self, goal: Goal) -> tuple[Tolerances, Tolerances]:
        """Return those of the path and at the end; the defaults if any is wrong."""
        try:
            return tolerances(self._joints, goal.path), tolerances(
                self._joints, goal.goal
            )
        except BlfDscError as error:
            self._log.error(f'{error}; the goal has the default tolerances')
            return tolerances(self._joints, ()), tolerances(self._joints, ())

    def _watch_sample(self, guard: Guard, followed: _Followed) -> None:
        """End the goal if the arm has arrived, or has left its path or tolerances."""
        signals = guard.controller.signals
        t = guard.reference.time
        if t >= self._next_feedback:
            self._next_feedback = t + _FEEDBACK_PERIOD
            self._send_feedback(guard, followed)
        error = np.stack((signals.xi1, signals.dq - signals.dqr))
        tolerated = followed.arrival if t >= followed.end else followed.path
        violation = ''
        if t >= followed.begin:
            violation = tolerated.violation(guard.config, error, signals.bound)
        if t < followed.end:
            if violation:
                self._abort(guard, PATH_VIOLATED, f'off the path: {violation}')
        elif not violation:
            note = f', {followed.note}' if followed.note else ''
            self._end(Outcome.SUCCEEDED, SUCCESSFUL, f'goal reached{note}')
        elif t > followed.latest:
            late = t - followed.latest
            text = f'not there {followed.goal.time:.3g} s after the end: {violation}'
            self._abort(guard, GOAL_VIOLATED, f'{text} ({late:.3g} s late)')

    def _send_feedback(self, guard: Guard, followed: _Followed) -> None:
        """Send the client where the arm is, and where it should be."""
        signals = guard.controller.signals
        desired = [each.tolist() for each in (signals.qr, signals.dqr, signals.ddqr)]
        actual = [signals.q.tolist(), signals.dq.tolist()]
        reference = guard.reference
        since = reference.time - followed.begin
        number = followed.goal.number
        self._send(Feedback(number, reference.last_stamp, since, desired, actual))

    def _cancel(self, guard: Guard | None, number: int) -> None:
        followed = self._followed
        if followed is None or followed.goal.number != number:
            return  # it has ended meanwhile, and its result is on the way
        text = 'cancelled'
        if (
            guard is not None
            and guard.supervisor.running
            and guard.controller.reference_vector is followed.vector
        ):
            left = self._inputs.stop(guard, 'a cancel') - guard.reference.time
            text = f'cancelled: braking for {left:.3g} s'
        self._end(Outcome.CANCELLED, SUCCESSFUL, text)

    def _abort(self, guard: Guard, code: str, text: str) -> None:
        """Brake and hold."""
        self._inputs.stop(guard, 'an abort')
        self._end(Outcome.ABORTED, code, text)

    def _end(self, outcome: Outcome, code: str, text: str) -> None:
        assert self._followed is not None  # noqa: S101 - for mypy
        number = self._followed.goal.number
        self._followed = None
        self._send(End(number, outcome, code, text))
        self._log.info(f'goal {outcome.value}: {text}')


def _why_out_of_command(guard: Guard | None) -> tuple[str, str]:
    """Return code and text of a goal that nobody follows any more."""
    if guard is None:
        return INVALID, 'the controller is not configured any more'
    supervisor = guard.supervisor
    code = PATH_VIOLATED if supervisor.reason is Reason.OUTSIDE_BOUND else INVALID
    why = supervisor.text or supervisor.phase
    return code, f'the controller is not in command any more: {why}'


def _begin(plan: Plan) -> float:
    """Return when a trajectory begins [s since the start]."""
    command = plan.command
    if isinstance(command, Trajectory) and command.begin is not None:
        return command.begin
    return plan.at


def _last_point(plan: Plan) -> float:
    """Return when the last point was to be reached [s since the start]."""
    command = plan.command
    assert isinstance(command, Trajectory)  # noqa: S101 - goals are trajectories
    return _begin(plan) + command.points[-1].time


def _check_time(goal: Goal, plan: Plan) -> None:
    """Reject what the limits stretch past the time of a goal: it would end in an abort.

    Raises:
        TrajectoryError: it would end too late.
    """
    late = plan.motion.end - _last_point(plan)
    if 0.0 < goal.time < late:
        reason = f'within the limits it ends {late:.3g} s later than asked for'
        allowed = f'goal_time_tolerance allows {goal.time:.3g} s'
        raise TrajectoryError([f'{reason}, and {allowed}'])
