# SPDX-License-Identifier: Apache-2.0
"""The law behind its supervisor: an answer that is safe to apply, whatever comes.

joint state -> [trusted?] -> law -> [trusted?] -> torque
                   |                    |
                   +--- safe torque <---+    until reset or activated again
"""

from __future__ import annotations

import time
from collections.abc import Callable
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.errors import BlfDscError, OutsideBarrierError
from blf_dsc_controller.law import factory as assembly
from blf_dsc_controller.law.factory import begin
from blf_dsc_controller.messages.errors import (
    DuplicatedJointError,
    MessageError,
    MissingJointError,
    ShortArrayError,
)
from blf_dsc_controller.reference.limits import MotionError, limits_of
from blf_dsc_controller.reference.trajectory import Trajectory, TrajectoryError, plan_trajectory
from blf_dsc_controller.supervision import checks as soundness
from blf_dsc_controller.supervision import retuning as tuning
from blf_dsc_controller.supervision.reasons import Operation, Phase, Reason
from blf_dsc_controller.supervision.safe_torque import Ramp, safe_torque
from blf_dsc_controller.supervision.supervisor import Supervisor, Trust
from blf_dsc_controller.supervision.velocity import Velocity
from blf_dsc_controller.supervision.watchdogs import LOOK, Silence

Vector = NDArray[np.float64]
_NANO = 1e-9
_SAME_CLOCK = 60 * 1_000_000_000  # ns that a live stamp may be off this computer's time

_REASONS: dict[type[MessageError], Reason] = {
    MissingJointError: Reason.JOINT_MISSING,
    DuplicatedJointError: Reason.JOINT_DUPLICATED,
    ShortArrayError: Reason.FIELD_MISSING,
}


