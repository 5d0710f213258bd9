# SPDX-License-Identifier: Apache-2.0
"""The controller with its supervisor: for every joint state a torque that is safe to apply.

joint state -> [check] -> law -> [check] -> torque
                  |                 |
                  +-- safe torque <-+    until the next reset or activation
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from math import inf
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import flatten
from blf_dsc_controller.errors import BlfDscError, StartError
from blf_dsc_controller.law.factory import begin, controller_of
from blf_dsc_controller.messages.cdr import (
    DuplicatedJointError,
    MessageError,
    MissingJointError,
    ShortArrayError,
)
from blf_dsc_controller.messages.journal import EventType, Journal
from blf_dsc_controller.reference.approach import check_takeover
from blf_dsc_controller.reference.limits import MotionError, limits_of
from blf_dsc_controller.reference.trajectory import Trajectory, TrajectoryError
from blf_dsc_controller.supervision import checks, retuning
from blf_dsc_controller.supervision.planning import Plan, plan
from blf_dsc_controller.supervision.safe_torque import (
    LastState,
    Ramp,
    limit_first_torque,
    safe_torque,
)
from blf_dsc_controller.supervision.supervisor import Phase, Reason, Supervisor, Verdict
from blf_dsc_controller.supervision.velocity import Velocity
from blf_dsc_controller.supervision.watchdogs import PERIOD, Silence, why_unwatched

Vector = NDArray[np.float64]
_NANO = 1e-9

_REASONS: dict[type[MessageError], Reason] = {
    MissingJointError: Reason.JOINT_MISSING,
    DuplicatedJointError: Reason.JOINT_DUPLICATED,
    ShortArrayError: Reason.FIELD_MISSING,
}


class Guard:
    """A controller that stops by itself; it notes every event in its journal.

    `update`, `reject`, `watch` and `fail` return the torque (n,) [N m] to command, or None.

    Attributes:
        config: in force.
        controller: the law.
        supervisor: phase, and the reason of a stop.
        journal: events, and what has been processed so far.
        has_sample: whether the law used the last message, so that there is new telemetry.
        start_error: why the law could not start; None if it could.
        foreign: messages ignored because they name none of the joints.
        ratio: largest |xi1| / k_c of each joint since the start (n,).
        outside: samples past the bound since the start.
        start_stamp: of t = 0 [ns]; -1 before the first start.
        last_stamp: of the last sample of the law [ns].
        settled: end of the approach or of a mixed-in trajectory [s].
        compute_time: of the last sample [s].
        watching: whether a silence on the steady clock leads to a stop.
        unwatched: why it does not although safety.watchdog is `auto`; empty if it does.
        watchdog_torques: commanded by the watchdog since the last message.
    """

    def __init__(
        self,
        config: ControllerConfig,
        steady: Callable[[], int] = time.monotonic_ns,
        wall: Callable[[], int] = time.time_ns,
    ) -> None:
        """Compile the law; `steady` and `wall` are the clocks [ns]."""
        n = len(config.joints)
        self.config = config
        self.controller = controller_of(config)
        self.supervisor = Supervisor(config.joints, config.sample_time, self._on_stop)
        self.journal = Journal()
        self.has_sample = False
        self.start_error: BlfDscError | None = None
        self.foreign = 0
        self.ratio = np.zeros(n)
        self.outside = 0
        self.start_stamp = -1
        self.last_stamp = -1
        self.settled = 0.0
        self.compute_time = 0.0
        self.watching = False
        self.unwatched = ''
        self.watchdog_torques = 0
        self._steady = steady
        self._wall = wall
        self._silence = Silence()
        self._velocity = Velocity(config.safety.velocity, n)
        self._ramp = Ramp(n)
        self._torque = np.zeros(n)
        self._learns_from_effort = config.learning.torque_source == 'effort'
        self._kept = np.zeros(self.controller.settings.m + n)  # estimates of the last valid sample
        self._clean = True  # whether the window holds valid samples only
        self._resumable = False
        self._last_state = LastState(n)
        self._keep()
        self.journal.note(EventType.CONFIGURE, parameters=flatten(config))

    @property
    def commanding(self) -> bool:
        """Whether a torque has been commanded since the controller was configured."""
        return self.journal.commands > 0

    @property
    def time(self) -> float:
        """Time of the last sample of the law [s]."""
        return self._time_of(self.last_stamp)

    @property
    def checked(self) -> tuple[Vector, Vector]:
        """What `checks.check_sample` updates."""
        return self.ratio, self._kept

    # From here on: what the operator does.

    def activate(self) -> None:
        """Take command with the next state; estimates are kept if so configured."""
        self._note(EventType.ACTIVATE)
        if not self.config.safety.keep_estimates:
            self.controller.reset()
            self._resumable = False  # t counts the window's filling, too
        elif self._clean:
            self.controller.state.samples[0] = 0.0
        else:  # keep the estimates from before the fault, but not the window
            self.controller.reset()
            m = self.controller.settings.m
            self.controller.state.estimate[:] = self._kept[:m]
            self.controller.state.disturbance[:] = self._kept[m:]
        self._start_over()
        self._silence.restart(self._steady())

    def deactivate(self) -> None:
        """Leave command: the torque goes to the safe one on its ramp."""
        self._note(EventType.DEACTIVATE)
        was_running = self.supervisor.running
        self.supervisor.enter(Phase.INACTIVE)
        self._silence.restart(self._steady())
        self._resumable = was_running
        if was_running:
            self._ramp.begin(self._torque, self.config.safety.deactivation_ramp)

    def reset(self) -> None:
        """Forget all estimates and faults, and start with the next state."""
        self._note(EventType.RESET)
        self._resumable = False
        self.controller.reset()
        self._velocity.reset()
        self._keep()
        self._start_over()

    def follow(self, trajectory: Trajectory, at: float | None = None) -> None:
        """Follow another trajectory from the time `at` [s] on, by default at once.

        Raises:
            TrajectoryError: it cannot be followed; the present reference goes on.
        """
        self.adopt(self.planner(trajectory, at)())

    def planner(self, trajectory: Trajectory, at: float | None = None) -> Callable[[], Plan]:
        """Return what plans a trajectory, in any thread, for `adopt` until the time `at` [s].

        Both raise TrajectoryError.
        """
        self._check_in_command()
        before, limits = self.controller.reference_vector, limits_of(self.config)
        start = self.time if at is None else at
        return partial(plan, trajectory, before, start, limits)

    def adopt(self, planned: Plan) -> None:
        """Follow a planned trajectory.

        Raises:
            TrajectoryError: it does not continue the present reference, which goes on.
        """
        self._check_in_command()
        planned.check(self.controller.reference_vector, self.time)
        self._note(EventType.TRAJECTORY, **planned.content)
        motion = planned.motion
        self.controller.reference_vector = motion.vector
        self.settled = motion.settled
        is_settled = motion.settled <= self.time
        self.supervisor.enter(Phase.TRACKING if is_settled else Phase.APPROACHING)

    def _check_in_command(self) -> None:
        supervisor = self.supervisor
        if not supervisor.running:
            why = supervisor.text or supervisor.phase
            raise TrajectoryError([f'the controller is not in command: {why}'])

    def retune(self, config: ControllerConfig) -> None:
        """Put a configuration in force, between two samples."""
        before = flatten(self.config)
        changed = {key: value for key, value in flatten(config).items() if value != before[key]}
        self._note(EventType.PARAMETERS, parameters=changed)
        if self.supervisor.running:
            retuning.apply_bumpless(
                self.controller, config, self.time, self._last_state.measurement
            )
        else:
            retuning.apply(self.controller, config)
        self.config = config

    def problems(self, config: ControllerConfig) -> list[str]:
        """Why a configuration cannot be put in force now; empty if it can."""
        if not self.supervisor.running:
            return []
        return list(retuning.problems(self.controller, config, self.time))

    def _note(self, event: EventType, **content: Any) -> None:
        self.end_silence()
        self.journal.note(event, **content)

    def _time_of(self, stamp: int) -> float:
        return (stamp - self.start_stamp) * _NANO

    def _start_over(self) -> None:
        self.supervisor.enter(Phase.STARTING)
        self.start_error = None
        self.has_sample = False
        self.outside = 0
        self.ratio[:] = 0.0
        self._clean = True
        self._silence.restart()

    def _keep(self) -> None:
        state = self.controller.state
        m = self.controller.settings.m
        self._kept[:m] = state.estimate
        self._kept[m:] = state.disturbance

    # From here on: what comes from the arm.

    def update(self, stamp: int, measurement: Vector) -> Vector | None:
        """Return the torque for a joint state with its stamp [ns], None to command nothing.

        `measurement` is [q (n,) rad, dq (n,) rad/s, applied torque of the last interval (n,) N m].
        """
        self._begin_message()
        self.journal.stamp = stamp
        self._silence.restart(self._steady())
        n = self.ratio.size
        q, dq = measurement[:n], measurement[n : 2 * n]
        self._velocity.replace(stamp, q, dq)
        effort = measurement[2 * n :] if self._learns_from_effort else None
        verdict = self.supervisor.check_state(self.config.safety, stamp, q, dq, effort)
        if verdict is Verdict.SKIP:
            return None
        if verdict is Verdict.STOP:
            period, fastest = self.config.sample_time, self.config.safety.velocity_limit
            self._last_state.salvage(stamp, q, dq, fastest, period)
            return self._safe(period)
        self._last_state.take(stamp, measurement)
        if self.supervisor.phase is Phase.STARTING and not self._start(stamp, q, dq):
            return self._safe(self.config.sample_time) if self.commanding else None
        return self._control(stamp, measurement)

    def advance(self, stamp: int, measurement: Vector, count: int) -> None:
        """Go on to the state of a stamp [ns], the last of `count` that the law has used.

        There was nothing to object to in their samples, and they have updated `checked`.
        """
        self.journal.stamp = stamp
        self.journal.messages += count
        self.journal.commands += count
        self.has_sample = True
        self.last_stamp = stamp
        self._last_state.take(stamp, measurement)
        self._torque[:] = self.controller.state.torque
        self.supervisor.advance(stamp)
        if self.supervisor.phase is Phase.APPROACHING and self.time >= self.settled:
            self.supervisor.enter(Phase.TRACKING)

    def reject(self, error: MessageError) -> Vector | None:
        """Return the torque for an unreadable message, None if it is for another arm."""
        self._begin_message()
        names = error.names if isinstance(error, MissingJointError) else ()
        if names and not set(self.config.joints) & set(names):  # drivers may share joint_states
            self.foreign += 1
            return None
        self._silence.restart(self._steady())
        self.supervisor.stop(_REASONS.get(type(error), Reason.BAD_MESSAGE), str(error))
        return self._safe_without_state(self.config.sample_time)

    @property
    def next_watch(self) -> float:
        """Time [s] after which to `watch` again."""
        return self._silence.next_check

    def watch(self) -> Vector | None:
        """Check the steady clock, `next_watch` after the last time; a torque during a silence."""
        limit = self.config.sample_time + self.config.safety.state_timeout
        silent = self._silence.check(self._steady(), limit)
        if silent == 0.0 or not (self.watching and self.commanding):
            return None
        return self.time_out(f'no joint state has come for {silent:.3g} s')

    def time_out(self, text: str) -> Vector | None:
        """Return the torque of one watchdog period without a joint state."""
        self.has_sample = False
        if self.supervisor.phase is not Phase.STARTING:  # which waits for a state
            self.supervisor.stop(Reason.STATE_TIMEOUT, text)
        self.watchdog_torques += 1
        return self._safe_without_state(PERIOD)

    def end_silence(self) -> None:
        """Note how many torques the watchdog has commanded."""
        if self.watchdog_torques:
            self.journal.note(EventType.SILENCE, torques=self.watchdog_torques)
            self.watchdog_torques = 0

    def fail(self, text: str) -> Vector | None:
        """Return the torque after an unexpected error."""
        self.has_sample = False
        self.supervisor.stop(Reason.FAILED, text)
        return self._safe_without_state(self.config.sample_time)

    def release(self) -> None:
        """Note the end of the controller."""
        self._note(EventType.RELEASE)

    def _begin_message(self) -> None:
        self.end_silence()
        self.has_sample = False
        self.journal.messages += 1

    def _start(self, stamp: int, q: Vector, dq: Vector) -> bool:
        """Resume along the running reference if the law can take over, or else start at t = 0."""
        controller, t = self.controller, self._time_of(stamp)
        resumed = self._resumable and stamp > self.last_stamp
        if resumed:
            try:
                bound, reference = controller.bound_at(t), controller.reference_vector
                check_takeover(self.config, bound, q, dq, reference, t)
            except StartError:
                resumed = False
        if not resumed:
            try:
                self.settled = begin(controller, self.config, q, dq)
            except (StartError, MotionError) as error:
                self.start_error = error
                self.supervisor.stop(Reason.START_REJECTED, str(error))
                return False
            self.start_stamp = stamp
        self.journal.note(EventType.START, resumed=resumed)
        self.last_stamp = stamp - self.config.sample_time_ns
        watchdog = self.config.safety.watchdog
        self.unwatched = why_unwatched(stamp, self._wall()) if watchdog == 'auto' else ''
        self.watching = watchdog != 'off' and not self.unwatched
        self.supervisor.enter(Phase.APPROACHING)
        return True

    def _control(self, stamp: int, measurement: Vector) -> Vector | None:
        dt = (stamp - self.last_stamp) * _NANO
        t = self._time_of(stamp)
        if self.supervisor.phase is Phase.APPROACHING and t >= self.settled:
            self.supervisor.enter(Phase.TRACKING)
        before = perf_counter()
        torque = self.controller.update(t, dt, measurement)
        self.compute_time = perf_counter() - before
        if self.controller.samples == 1 and self.commanding:
            limit_first_torque(self.controller, self._torque, dt)
        self.last_stamp = stamp
        if not self._is_valid_sample(dt):
            return self._safe(self.config.sample_time)
        self._torque[:] = torque
        self.has_sample = True
        self.journal.commands += 1
        return self._torque

    def _is_valid_sample(self, dt: float) -> bool:
        controller, safety = self.controller, self.config.safety
        flags = checks.check_sample(
            controller.settings_vector,
            controller.state_vector,
            controller.signals_vector,
            controller.sample_vector,
            safety.error_ratio,
            self.ratio,
            self._kept,
        )
        if flags & checks.OUTSIDE:
            self.outside += 1
        if not flags & checks.SUSPECT:
            self.supervisor.saturated_time = 0.0
            return True
        is_valid = self.supervisor.check_sample(safety, controller, dt)
        if is_valid:
            self._keep()
        return is_valid

    def _on_stop(self) -> None:
        supervisor = self.supervisor
        self.journal.note(EventType.STOP, reason=supervisor.reason, text=supervisor.text)
        self._clean = self._resumable = False
        self._ramp.begin(self._torque, self.config.safety.stop_ramp)

    def _safe_without_state(self, dt: float) -> Vector | None:
        self._last_state.miss(dt)
        return self._safe(dt)

    def _safe(self, dt: float) -> Vector | None:
        """Safe torque, `dt` [s] further on the ramp.

        None while no state has been seen, and while inactive from the beginning.
        """
        is_new = self.supervisor.phase is Phase.INACTIVE and not self.commanding
        if is_new or self._last_state.age == inf:
            return None
        settings = self.controller.settings
        estimate = self._kept[: settings.m]
        goal = safe_torque(self.config.safety, settings, self._last_state, estimate)
        limit = settings.torque_limit
        self._torque[:] = np.clip(self._ramp.advance(goal, dt), -limit, limit)
        self.journal.commands += 1
        return self._torque
