# SPDX-License-Identifier: Apache-2.0
"""How a law takes command: activation, reset, the first state, and the return after a gap."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.errors import BlfDscError, StartError
from blf_dsc_controller.law.checks import is_valid_state
from blf_dsc_controller.law.start import Start
from blf_dsc_controller.law.torque import added_torque
from blf_dsc_controller.messages.journal import EventType
from blf_dsc_controller.reference.approach import BlendedReference, MotionError
from blf_dsc_controller.supervision.drive_load import DriveLoads
from blf_dsc_controller.supervision.expected_load import ExpectedLoad
from blf_dsc_controller.supervision.findings import Findings
from blf_dsc_controller.supervision.first_torque import (
    check_first_torque,
    check_support,
)
from blf_dsc_controller.supervision.in_command import InCommand
from blf_dsc_controller.supervision.reading import Reading
from blf_dsc_controller.supervision.supervisor import Phase, Reason

Vector = NDArray[np.float64]


class Starting:
    """The starts of one arm's law.

    Attributes:
        error: why the law could not start; None if it could.
        waiting_for: what is wrong with the last state that the law could not start from; or empty.
    """

    def __init__(
        self,
        command: InCommand,
        findings: Findings,
        loads: DriveLoads,
        expected: ExpectedLoad,
    ) -> None:
        """Bring the law of `command` into command, without earlier findings."""
        self.error: BlfDscError | None = None
        self.waiting_for = ''
        self._command = command
        self._findings = findings
        self._loads = loads
        self._expected = expected
        self._acting: Vector | None = None  # N m, by which another node holds the arm
        self._load: Vector | None = None  # N m, load of a reset, which goes on
        self._last_position: Vector | None = None  # rad, where the law left command

    def activate(self) -> None:
        """Take command with the next state, and what was learned before a fault.

        After one, the law carries on what the safe torque carries besides the model.
        """
        command = self._command
        command.note(EventType.ACTIVATE)
        load = None
        law = command.controller
        if law.samples:
            self._last_position = law.signals.q.copy()
        if command.clean:
            law.begin(Start.AGAIN)
        else:
            load = self._safe_torque_load(command.estimates.estimate)
            command.estimates.restore()
        self._start_over()
        self._load = load
        command.watchdog.restart()

    def reset(self) -> None:
        """Discard all estimates and faults, and restart with the next state.

        What law or safe torque carries besides the model is carried on.
        """
        command = self._command
        command.note(EventType.RESET)
        added = self._added_by_drives()
        command.reference.resumable = False
        self._expected.forget()
        command.controller.reset()
        self._loads.forget()
        load = self._carried(added - self._added_by_drives())
        command.estimates.keep()
        self._start_over()
        self._load = load
        if load is not None:
            command.safe_stop.begin_anew(load)

    def _added_by_drives(self) -> Vector:
        """Return the torque (n,) [N m] of the drives at the last state, by the model."""
        command = self._command
        settings = command.controller.settings
        return added_torque(settings.torque, command.readings.last.q)

    def _carried(self, forgotten: Vector) -> Vector | None:
        """Return the load (n,) [N m] besides the initial estimate that is carried now, if any.

        It is without what the drives hold and the law has just `forgotten` (n,) [N m].
        """
        command = self._command
        if command.supervisor.running:
            return command.held.load_before_learning()
        if command.supervisor.phase is Phase.STARTING:
            return self._load  # of a reset just before
        load = self._safe_torque_load(command.controller.settings.initial_estimate)
        return None if load is None else load - forgotten

    def _safe_torque_load(self, estimate: Vector) -> Vector | None:
        """Return the load (n,) [N m] of the safe torque besides an estimate (m,), if it has one."""
        command = self._command
        if not command.commanding or command.silenced:
            return None
        return command.safe_stop.carried(command.config.safety, estimate)

    def forget_load_after_gap(self, reading: Reading) -> None:
        """Drop the carried load after a gap, in which another controller may hold the arm."""
        if reading.is_after_gap or not reading.continues:
            self._load = None

    def prepare(self, positions: Vector) -> None:
        """Plan the start from rest at `positions` (n,) [rad], before the first state.

        The first torque is then ready within a sample.  If the arm is elsewhere by
        then, the start is planned again.

        Raises:
            StartError: the law cannot take over there.
            MotionError: no approach from there keeps the limits.
        """
        command = self._command
        command.reference.prepare(command.config, positions)
        command.note(EventType.PREPARE, positions=positions.tolist())

    def take_over_from(self, torque: Vector) -> None:
        """Start from a torque (n,) [N m] by which another node holds the arm.

        The watchdog does so after a controller has ended.  The first torque of the law continues
        this one, and what it contains besides the model is the law's load from the start.
        """
        self._command.note(EventType.TAKEOVER, torque=torque.tolist())
        self._acting = torque.copy()

    def check_support(self, measurement: Vector) -> None:
        """Refuse to start if it is unknown what holds a live arm.

        `measurement` is [q, dq, effort] (3 n,).
        """
        command = self._command
        if not command.commanding:
            try:
                check_support(command.controller, command.config, measurement)
            except StartError as error:
                self.refuse(error)

    def refuse(self, error: StartError | MotionError) -> None:
        """Stop before the start, because of an error."""
        self.error = error
        self._command.stop(Reason.START_REJECTED, str(error))

    def wait(self, problem: str) -> None:
        """Go on waiting for a state to start from."""
        self.waiting_for = problem
        self._command.states.restart()

    def start(self, reading: Reading) -> bool:
        """Take command: resume the running reference if possible, else start at t = 0.

        Return whether the law is in command from this state on; else `error` says why not.
        """
        command, law = self._command, self._command.controller
        reference, config = command.reference, command.config
        commanded = command.commanded
        try:
            motion = None
            if reference.resumable:
                motion = reference.way_back(config, reading)
            resumed = motion is not None
            if motion is None:
                again = commanded is not None
                motion = reference.plan_start(config, reading, again=again)
            law.reference_vector = motion.vector
            self._begin_elsewhere(reading.q)
            if self._acting is not None:
                self._begin_with_load(command.held.load_of(self._acting, reading.q))
                law.take_over(self._acting, reading.q)
            if self._load is not None:
                self._begin_with_load(self._load)
            if commanded is None:
                check_first_torque(law, config, reading, self._acting)
        except (StartError, MotionError) as error:
            self.refuse(error)
            return False
        if not resumed:
            reference.start_at(reading.stamp, config, reading.q)
        self._follow(motion, reading, resumed=resumed)
        return True

    def rejoin(self, reading: Reading) -> bool:
        """Return to the reference from where the arm is after a gap, or stop if it is too far.

        Whoever commanded it meanwhile may have braked it.  Without `safety.error_ratio` the
        law goes on instead.  Of an invalid state, the law says what is wrong.

        If the sample before was the first one, its plan may have taken all that time: another
        would take it again, and the law go on blind.
        """
        command, law = self._command, self._command.controller
        if not is_valid_state(law.checks, reading.measurement):
            return True
        reference = command.reference
        has_just_planned = law.samples == 1
        motion = reference.way_back(
            command.config, reading, as_planned=has_just_planned
        )
        if motion is not None:
            law.begin(Start.AFTER_GAP)
            self._follow(motion, reading, resumed=True)
            return True
        if command.config.safety.error_ratio == 0.0:
            return True  # no error stops this arm
        text = (
            f'no joint state came for {reading.gap:.3g} s, and the arm is too far from '
            'its reference now'
        )
        command.stop(Reason.STAMP_JUMP, text)
        return False

    def _begin_elsewhere(self, q: Vector) -> None:
        """Keep nothing of the posture that the arm was left in, if it is elsewhere.

        That is farther away than the bound on its error.
        """
        last_position, self._last_position = self._last_position, None
        law = self._command.controller
        if (
            last_position is not None
            and (np.abs(q - last_position) > law.bound_at(0.0)).any()
        ):
            law.begin(Start.ELSEWHERE)

    def _begin_with_load(self, load: Vector) -> None:
        """Let d^3 begin with a load (n,) [N m]."""
        law = self._command.controller
        integrates = law.settings.disturbance.gain > 0.0
        law.state.disturbance[integrates] = load[integrates]

    def _follow(
        self, motion: BlendedReference, reading: Reading, *, resumed: bool
    ) -> None:
        """Follow a motion from this state on, at the torque that acts."""
        command = self._command
        command.reference.follow_from_start(motion)
        if command.commanded is not None and self._acting is None:
            held = command.held.command()
            acts = command.commanded if held is None else held
            command.controller.take_over(acts, reading.q)
        command.journal.note(EventType.START, resumed=resumed)
        command.reference.last_stamp = reading.stamp - command.config.sample_time_ns
        self._acting = self._load = None
        command.held.recent.restart()
        command.watchdog.switch(command.config.safety.watchdog, reading.stamp)
        command.supervisor.enter(Phase.APPROACHING)

    def _start_over(self) -> None:
        """Wait for a state to start from, with neither faults nor what they have led to."""
        self.error = None
        self._acting = self._load = None
        self._command.start_over()
        self._findings.restart()
