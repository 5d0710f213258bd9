# SPDX-License-Identifier: Apache-2.0
"""The guarded law: checks before and after the law, and a torque for every joint state.

joint state -> StateCheck -> law -> SampleCheck -> torque
                   |                     |
                   +---- safe torque <---+    until the next reset or activation

Here is which torque answers a joint state, a message that cannot be read, a silence or an
error.  `Starting` has how the law comes into command, `InCommand` how it leaves it and
what the arm gets then, `Findings` what follows from what the law finds in its arm,
`Motions` what is commanded meanwhile, `ToldLoads` what the drives were told.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import differences
from blf_dsc_controller.errors import BlfDscError, StartError
from blf_dsc_controller.law.check_state import INVALID
from blf_dsc_controller.law.checks import is_valid_state
from blf_dsc_controller.messages.errors import (
    DuplicatedJointError,
    MessageError,
    MissingJointError,
    ShortArrayError,
)
from blf_dsc_controller.messages.journal import EventType
from blf_dsc_controller.reference.approach import MotionError
from blf_dsc_controller.reference.retargeting import Target
from blf_dsc_controller.reference.trajectory import Trajectory
from blf_dsc_controller.run import NANOSECOND
from blf_dsc_controller.supervision import retuning
from blf_dsc_controller.supervision.drive_load import DriveLoad
from blf_dsc_controller.supervision.findings import Findings
from blf_dsc_controller.supervision.in_command import InCommand
from blf_dsc_controller.supervision.last_state import LastState
from blf_dsc_controller.supervision.motions import Motions
from blf_dsc_controller.supervision.plan import Plan
from blf_dsc_controller.supervision.starting import Starting
from blf_dsc_controller.supervision.state_check import LONG_GAP, SKIP
from blf_dsc_controller.supervision.state_watchdog import PERIOD
from blf_dsc_controller.supervision.supervisor import Fault, Phase, Reason
from blf_dsc_controller.supervision.told_loads import ToldLoads

Vector = NDArray[np.float64]
_CHANGED = 0.5  # of the speed: an arm whose clock was set keeps its own

_REASONS: dict[type[MessageError], Reason] = {
    MissingJointError: Reason.JOINT_MISSING,
    DuplicatedJointError: Reason.JOINT_DUPLICATED,
    ShortArrayError: Reason.FIELD_MISSING,
}


class Guard:
    """The law with its checks and safe torque; it records all events in its journal.

    `update`, `reject`, `watch` and `fail` return the torque (n,) [N m] to command, or
    None.

    Attributes:
        controller: the law.
        supervisor: phase, and the reason of a stop.
        states, samples: the checks before and after the law.
        watchdog: the check for missing states.
        journal: events, and counts of what has been processed so far.
        calming: what oscillates, and how much softer the feedback is since.
        contacts: what has touched the arm.
        safe_torque: the ramp to the safe torque.
        held: what holds the arm, by its last motion.
        foreign: messages ignored because they name none of the joints.
        compute_time: computation time of the last sample [s].
    """

    def __init__(
        self,
        config: ControllerConfig,
        steady: Callable[[], int] = time.monotonic_ns,
        wall: Callable[[], int] = time.time_ns,
    ) -> None:
        """Compile the law; `steady` and `wall` are the clocks [ns]."""
        command = self._command = InCommand(config, steady, wall)
        self.controller = command.controller
        self.supervisor = command.supervisor
        self.states, self.samples = command.states, command.samples
        self.watchdog = command.watchdog
        self.journal = command.journal
        self.calming = command.calming
        self.safe_torque, self.held = command.safe_torque, command.held
        self.foreign = 0
        self.compute_time = 0.0
        self._findings = Findings(command)
        self._loads = ToldLoads(config, command.controller)
        self._starting = Starting(command, self._findings, self._loads)
        self._motions = Motions(command, self._findings.contacts)
        self.contacts = self._findings.contacts

    @property
    def config(self) -> ControllerConfig:
        """Configuration in force."""
        return self._command.config

    @property
    def has_sample(self) -> bool:
        """Whether the law used the last message, so that there is new telemetry."""
        return self._command.has_sample

    @property
    def commanding(self) -> bool:
        """Whether a torque has been commanded since the controller was configured."""
        return self._command.commanding

    @property
    def silenced(self) -> bool:
        """Whether nothing is commanded until the next reset or activation."""
        return self._command.silenced

    @property
    def start_error(self) -> BlfDscError | None:
        """Why the law could not start; None if it could."""
        return self._starting.error

    @property
    def waiting_for(self) -> str:
        """What is wrong with the last state that the law could not start from; or empty."""
        return self._starting.waiting_for

    @property
    def untrusted(self) -> str:
        """What is wrong with the efforts that joint torque sensors should show; or empty."""
        return self._findings.untrusted

    @property
    def start_stamp(self) -> int:
        """Stamp of t = 0 [ns]; -1 before the first start."""
        return self._command.reference.start_stamp

    @property
    def last_stamp(self) -> int:
        """Stamp of the law's last sample [ns]."""
        return self._command.reference.last_stamp

    @property
    def time(self) -> float:
        """Time of the last sample of the law [s]."""
        return self._command.reference.time

    @property
    def settled(self) -> float:
        """End of the approach or of the blend into a trajectory [s]."""
        return self._command.reference.settled

    @property
    def turned(self) -> str:
        """How the configured reference is shifted by whole turns; empty if it is not."""
        return self._command.reference.turned

    @property
    def last_state(self) -> LastState:
        """The last usable joint state."""
        return self.safe_torque.last

    @property
    def is_at_rest(self) -> bool:
        """Whether the reference and the arm rest, while the law is in command."""
        return self._command.is_at_rest

    @property
    def is_settled(self) -> bool:
        """Whether the arm rests under the safe torque."""
        return self._command.is_settled

    def update(self, stamp: int, measurement: Vector) -> Vector | None:
        """Return the torque for a joint state, with its stamp [ns]; None: no command.

        `measurement` is [q (n,) rad, dq (n,) rad/s, applied torque of the last interval
        (n,) N m].
        """
        self._begin_message()
        command, readings = self._command, self._command.readings
        gap = (stamp - self.journal.stamp) * NANOSECOND
        self.journal.stamp = stamp
        readings.take_stamp(stamp)
        self.watchdog.restart()
        measurement, wrapped = self._counted(measurement)
        readings.replace_velocities(stamp, measurement)
        if readings.is_after_gap:
            self.held.after_gap = measurement
        if self.supervisor.uses_states:
            fault = self.states.check(self.config.safety, stamp)
            if fault is SKIP:
                return None
            fault = fault or wrapped
            if fault is None and self.supervisor.running:
                fault = self._clock_step(measurement)
            if fault is None:
                return self._use(stamp, measurement)
            self._wait_or_stop(*fault)
        else:
            command.withdraw_after_silence(gap)
            if self.silenced:
                return None
        return self._safe_at(stamp, measurement)

    def _counted(self, measurement: Vector) -> tuple[Vector, Fault | None]:
        """Return a measurement with turns counted on, and a wrap that cannot be one."""
        fastest = self.config.safety.velocity_limit
        readings = self._command.readings
        counted, wrapped = readings.count_turns(measurement, fastest)
        if wrapped is not None and self.supervisor.phase is Phase.STARTING:
            readings.believe_positions()
        return counted, wrapped

    def _clock_step(self, measurement: Vector) -> Fault | None:
        """Return the fault of a clock that was set while the arm moved."""
        last = self.last_state
        gap = self._command.readings.gap
        if gap < LONG_GAP * self.config.sample_time or last.age > 0.0:
            return None
        q, dq, _ = measurement.reshape(3, -1)
        mean = 0.5 * (dq + last.dq)
        if np.abs(dq - last.dq).max() > _CHANGED * np.abs(mean).max():
            return None  # it has been braked or driven on: the time has passed
        return self.states.clock_step(gap, q - last.q, mean)

    def _use(self, stamp: int, measurement: Vector) -> Vector | None:
        """Pass a state to the law, or stop if the law finds it invalid."""
        law, command = self.controller, self._command
        last = self.last_state
        is_first = self.supervisor.phase is Phase.STARTING
        if is_first:
            if not is_valid_state(law.checks, measurement):
                invalid = self.states.invalid(self.config.safety, measurement)
                self._starting.wait(invalid.text)
                return self._safe_at(stamp, measurement)
            self._starting.forget_load_after_gap(stamp, measurement)
            last.take(stamp, measurement, command.slow)
            if not self._starting.start(stamp, measurement):
                return command.safe(self.config.sample_time)
        elif self.held.after_gap is not None and not self._starting.rejoin(
            stamp, measurement
        ):
            return self._safe_at(stamp, measurement)
        dt = (stamp - self.last_stamp) * NANOSECOND
        before = perf_counter()
        torque = law.update(command.reference.time_of(stamp), dt, measurement)
        self.compute_time = perf_counter() - before
        if law.flags & INVALID:
            self._findings.stop_at_invalid(stamp, measurement)
            return self._safe_at(stamp, measurement)
        last.take(stamp, measurement, command.slow)
        self._advance_to(stamp)
        self._findings.check_efforts()
        fault = self.samples.check(dt) or self._findings.calm()
        if fault is not None:
            command.stop(*fault)
            return command.safe(self.config.sample_time)
        self.safe_torque.commanded[:] = torque
        self.held.recent.take(stamp, measurement, torque)
        command.has_sample = True
        self.journal.commands += 1
        return torque

    def perceive(self) -> None:
        """Weigh what the tip holds, and detect contact, by the last state.

        Call it after its torque has been sent.
        """
        if self.has_sample and self.controller.perceive(self.config.sample_time):
            self._findings.react_to_contact()

    def observe(self, stamp: int, measurement: Vector) -> None:
        """Compare velocities with positions for a state that is held back."""
        self._command.readings.take_stamp(stamp)
        self._findings.compare_velocities(stamp, self._counted(measurement)[0])

    def _safe_at(self, stamp: int, measurement: Vector) -> Vector | None:
        """Return the safe torque for a state that the law has not used."""
        self._findings.compare_velocities(stamp, measurement)
        return self._command.safe_at(stamp, measurement)

    def _advance_to(self, stamp: int) -> None:
        self._command.reference.last_stamp = stamp
        if self.supervisor.phase is Phase.APPROACHING and self.time >= self.settled:
            self.supervisor.enter(Phase.TRACKING)

    def advance(
        self, stamps: Vector, measurements: np.ndarray, torques: np.ndarray
    ) -> None:
        """Advance by k states, all used by the law, with their stamps (k,) [ns].

        `measurements` (k, 3n) and `torques` (k, n) [N m] have a row for each.  All checks
        passed, and `samples.ratio` and the kept estimates are up to date.
        """
        command, recent = self._command, self.held.recent
        self.held.after_gap = None
        for k in range(max(0, stamps.size - recent.size), stamps.size):
            recent.take(int(stamps[k]), measurements[k], torques[k])
        count, stamp, measurement = stamps.size, int(stamps[-1]), measurements[-1]
        self.journal.stamp = stamp
        command.readings.advance(stamp, measurement)
        self.journal.messages += count
        self.journal.commands += count
        command.has_sample = True
        self.last_state.take(stamp, measurement, command.slow)
        self.safe_torque.commanded[:] = self.controller.state.torque
        self.states.advance(stamp, count)
        self.samples.relax((stamp - self.last_stamp) * NANOSECOND)
        self._advance_to(stamp)

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
        return self._command.safe_without_state(self.config.sample_time)

    def watch(self) -> Vector | None:
        """Return a torque during a silence, else None; call it every PERIOD."""
        limit = self.config.sample_time + self.config.safety.state_timeout
        silent = self.watchdog.silence(limit)
        if silent == 0.0 or not (self.watchdog.on and self.commanding):
            return None
        return self.time_out(f'no joint state received for {silent:.3g} s')

    def time_out(self, text: str) -> Vector | None:
        """Return the torque of one watchdog period without a joint state."""
        self.held.after_gap = None
        if self.supervisor.phase is not Phase.STARTING:  # which is waiting for a state
            self._command.stop(Reason.STATE_TIMEOUT, text)
        self.watchdog.torques += 1
        return self._command.safe_without_state(PERIOD)

    def end_silence(self) -> None:
        """Record in the journal how many torques the watchdog has commanded."""
        self._command.end_silence()

    def fail(self, text: str) -> Vector | None:
        """Return the torque after an unexpected error."""
        self.held.after_gap = None
        self._command.stop(Reason.FAILED, text)
        return self._command.safe_without_state(self.config.sample_time)

    def _begin_message(self) -> None:
        self.end_silence()
        self._starting.waiting_for = ''
        self.held.after_gap = None
        self._command.has_sample = False
        self.journal.messages += 1

    def _wait_or_stop(self, reason: Reason, text: str) -> None:
        """Do what a state that the law cannot use leads to."""
        if self.supervisor.phase is Phase.STARTING:
            self._starting.wait(text)
        else:
            self._command.stop(reason, text)

    def activate(self) -> None:
        """Take command with the next state, and what was learned before a fault."""
        self._starting.activate()

    def reset(self) -> None:
        """Discard all estimates and faults, and restart with the next state.

        The law goes on to carry what it carries besides the model, or the safe torque does.
        """
        self._starting.reset()

    def prepare(self, positions: Vector) -> None:
        """Plan the start from rest; see `Starting.prepare`."""
        self._starting.prepare(positions)

    def take_over_from(self, torque: Vector) -> None:
        """Start from a torque by which another node holds the arm; see `Starting`."""
        self._starting.take_over_from(torque)

    def check_support(self, measurement: Vector) -> None:
        """Refuse to start if nothing shows what holds a live arm."""
        self._starting.check_support(measurement)

    def refuse(self, error: StartError | MotionError) -> None:
        """Stop before the start, for a reason."""
        self._starting.refuse(error)

    def deactivate(self) -> None:
        """Leave command: the torque ramps to the safe torque."""
        self._command.deactivate()

    def stop(self, reason: Reason, text: str) -> None:
        """Enter the safe stop, unless the law is not in command or about to be."""
        self._command.stop(reason, text)

    def withdraw(self, text: str) -> None:
        """Command nothing until the next reset or activation, for a reason."""
        self._command.withdraw(text)

    def release(self) -> Vector | None:
        """Return the last torque, if any: the safe torque of an arm at rest."""
        return self._command.release()

    def plan(self, command: Trajectory | Target, at: float | None = None) -> Plan:
        """Plan a motion, in any thread, to `adopt`; see `Motions.plan`."""
        return self._motions.plan(command, at)

    def adopt(self, planned: Plan) -> None:
        """Follow a planned motion; see `Motions.adopt`."""
        self._motions.adopt(planned)

    def brake(self) -> float:
        """Bring the reference to rest; see `Motions.brake`."""
        return self._motions.brake()

    def tare(self) -> None:
        """Take the external torque for zero where the arm rests now; see `Findings.tare`."""
        self._findings.tare()

    def load_to_tell(self) -> DriveLoad | None:
        """Return the load to declare to the drives next, None if there is none."""
        return self._loads.next() if self.has_sample else None

    def take_over(self, load: DriveLoad) -> None:
        """Subtract the weight of a load that the drives add from the next state on."""
        self._loads.take(self.config, load)
        centre = list(load.centre)
        self._command.note(EventType.DRIVE_LOAD, mass=load.mass, centre=centre)
        self.held.recent.restart()  # the torques so far met drives without it

    def declare(self, load: DriveLoad) -> None:
        """Let `load_to_tell` lead to this load, whatever is weighed.

        Raises:
            BlfDscError: the drives add no weight.
        """
        self._loads.want(self.config, load)

    @property
    def is_load_told(self) -> bool:
        """Whether the drives have the load of the last `declare`."""
        return self._loads.is_told

    def retune(self, config: ControllerConfig) -> None:
        """Apply a configuration, between two samples."""
        command = self._command
        changed = differences(self.config, config)
        command.note(EventType.PARAMETERS, parameters=changed)
        command.reference.drop_prepared()
        if self.supervisor.running:
            last = self.last_state.measurement
            retuning.apply_bumpless(self.controller, config, self.time, last)
        else:
            retuning.apply(self.controller, config)
        self._loads.take_again()
        command.config = config
        self.calming.configure(config)
        self.samples.set_limits(config.safety)

    def problems(self, config: ControllerConfig) -> list[str]:
        """Return why a configuration cannot be applied now; empty if it can."""
        if not self.supervisor.running:
            return []
        return list(retuning.problems(self.controller, config, self.time))
