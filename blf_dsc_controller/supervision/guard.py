# SPDX-License-Identifier: Apache-2.0
"""The guarded law: checks before and after the law, and a torque for every joint state.

joint state -> StateCheck -> law -> SampleCheck -> torque
                   |                     |
                   +---- safe torque <---+    until the next reset or activation

`Guard` answers each message, silence and error with a torque.  It leaves the rest to its
parts: `Starting` brings the law into command, `InCommand` takes it out of command and
computes the safe torque, `Findings` reacts to contacts and oscillations that the law has
detected, `Motions` changes the reference, and `DriveLoads` counts the load that was
declared to the drives.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import differences
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.law.check_state import INVALID
from blf_dsc_controller.law.checks import is_valid_state
from blf_dsc_controller.messages.errors import (
    DuplicatedJointError,
    MessageError,
    MissingJointError,
    ShortArrayError,
)
from blf_dsc_controller.messages.journal import EventType
from blf_dsc_controller.messages.tip_load import TAKEN_UP, TipLoad
from blf_dsc_controller.run import NANOSECOND
from blf_dsc_controller.supervision import retuning
from blf_dsc_controller.supervision.drive_load import DriveLoads
from blf_dsc_controller.supervision.envelope import LONGEST, Motion, limited
from blf_dsc_controller.supervision.envelope_limits import limits_of
from blf_dsc_controller.supervision.expected_load import ExpectedLoad
from blf_dsc_controller.supervision.findings import Findings
from blf_dsc_controller.supervision.in_command import InCommand
from blf_dsc_controller.supervision.motions import Motions
from blf_dsc_controller.supervision.reading import Doubt, Reading
from blf_dsc_controller.supervision.starting import Starting
from blf_dsc_controller.supervision.state_check import SKIP
from blf_dsc_controller.supervision.state_watchdog import PERIOD
from blf_dsc_controller.supervision.supervisor import Fault, Phase, Reason

Vector = NDArray[np.float64]

_REASONS: dict[type[MessageError], Reason] = {
    MissingJointError: Reason.JOINT_MISSING,
    DuplicatedJointError: Reason.JOINT_DUPLICATED,
    ShortArrayError: Reason.FIELD_MISSING,
}


class Guard(InCommand):
    """The law with its checks and safe torque; it records all events in its journal.

    `update`, `reject`, `watch` and `fail` return the torque (n,) [N m] to command, or
    None.  `InCommand` describes the other attributes.

    Attributes:
        findings: contacts, oscillations and wrong sensors that the law has found.
        loads: the load that is declared to the drives.
        expected: the load that the tip is expected to hold.
        starting: activation, reset, and the start from a state.
        motions: trajectories and targets, planned and followed.
        foreign: number of messages ignored because they name none of the joints.
        compute_time: computation time of the last sample [s].
    """

    def __init__(
        self,
        config: ControllerConfig,
        steady: Callable[[], int] = time.monotonic_ns,
        wall: Callable[[], int] = time.time_ns,
    ) -> None:
        """Compile the law; `steady` and `wall` are the clocks [ns]."""
        super().__init__(config, steady, wall)
        self.findings = Findings(self)
        self.loads = DriveLoads(config, self.controller)
        self.expected = ExpectedLoad(config, self.controller)
        self.starting = Starting(self, self.findings, self.loads, self.expected)
        self.motions = Motions(self, self.findings.contacts)
        self.foreign = 0
        self.compute_time = 0.0

    def update(self, stamp: int, measurement: Vector) -> Vector | None:
        """Return the torque for a joint state, with its stamp [ns]; None: no command.

        `measurement` is [q (n,) rad, dq (n,) rad/s, applied torque of the last interval
        (n,) N m].
        """
        self._begin_message()
        gap = (stamp - self.journal.stamp) * NANOSECOND
        self.journal.stamp = stamp
        self.watchdog.restart()
        begins = self.supervisor.phase is Phase.STARTING
        reading = self.readings.take(stamp, measurement, begins=begins)
        if reading.is_after_gap:
            self.held.after_gap = reading
        if not self.supervisor.uses_states:
            if self.states.ignores(is_copy=reading.doubt is Doubt.COPY):
                return None
            self.withdraw_after_silence(gap)
            if self.silenced:
                return None
            return self._safe_at(reading)
        fault = self.states.check(self.config.safety, stamp)
        if fault is SKIP:
            return None
        fault = fault or reading.wrapped
        if fault is None and self.supervisor.running:
            last = self.readings.last
            fault = self.states.check_motion(reading, last.q, last.dq)
        if fault is None:
            return self._use(reading)
        self._wait_or_stop(*fault)
        return self._safe_at(reading)

    def _use(self, reading: Reading) -> Vector | None:
        """Return the law's torque for a state, or the safe torque if it cannot be used."""
        if self.supervisor.phase is Phase.STARTING:
            if not is_valid_state(self.controller.checks, reading.measurement):
                self._wait_for_valid(reading)
                return self._safe_at(reading)
            self.starting.forget_load_after_gap(reading)
            self.readings.begin(reading)
            if not self.starting.start(reading):
                return self.safe(self.config.sample_time)
        elif self.held.after_gap is not None and not self.starting.rejoin(reading):
            return self._safe_at(reading)
        dt = (reading.stamp - self.reference.last_stamp) * NANOSECOND
        torque = self._update_law(reading, dt)
        if self.controller.flags & INVALID:
            self.findings.stop_at_invalid(reading)
            return self._safe_at(reading)
        self.readings.use(reading)
        self._advance_to(reading.stamp)
        self.findings.check_efforts()
        fault = (
            self.samples.check(dt)
            or self.findings.check_oscillation()
            or self._keep_within_envelope(torque, dt)
        )
        if fault is not None:
            self.stop(*fault)
            return self.safe(self.config.sample_time)
        self.hold.commanded[:] = torque
        self.held.recent.take(reading.stamp, reading.measurement, torque)
        self.has_sample = True
        self.journal.commands += 1
        return torque

    def _wait_for_valid(self, reading: Reading) -> None:
        """Wait for another state to start from, since the law finds this one invalid."""
        invalid = self.states.invalid(self.config.safety, reading)
        self.starting.wait(invalid.text)

    def _update_law(self, reading: Reading, dt: float) -> Vector:
        """Return the law's torque (n,) [N m], `dt` [s] after its last sample."""
        before = perf_counter()
        self.expected.advance()
        t = self.reference.time_of(reading.stamp)
        torque = self.controller.command(t, dt, reading.measurement)
        self.compute_time = perf_counter() - before
        return torque

    def _keep_within_envelope(self, torque: Vector, dt: float) -> Fault | None:
        """Let only what the arm may be asked for leave of the law's torque (n,) [N m].

        It comes `dt` [s] after the last one.
        Return the fault of a law that has asked for more for too long.
        """
        controller, envelope = self.controller, self.envelope
        fault = self._brake(torque, dt) if envelope.body.brakes else None
        last = self.hold.commanded if controller.samples > 0 else None
        limits = envelope.limits
        controller.replace_torque(limited(torque, last, limits.torque, limits.step))
        return fault

    def _brake(self, torque: Vector, dt: float) -> Fault | None:
        """Change the law's torque (n,) [N m] where it makes a joint too fast."""
        controller, envelope = self.controller, self.envelope
        signals, added = controller.signals, controller.signals.saturation.added
        now = Motion(signals.q, signals.dq, signals.xi1, signals.dqr)
        whole = torque + added
        estimate = self.estimates.estimate[: controller.settings.p]
        braked = envelope.brake(now, whole, estimate, dt)
        if braked is not whole:
            torque[:] = braked - added
        asking = envelope.asking * self.config.sample_time
        if asking <= LONGEST:
            return None
        return self.states.braked(asking, envelope.joint, now, envelope.speeds(now))

    def perceive(self) -> None:
        """Learn from the last state, weigh what the tip holds, and detect contact.

        Call it after each `update`, once its torque has been sent.
        """
        if not self.has_sample:
            return
        self.controller.advance()
        if self.controller.perceive(self.config.sample_time):
            self.findings.react_to_contact()
        self.expected.observe()

    def observe(self, stamp: int, measurement: Vector) -> None:
        """Compare velocities with positions for a state that is held back."""
        reading = self.readings.take(stamp, measurement, begins=True)
        if reading.doubt is None:
            self.findings.compare_velocities(reading)

    def _safe_at(self, reading: Reading) -> Vector | None:
        """Return the safe torque for a state that the law has not used."""
        if reading.doubt is None and reading.continues:
            self.findings.compare_velocities(reading)
        return self.safe_at(reading)

    def _advance_to(self, stamp: int) -> None:
        self.reference.last_stamp = stamp
        if (
            self.supervisor.phase is Phase.APPROACHING
            and self.reference.time >= self.reference.settled
        ):
            self.supervisor.enter(Phase.TRACKING)

    def reject(self, error: MessageError) -> Vector | None:
        """Return the torque for an unreadable message, None if it is another arm's."""
        self._begin_message()
        if isinstance(error, MissingJointError) and error.is_foreign(
            self.config.joints
        ):
            self.foreign += 1
            return None
        self.watchdog.restart()
        self._wait_or_stop(_REASONS.get(type(error), Reason.BAD_MESSAGE), str(error))
        return self.safe_without_state(self.config.sample_time)

    def watch(self) -> Vector | None:
        """Return a torque during a silence, else None; call it every PERIOD."""
        limit = self.config.sample_time + self.config.safety.state_timeout
        silent = self.watchdog.measure_silence(limit)
        if silent == 0.0 or not (self.watchdog.on and self.commanding):
            return None
        return self.time_out(
            f'no joint state received for {silent:.3g} s, and {limit:.3g} s are allowed '
            '(sample_time + safety.state_timeout): is the driver alive, and the computer free?'
        )

    def time_out(self, text: str) -> Vector | None:
        """Return the torque of one watchdog period without a joint state."""
        self.held.after_gap = None
        if self.supervisor.phase is not Phase.STARTING:  # which is waiting for a state
            self.stop(Reason.STATE_TIMEOUT, text)
        self.watchdog.torques += 1
        return self.safe_without_state(PERIOD)

    def fail(self, text: str) -> Vector | None:
        """Return the torque after an unexpected error."""
        self.held.after_gap = None
        self.stop(Reason.FAILED, text)
        return self.safe_without_state(self.config.sample_time)

    def _begin_message(self) -> None:
        self.end_silence()
        self.starting.waiting_for = ''
        self.held.after_gap = None
        self.has_sample = False
        self.journal.messages += 1

    def _wait_or_stop(self, reason: Reason, text: str) -> None:
        """Do what a state that the law cannot use leads to."""
        if self.supervisor.phase is Phase.STARTING:
            self.starting.wait(text)
        else:
            self.stop(reason, text)

    def load_to_tell(self) -> TipLoad | None:
        """Return the load to declare to the drives next, None if there is none."""
        return self.loads.begin_step() if self.has_sample else None

    def take_over(self, load: TipLoad) -> None:
        """Subtract the weight of a load that the drives add from the next state on."""
        self.loads.take(load)
        centre = list(load.centre)
        self.note(EventType.DRIVE_LOAD, mass=load.mass, centre=centre)
        self.held.recent.restart()  # the torques so far met drives without it

    def expect_load(self, load: TipLoad | None, interval: float = TAKEN_UP) -> None:
        """Let the law expect that the tip takes up this load within an `interval` [s] from now.

        None: the load that was weighed last.

        Raises:
            BlfDscError: it is no load of this arm's tip, or the law is not in command.
        """
        if not self.supervisor.running:
            why = self.supervisor.text or self.supervisor.phase
            raise BlfDscError(
                f'expected load: the law is not in command ({why}): expect it once it is'
            )
        load = self.expected.expect(load, interval, self.readings.last.q)
        centre = list(load.centre)
        self.note(
            EventType.EXPECTED_LOAD, mass=load.mass, centre=centre, interval=interval
        )

    def retune(self, config: ControllerConfig) -> None:
        """Apply a configuration, between two samples."""
        changed = differences(self.config, config)
        self.note(EventType.PARAMETERS, parameters=changed)
        self.reference.drop_prepared()
        if self.supervisor.running:
            last = self.readings.last.measurement
            retuning.apply_bumpless(self.controller, config, self.reference.time, last)
        else:
            retuning.apply(self.controller, config)
        self.loads.subtract_again()
        self.expected.apply_again()
        self.config = config
        self.oscillation.configure(config)
        self.samples.set_limits(config.safety)
        self.readings.set_limits(config.safety)
        self.envelope.configure(*limits_of(config, self.controller.settings))

    def problems(self, config: ControllerConfig) -> list[str]:
        """Return why a configuration cannot be applied now; empty if it can."""
        if not self.supervisor.running:
            return []
        return retuning.problems(self.controller, config, self.reference.time)
