# SPDX-License-Identifier: Apache-2.0
"""New references while the controller runs: trajectories, streams of targets, stops.

They come as the messages of `~/joint_trajectory` and `~/joint_positions`, by `~/stop`
and by the goals of the action, whoever receives them. Every rejection has a reason.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.control.log import Log
from blf_dsc_controller.messages.codecs import (
    Float64MultiArrayDecoder,
    joint_trajectory,
)
from blf_dsc_controller.messages.errors import MessageError
from blf_dsc_controller.messages.topics import JOINT_POSITIONS, JOINT_TRAJECTORY
from blf_dsc_controller.reference.retargeting import (
    Target,
    TrajectoryError,
    can_retarget,
)
from blf_dsc_controller.reference.stream import TargetStream
from blf_dsc_controller.reference.trajectory import (
    MOST_POINTS,
    Trajectory,
    TrajectoryPoint,
    trajectory_problems,
)
from blf_dsc_controller.reference.turns import short_way
from blf_dsc_controller.run import NANOSECOND
from blf_dsc_controller.supervision.guard import Guard
from blf_dsc_controller.supervision.motions import LatePlanError, Plan

# bytes per joint of a point with all its fields, each with a header of 8 bytes
_POINT_SIZE = 32
_SMALL = 4096  # bytes of a message that is read at once: a few points
_LEAD = 0.02  # s from now to the time for which a trajectory is planned, at first
_TARGET_LEAD = 0.004  # likewise for a target
_LONGEST_LEAD = 2.0
_STREAM_TIMEOUT = 0.25  # s without a new target, after which the reference brakes
_PAUSE = 1.0  # s without messages, after which a stopped sender is followed again
_RARELY = 1.0  # s between two warnings of a stream
_ON_TRAJECTORY = JOINT_TRAJECTORY.name
_ON_POSITIONS = JOINT_POSITIONS.name
_REPLACED = 'a newer one arrived before it was planned'

Command = Trajectory | Target
Report = Callable[[Plan | None, str], None]
"""Called with the plan that is followed, or with None and why none is."""


class _Request(NamedTuple):
    """A motion that somebody asked for."""

    make: Callable[[], Command]  # may take a while: called where it is planned
    lead: float  # s
    source: str  # who asked for it
    report: Report = lambda *_: None  # to a client
    # raises TrajectoryError: not like this
    check: Callable[[Plan], None] = lambda _: None
    is_streamed: bool = False


class _Job(NamedTuple):
    """A motion that is being planned."""

    request: _Request
    plan: Future[Plan]


class MotionInput:
    """Passes motions to the guard, between two samples.

    In lock-step the plant waits while a motion is planned. A live one does not: it is
    planned in a thread, for a time slightly ahead, and further ahead if planning takes
    longer. The latest wins. Run the loop in `undisturbed_loop`, so that this thread yields.

    Attributes:
        accepted, rejected: number of trajectories that are or were followed, or are not.
        targets: number of targets of streams that are or were followed.
        reason: why the last one was rejected.
        source: what has set the present reference.
        job: the motion that is being planned, if any.
        log: takes warnings of what is not followed.
    """

    def __init__(
        self,
        joints: int,
        guard: Callable[[], Guard | None],
        is_live: Callable[[Guard], bool],
        log: Log,
    ) -> None:
        """Take motions of `joints` joints; `guard` returns None while there is none."""
        self.accepted = 0
        self.rejected = 0
        self.targets = 0
        self.reason = ''
        self.source = ''
        self.job: _Job | None = None
        self._next: _Request | None = None
        self.log = log
        self._largest = MOST_POINTS * _POINT_SIZE * (joints + 2)
        self._guard = guard
        self._is_live = is_live
        self._thread = ThreadPoolExecutor(1, 'trajectories')
        self._decoder = Float64MultiArrayDecoder(joints)
        self._positions = TargetStream()
        self._points = TargetStream()
        self._target_lead = _TARGET_LEAD
        self._is_stopped = False
        self._has_logged_turns = False
        self._last_message = -np.inf  # s since the start

    @property
    def values(self) -> dict[str, str]:
        """Values for the diagnostics."""
        return {
            'trajectories followed': f'{self.accepted}',
            'trajectories rejected': f'{self.rejected}',
            'streamed targets followed': f'{self.targets}',
            'last rejection': self.reason or 'none',
        }

    def poll(self, guard: Guard) -> None:
        """Follow the motion whose plan is ready, if there is one."""
        job = self.job
        if job is None or not job.plan.done():
            return
        self.job = None
        self._finish(guard, job)
        if self.job is None and self._next is not None:
            request, self._next = self._next, None
            self._submit(guard, request)

    def stop(self, guard: Guard, source: str) -> float:
        """Brake and hold; return when the reference rests [s since the start].

        Raises:
            TrajectoryError: the controller is not in command.
        """
        self._drop('the reference was stopped')
        for stream in (self._positions, self._points):
            stream.restart()
        end = guard.motions.brake()
        self.source = source
        return end

    def follow(
        self,
        guard: Guard,
        given: bytes | Callable[[], Trajectory],
        source: str,
        check: Callable[[Plan], None],
        report: Report,
    ) -> None:
        """Follow a trajectory that came by another way, serialised or still to be made."""
        start = guard.reference.start_stamp

        def make() -> Trajectory:
            return _trajectory(given, start) if isinstance(given, bytes) else given()

        self._request(guard, _Request(make, _LEAD, source, report, check))

    # Requests.

    def take_trajectory(self, raw: bytes) -> None:
        """Follow a message of `~/joint_trajectory`."""
        guard = self._guard()
        if guard is None:
            self._reject('trajectory rejected: the controller is not configured')
            return
        if self._ignore_after_stop(guard):
            return
        if len(raw) > self._largest:
            size = f'it has {len(raw)} bytes, more than {MOST_POINTS} points can have'
            self._reject(f'trajectory rejected: {size}: send it in pieces')
            return
        start = guard.reference.start_stamp
        if len(raw) > _SMALL:
            large = _Request(lambda: _trajectory(raw, start), _LEAD, _ON_TRAJECTORY)
            self._request(guard, large)
            return
        try:
            self._on_few_points(guard, _trajectory(raw, start))
        except MessageError as error:
            self._reject(_reason(error))

    def _on_few_points(self, guard: Guard, trajectory: Trajectory) -> None:
        """Stop without points, follow one that is near as a target of a stream."""
        if not trajectory.points:
            self._brake(guard)
            return
        command = self._target_of(guard, trajectory) or trajectory
        lead = self._target_lead if isinstance(command, Target) else _LEAD
        request = _Request(lambda: command, lead, _ON_TRAJECTORY)
        self._request(guard, request)

    def _target_of(self, guard: Guard, trajectory: Trajectory) -> Target | None:
        """Return a single point within the time-out as a target, otherwise None."""
        config = guard.config
        now = guard.reference.time
        point = trajectory.points[0]
        begin = now if trajectory.begin is None else trajectory.begin
        ahead = begin + point.time - now
        if (
            not can_retarget()
            or not guard.supervisor.running
            or len(trajectory.points) > 1
            or not 0.0 <= ahead <= _STREAM_TIMEOUT
            or trajectory_problems(trajectory, config.joints, now)
        ):
            return None
        order = [trajectory.joints.index(joint) for joint in config.joints]
        velocities = np.array(point.velocities)
        positions = np.array(point.positions)[order]
        return self._points.target(
            now,
            self._short_way(guard, self._points, positions),
            timeout=_STREAM_TIMEOUT,
            velocities=velocities[order] if velocities.size else None,
            ahead=ahead,
        )

    def take_positions(self, raw: bytes) -> None:
        """Follow a message of `~/joint_positions`."""
        guard = self._guard()
        if guard is None or self._ignore_after_stop(guard):
            return
        try:
            positions = self._read_positions(raw)
        except (MessageError, TrajectoryError) as error:
            self._reject(_reason(error))
            return
        self.stream(guard, positions, _ON_POSITIONS)

    def stream(self, guard: Guard, positions: np.ndarray, source: str) -> None:
        """Follow the next positions (n,) [rad] of a stream."""
        target = self._positions.target(
            guard.reference.time,
            self._short_way(guard, self._positions, positions),
            timeout=_STREAM_TIMEOUT,
        )
        lead = self._target_lead
        self._request(guard, _Request(lambda: target, lead, source, is_streamed=True))

    def _short_way(
        self, guard: Guard, stream: TargetStream, positions: np.ndarray
    ) -> np.ndarray:
        """Return positions (n,) [rad] nearest to the last ones of a stream, or the reference."""
        config = guard.config
        near = stream.last(guard.reference.time, _STREAM_TIMEOUT)
        if near is None:
            near = guard.controller.reference_at(guard.reference.time)[0]
        (shifted,), turned = short_way(positions[np.newaxis], near, config)
        self._log_turns(turned)
        return np.asarray(shifted)

    def _log_turns(self, turned: str) -> None:
        """Say once that motions are shifted by whole turns."""
        if turned and not self._has_logged_turns:
            self._has_logged_turns = True
            self.log.info(f'a motion {turned}; others are shifted likewise')

    def _read_positions(self, raw: bytes) -> np.ndarray:
        size = self._decoder.decode(raw)
        positions: np.ndarray = self._decoder.values.copy()
        if size != positions.size:
            raise TrajectoryError(
                [f'it has {size} positions for {positions.size} joints']
            )
        if not np.isfinite(positions).all():
            raise TrajectoryError([f'its positions are {positions.tolist()}'])
        return positions

    def take_stop(self) -> str:
        """Stop, and return what happens, in words.

        What keeps on arriving on the topics is ignored until it pauses.
        """
        guard = self._guard()
        self._is_stopped = True
        ignored = f'topics are ignored until they pause for {_PAUSE:g} s'
        if guard is None or not guard.supervisor.running:
            return f'the controller is not in command: nothing to stop; once it is, {ignored}'
        self._last_message = guard.reference.time
        left = self.stop(guard, '~/stop') - guard.reference.time
        text = f'braking for {left:.3g} s; {ignored}'
        self.log.info(text)
        return text

    def _ignore_after_stop(self, guard: Guard) -> bool:
        """Ignore a message of a sender that has not paused since `~/stop`; return whether it is.

        What arrives while the law is not in command has another reason to be rejected.
        """
        pause = guard.reference.time - self._last_message
        self._last_message = guard.reference.time
        if not guard.supervisor.running:
            return False
        if self._is_stopped and 0.0 <= pause < _PAUSE:
            self.log.warning(
                f'ignored after ~/stop, until messages pause for {_PAUSE:g} s',
                throttle_duration_sec=_RARELY,
            )
            return True
        self._is_stopped = False
        return False

    def _brake(self, guard: Guard) -> None:
        try:
            self.stop(guard, _ON_TRAJECTORY)
        except TrajectoryError as error:
            self._reject(_reason(error))
            return
        self.accepted += 1
        self.log.info('stopping: a trajectory without points arrived')

    # Plans.

    def _request(self, guard: Guard, request: _Request) -> None:
        """Plan a motion and follow it, now or as soon as the one before is planned."""
        if not self._is_live(guard):
            try:
                self._adopt(guard, guard.motions.plan(request.make()), request)
            except Exception as error:  # noqa: BLE001 - the current reference continues
                self._report(request, None, _reason(error))
        elif self.job is None:
            self._submit(guard, request)
        else:
            self._drop_next(_REPLACED)
            self._next = request

    def _submit(self, guard: Guard, request: _Request) -> None:
        at = guard.reference.time + request.lead

        def plan() -> Plan:
            return guard.motions.plan(request.make(), at)

        self.job = _Job(request, self._thread.submit(plan))

    def _finish(self, guard: Guard, job: _Job) -> None:
        request = job.request
        try:
            self._adopt(guard, job.plan.result(), request)
        except LatePlanError as error:
            if request.lead > _LONGEST_LEAD:
                self._report(request, None, _reason(error))
                return
            lead = 2.0 * request.lead
            if request.lead == self._target_lead < _LEAD:
                self._target_lead = lead
            if self._next is None:
                self._submit(guard, request._replace(lead=lead))
            else:
                self._report(request, None, _REPLACED)
        except Exception as error:  # noqa: BLE001 - the current reference continues
            self._report(request, None, _reason(error))

    def _adopt(self, guard: Guard, plan: Plan, request: _Request) -> None:
        request.check(plan)
        guard.motions.adopt(plan)
        self.source = request.source
        self._report(request, plan, '')

    def _drop(self, reason: str) -> None:
        """Drop what is being planned."""
        if self.job is not None:
            self._report(self.job.request, None, reason)
            self.job = None
        self._drop_next(reason)

    def _drop_next(self, reason: str) -> None:
        if self._next is not None:
            self._report(self._next, None, reason)
            self._next = None

    # Reports.

    def _report(self, request: _Request, plan: Plan | None, reason: str) -> None:
        """Count and log what was sent, and report it to its client.

        In a stream the latest target wins, which is no rejection.
        """
        if plan is None:
            if not (request.is_streamed and reason == _REPLACED):
                self._reject(reason)
        elif isinstance(plan.command, Target):
            self.targets += 1
        else:
            self.accepted += 1
            count = len(plan.command.points)
            points = '1 point' if count == 1 else f'{count} points'
            note = f' {plan.motion.note}' if plan.motion.note else ''
            self.log.info(f'following a trajectory of {points}{note}')
            self._log_turns(plan.motion.turned)
        request.report(plan, reason)

    def _reject(self, reason: str) -> None:
        self.rejected += 1
        if reason == self.reason:  # a stream may repeat it at its rate
            self.log.warning(reason, throttle_duration_sec=_RARELY)
        else:
            self.log.warning(reason)
        self.reason = reason


def _reason(error: Exception) -> str:
    if isinstance(error, TrajectoryError):
        return f'{error}'
    return f'trajectory rejected: {type(error).__name__}: {error}'


def _trajectory(raw: bytes, start_stamp: int) -> Trajectory:
    """Return a message's trajectory, in times since the controller's start."""
    stamp, names, points = joint_trajectory(raw)
    begin = (stamp - start_stamp) * NANOSECOND if stamp else None
    own = (TrajectoryPoint(time * NANOSECOND, *arrays) for time, arrays in points)
    return Trajectory(names, tuple(own), begin)
