# SPDX-License-Identifier: Apache-2.0
"""The guarded law in operation: activation, reset, trajectories and changes of gains."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import differences
from blf_dsc_controller.messages.journal import EventType
from blf_dsc_controller.reference.approach import BlendedReference
from blf_dsc_controller.reference.trajectory import Trajectory, TrajectoryError, plan_trajectory
from blf_dsc_controller.supervision import retuning
from blf_dsc_controller.supervision.guarded_law import GuardedLaw, Vector
from blf_dsc_controller.supervision.supervisor import Phase


class LatePlanError(TrajectoryError):
    """The time at which a trajectory should take effect passed while it was planned."""

    def __init__(self, at: float, now: float) -> None:
        super().__init__([f'it should begin at {at:.6g} s, but was planned only at {now:.6g} s'])


class Plan(NamedTuple):
    """A planned trajectory."""

    trajectory: Trajectory
    at: float  # s since the start, when it takes effect
    before: np.ndarray  # packed reference that it continues
    motion: BlendedReference


class Guard(GuardedLaw):
    """The guarded law in operation; it records every event in its journal."""

    def activate(self) -> None:
        """Take command with the next state; estimates are kept if so configured."""
        self._note(EventType.ACTIVATE)
        if not self.config.safety.keep_estimates:
            self.controller.reset()
            self._resumable = False  # t also counts the filling of the window
        elif self._clean:
            self.controller.state.samples[0] = 0.0
        else:
            self.samples.restore()
        self._start_over()
        self.watchdog.restart()

    def deactivate(self) -> None:
        """Leave command: the torque ramps to the safe torque."""
        self._note(EventType.DEACTIVATE)
        self._resumable = self.supervisor.running
        self.supervisor.enter(Phase.INACTIVE)
        self.samples.relax()
        self.watchdog.restart()
        if self._resumable:
            ramp = self.config.safety.deactivation_ramp
            self._safe_torque.begin_ramp(ramp, self.samples.disturbance)

    def reset(self) -> None:
        """Discard all estimates and faults, and restart with the next state."""
        self._note(EventType.RESET)
        self._resumable = False
        self.controller.reset()
        if self._velocity is not None:
            self._velocity.reset()
        self.samples.keep()
        self._start_over()

    def plan(self, trajectory: Trajectory, at: float | None = None) -> Plan:
        """Plan a trajectory, in any thread, to `adopt` by the time `at` [s], which defaults to now.

        Raises:
            TrajectoryError: it cannot be followed.
        """
        self._check_running()
        at, before = self.time if at is None else at, self.controller.reference_vector
        return Plan(trajectory, at, before, plan_trajectory(trajectory, before, at, self.config))

    def adopt(self, planned: Plan) -> None:
        """Follow a planned trajectory.

        Raises:
            LatePlanError: it begins in the past.
            TrajectoryError: it does not continue the current reference, which stays in force.
        """
        self._check_running()
        if planned.before is not self.controller.reference_vector:
            problem = 'the reference was replaced while it was planned: send it again'
            raise TrajectoryError([problem])
        if planned.at < self.time:
            raise LatePlanError(planned.at, self.time)
        joints, points, begin = planned.trajectory
        given = [point._asdict() for point in points]
        self._note(EventType.TRAJECTORY, joints=joints, points=given, begin=begin, at=planned.at)
        self.controller.reference_vector, self.settled = planned.motion
        is_settled = self.settled <= self.time
        self.supervisor.enter(Phase.TRACKING if is_settled else Phase.APPROACHING)

    def retune(self, config: ControllerConfig) -> None:
        """Apply a configuration, between two samples."""
        self._note(EventType.PARAMETERS, parameters=differences(self.config, config))
        if self.supervisor.running:
            last = self._safe_torque.last.measurement
            retuning.apply_bumpless(self.controller, config, self.time, last)
        else:
            retuning.apply(self.controller, config)
        self.config = config
        self.samples.set_limits(config.safety)

    def problems(self, config: ControllerConfig) -> list[str]:
        """Return why a configuration cannot be applied now; empty if it can."""
        if not self.supervisor.running:
            return []
        return list(retuning.problems(self.controller, config, self.time))

    @property
    def is_settled(self) -> bool:
        """Whether the arm rests under the safe torque."""
        return not self.supervisor.running and self._safe_torque.is_settled

    def release(self) -> Vector | None:
        """Return the last torque, if any was commanded: the safe torque of an arm at rest."""
        self._note(EventType.RELEASE)
        self.has_sample = False  # the last torque is not the law's
        if not self.commanding or self.silenced:
            return None
        return self._safe_torque.leave(
            self.config.safety, self.controller.settings, self.samples.estimate
        )

    def _note(self, event: EventType, **content: Any) -> None:
        self.end_silence()
        self.journal.note(event, **content)

    def _start_over(self) -> None:
        self.supervisor.enter(Phase.STARTING)
        self.states.restart()
        self.samples.restart()
        self.start_error = None
        self.silenced = False
        self.has_sample = False
        self._clean = True
        self.watchdog.wait()

    def _check_running(self) -> None:
        supervisor = self.supervisor
        if not supervisor.running:
            why = supervisor.text or supervisor.phase
            raise TrajectoryError([f'the controller is not in command: {why}'])