class Guard:
    """A controller that stops by itself.

    Args:
        config: of the controller.
        steady: steady clock [ns].
        wall: time of day [ns].

    Attributes:
        config: the configuration in force.
        controller: the law.
        supervisor: what is going on, and why it stopped.
        answered: whether the last answer was the law's, so that its telemetry is worth telling.
        refusal: the error of a start that was refused; None if none was.
        foreign: messages passed over because they name none of the joints.
        ratio: largest |xi1| / k_c of each joint since the start (n,).
        outside: samples past the bound since then.
        start_stamp: of t = 0 [ns]; -1 before the first start.
        settled: time from which on the reference is the configured one [s].
        last_stamp: of the last state that the law answered [ns].
        last_seen: stamp of the last state that came, whoever answered it [ns]; -1 before the first.
        operations: how often it was activated, deactivated or reset.
        operation: which of these was the last.
        compute_time: that the law took for it [s].
        watching: whether silence on the steady clock leads to a stop.
    """

    def __init__(
        self,
        config: ControllerConfig,
        steady: Callable[[], int] = time.monotonic_ns,
        wall: Callable[[], int] = time.time_ns,
    ) -> None:
        n = len(config.joints)
        self.config = config
        self.controller = assembly.controller_of(config)
        self.supervisor = Supervisor(config.joints, config.sample_time)
        self.answered = False
        self.refusal: BlfDscError | None = None
        self.foreign = 0
        self.watching = False
        self.compute_time = 0.0
        self.ratio = np.zeros(n)
        self.outside = 0
        self.start_stamp = -1
        self.settled = 0.0
        self.last_stamp = -1
        self.last_seen = -1
        self.operations = 0
        self.operation = Operation.NONE
        self._steady = steady
        self._wall = wall
        self._silence = Silence()
        self._velocity = Velocity(config.safety.velocity, n)
        self._ramp = Ramp(n)
        self._torque = np.zeros(n)
        self._commanded = False
        self._learns_from_effort = config.learning.torque_source == 'effort'
        self._kept = np.zeros(self.controller.settings.m + n)
        self._clean = True
        self._resumable = False
        self._stops_seen = 0
        self._measurement = np.zeros(3 * n)
        self._q = self._measurement[:n]
        self._dq = self._measurement[n : 2 * n]
        self._keep()

    @property
    def commanding(self) -> bool:
        """Whether a torque has been commanded since the node was configured."""
        return self._commanded

    # From here on: what the operator does.

    def activate(self) -> None:
        """Take command with the next state; what was learned is kept if so configured."""
        self._note(Operation.ACTIVATE)
        if not self.config.safety.keep_estimates:
            self.controller.reset()
            self._resumable = False  # t counts the window's filling, too
        elif self._clean:
            self.controller.state.samples[0] = 0.0
        else:
            self._keep_estimates_alone()
        self._start_over()

    def deactivate(self) -> None:
        """Leave command: the torque goes to the safe one on its ramp."""
        self._note(Operation.DEACTIVATE)
        was_running = self.supervisor.running
        self._clean = self._clean and self.supervisor.phase is not Phase.SAFE_STOP
        self.supervisor.enter(Phase.INACTIVE)
        self._silence.forget()
        self._resumable = was_running
        if was_running:
            self._ramp.begin(self._torque, self.config.safety.deactivation_ramp)

    def reset(self) -> None:
        """Forget everything that was learned, and every fault, and start with the next state."""
        self._note(Operation.RESET)
        self._resumable = False
        self.controller.reset()
        self._keep()
        self._start_over()

    def follow(self, trajectory: Trajectory) -> None:
        """Follow another trajectory from the next sample on.

        Raises:
            TrajectoryError: it cannot be followed; the present reference goes on.
        """
        if not self.supervisor.running:
            raise TrajectoryError([f'the controller is not in command: {self._situation()}'])
        now = (self.last_stamp - self.start_stamp) * _NANO
        vector, limits = self.controller.reference_vector, limits_of(self.config)
        motion = plan_trajectory(trajectory, vector, now, limits)
        self.controller.reference_vector = motion.vector
        self.settled = motion.settled
        self.supervisor.enter(Phase.APPROACHING if motion.settled > now else Phase.TRACKING)

    def _note(self, operation: Operation) -> None:
        self.operation = operation
        self.operations += 1

    def _situation(self) -> str:
        phase = self.supervisor.phase
        return self.supervisor.text if phase is Phase.SAFE_STOP else phase.value

    def retune(self, config: ControllerConfig) -> None:
        """Take a new configuration, between two samples."""
        if self.supervisor.running:
            t = (self.last_stamp - self.start_stamp) * _NANO
            tuning.transfer(self.controller, config, t, self._measurement)
        else:
            tuning.take(self.controller, config)
        self.config = config

    def objections(self, config: ControllerConfig) -> list[str]:
        """Why a configuration cannot be taken now, in words; empty if it can."""
        if not self.supervisor.running:
            return []
        t = (self.last_stamp - self.start_stamp) * _NANO
        return tuning.objections(self.controller, config, t)

    def _start_over(self) -> None:
        self.supervisor.enter(Phase.STARTING)
        self.refusal = None
        self.answered = False
        self.outside = 0
        self.ratio[:] = 0.0
        self._clean = True
        self._stops_seen = self.supervisor.stops
        self._silence.forget()
        self._velocity.forget()

    def _keep_estimates_alone(self) -> None:
        """After a fault the window may hold what was wrong; the estimates are from before it."""
        self.controller.reset()
        m = self.controller.settings.m
        self.controller.state.estimate[:] = self._kept[:m]
        self.controller.state.disturbance[:] = self._kept[m:]

    def _keep(self) -> None:
        state = self.controller.state
        m = self.controller.settings.m
        self._kept[:m] = state.estimate
        self._kept[m:] = state.disturbance

    # From here on: what comes from the arm.

    def answer(self, stamp: int, measurement: Vector) -> Vector | None:
        """Torque (n,) [N m] for a state; None if it is to be passed over.

        Args:
            stamp: of the state [ns].
            measurement: [q (n,) rad, dq (n,) rad/s, applied torque of the last interval (n,) N m].
        """
        self.answered = False
        self.last_seen = stamp
        self._silence.state(self._steady())
        n = self.ratio.size
        q, dq = measurement[:n], measurement[n : 2 * n]
        self._velocity.replace(stamp, q, dq)
        effort = measurement[2 * n :] if self._learns_from_effort else None
        trust = self.supervisor.inspect(self.config.safety, stamp, q, dq, effort)
        if trust is Trust.SKIP:
            return None
        if trust is Trust.STOP:
            self._remember(q, dq)
            return self._safe(self.config.sample_time)
        self._measurement[:] = measurement
        if self.supervisor.phase is Phase.STARTING and not self._begin(stamp, q, dq):
            return self._safe(self.config.sample_time) if self._commanded else None
        return self._control(stamp, measurement)

    def unusable(self, error: MessageError) -> Vector | None:
        """Torque (n,) [N m] for a message that cannot be read; None if it is not for this arm."""
        self.answered = False
        if isinstance(error, MissingJointError) and self._is_foreign(error):
            self.foreign += 1
            return None
        self._silence.state(self._steady())
        self.supervisor.stop(_REASONS.get(type(error), Reason.BAD_MESSAGE), str(error))
        return self._safe(self.config.sample_time)

    @property
    def next_watch(self) -> float:
        """Time [s] after which to `watch` again."""
        return self._silence.next_look

    def watch(self) -> Vector | None:
        """Look at the steady clock, `next_watch` after the last look; a torque if it is silent."""
        limit = self.config.sample_time + self.config.safety.state_timeout
        silent = self._silence.look(self._steady(), limit)
        if silent == 0.0 or not (self.watching and self._commanded):
            return None
        self._dq[:] = 0.0
        self.supervisor.stop(Reason.STATE_TIMEOUT, f'no joint state has come for {silent:.3g} s')
        return self._safe(LOOK)

    def fail(self, error: Exception) -> Vector | None:
        """Torque (n,) [N m] after an error that nobody foresaw."""
        self.answered = False
        self.supervisor.stop(Reason.FAILED, f'{type(error).__name__}: {error}')
        return self._safe(self.config.sample_time)

    def _is_foreign(self, error: MissingJointError) -> bool:
        """Several drivers may share joint_states, each with joints of its own."""
        return bool(error.names) and not set(self.config.joints) & set(error.names)

    def _begin(self, stamp: int, q: Vector, dq: Vector) -> bool:
        """Go on along the running reference if it is in reach, or else start at t = 0."""
        elapsed = (stamp - self.start_stamp) * _NANO
        if not (self._resumable and stamp > self.last_stamp and self._in_reach(q, elapsed)):
            try:
                self.settled = begin(self.controller, self.config, q, dq)
            except (OutsideBarrierError, MotionError) as error:
                self.refusal = error
                self.supervisor.stop(Reason.START_REFUSED, str(error))
                return False
            self.start_stamp = stamp
        self.last_stamp = stamp - self.config.sample_time_ns
        watchdog = self.config.safety.watchdog
        is_live = abs(self._wall() - stamp) < _SAME_CLOCK
        self.watching = watchdog == 'on' or (watchdog == 'auto' and is_live)
        self.supervisor.enter(Phase.APPROACHING)
        return True

    def _in_reach(self, q: Vector, elapsed: float) -> bool:
        try:
            self.controller.check_start(self.config.joints, q, elapsed)
        except OutsideBarrierError:
            return False
        return True

    def _control(self, stamp: int, measurement: Vector) -> Vector | None:
        controller = self.controller
        dt = (stamp - self.last_stamp) * _NANO
        t = (stamp - self.start_stamp) * _NANO
        if self.supervisor.phase is Phase.APPROACHING and t >= self.settled:
            self.supervisor.enter(Phase.TRACKING)
        before = perf_counter()
        torque = controller.update(t, dt, measurement)
        self.compute_time = perf_counter() - before
        self.last_stamp = stamp
        if not self._is_trusted(dt):
            return self._safe(self.config.sample_time)
        self._torque[:] = torque
        self._commanded = self.answered = True
        return self._torque

    def _is_trusted(self, dt: float) -> bool:
        """Whether the torque may be used: by a quick look, or in doubt by a judgement."""
        controller, safety = self.controller, self.config.safety
        verdict = soundness.look(
            controller.settings_vector,
            controller.state_vector,
            controller.signals_vector,
            controller.sample_vector,
            safety.error_ratio,
            self.ratio,
            self._kept,
        )
        if verdict & soundness.OUTSIDE:
            self.outside += 1
        if not verdict & soundness.SUSPECT:
            self.supervisor.accept()
            return True
        trusted = self.supervisor.judge(safety, controller, dt)
        if trusted:
            self._keep()
        return trusted

    def _remember(self, q: Vector, dq: Vector) -> None:
        """Keep of a state that is not to be trusted what the safe torque can use."""
        if np.isfinite(q).all():
            self._q[:] = q
        plausible = np.abs(dq) <= self.config.safety.velocity_limit
        self._dq[:] = np.where(plausible, dq, 0.0)

    def _safe(self, dt: float) -> Vector | None:
        """Safe torque, `dt` [s] further on the ramp; None as long as nothing is to be commanded."""
        phase = self.supervisor.phase
        if self._stops_seen != self.supervisor.stops:
            self._stops_seen = self.supervisor.stops
            self._clean = self._resumable = False
            self._ramp.begin(self._torque, self.config.safety.stop_ramp)
        if phase is Phase.INACTIVE and not self._commanded:
            return None
        settings = self.controller.settings
        m = settings.m
        goal = safe_torque(self.config.safety, settings, self._q, self._dq, self._kept[:m])
        limit = settings.torque_limit
        self._torque[:] = np.clip(self._ramp.towards(goal, dt), -limit, limit)
        self._commanded = True
        return self._torque
