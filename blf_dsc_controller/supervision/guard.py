# SPDX-License-Identifier: Apache-2.0
"""The guarded law: checks before and after the law, and a torque for every joint state.

joint state -> StateCheck -> law -> SampleCheck -> torque
                   |                     |
                   +---- safe torque <---+    until the next reset or activation

Here is what each event leads to, in which order. What is remembered from one to the next
is in its parts: `Supervisor` the phase, `Readings` stamps, turns and velocities,
`RunningReference` what is followed and the time, `Takeover` from which torque the law
begins, `HeldTorque`, `SafeTorque` and `SafeStop` what holds the arm, `Calming` what
oscillates, `Contacts` what touches it, `ToldLoads` what its drives were told.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration import law_file
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import differences, flatten
from blf_dsc_controller.errors import BlfDscError, StartError, TareError
from blf_dsc_controller.factory.controller import controller_of
from blf_dsc_controller.law.check_state import (
    CONTRADICTION,
    INVALID,
    NOT_SENSORS,
    OSCILLATES,
)
from blf_dsc_controller.law.checks import is_valid_state
from blf_dsc_controller.law.sensor import SLOW, is_late
from blf_dsc_controller.messages.errors import (
    DuplicatedJointError,
    MessageError,
    MissingJointError,
    ShortArrayError,
)
from blf_dsc_controller.messages.journal import (
    EventType,
    Journal,
)
from blf_dsc_controller.reference.approach import (
    AT_REST,
    MotionError,
)
from blf_dsc_controller.reference.retargeting import (
    Target,
    TrajectoryError,
)
from blf_dsc_controller.reference.trajectory import Trajectory
from blf_dsc_controller.run import NANOSECOND
from blf_dsc_controller.supervision import not_sensors, retuning
from blf_dsc_controller.supervision.calming import Calming
from blf_dsc_controller.supervision.contact import Contacts, contact_of, untarable
from blf_dsc_controller.supervision.drive_load import DriveLoad
from blf_dsc_controller.supervision.held_torque import HeldTorque
from blf_dsc_controller.supervision.last_state import LastState
from blf_dsc_controller.supervision.plan import Plan, plan_motion
from blf_dsc_controller.supervision.readings import Readings
from blf_dsc_controller.supervision.running_reference import RunningReference
from blf_dsc_controller.supervision.safe_stop import WINDING_UP, SafeStop
from blf_dsc_controller.supervision.safe_torque import SafeTorque
from blf_dsc_controller.supervision.sample_check import SampleCheck
from blf_dsc_controller.supervision.state_check import (
    LONG_GAP,
    SKIP,
    StateCheck,
    rate_mismatch,
)
from blf_dsc_controller.supervision.state_watchdog import LONG_SILENCE, PERIOD, Watchdog
from blf_dsc_controller.supervision.supervisor import Fault, Phase, Reason, Supervisor
from blf_dsc_controller.supervision.support import check_support
from blf_dsc_controller.supervision.takeover import Takeover
from blf_dsc_controller.supervision.told_loads import ToldLoads

Vector = NDArray[np.float64]
_MANY = 0.5  # states missed for each that came
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
        config: configuration in force.
        controller: the law.
        supervisor: phase, and the reason of a stop.
        states, samples: the checks before and after the law.
        watchdog: the check for missing states.
        journal: events, and counts of what has been processed so far.
        has_sample: whether the law used the last message, so that there is new telemetry.
        start_error: why the law could not start; None if it could.
        waiting_for: what is wrong with the last state that the law could not start from; or empty.
        contacts: what has touched the arm.
        untrusted: what is wrong with the efforts that joint torque sensors should show; or empty.
        calming: what oscillates, and how much softer the feedback is since.
        silenced: whether nothing is commanded until the next reset or activation.
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
        n = len(config.joints)
        self._n = n
        self.config = config
        self.controller = controller_of(config)
        self.supervisor = Supervisor()
        self.states = StateCheck(config.joints, config.sample_time)
        self.calming = Calming(config, self.controller)
        self.samples = SampleCheck(config, self.controller, self.calming)
        self.watchdog = Watchdog(steady, wall)
        self.journal = Journal()
        self.has_sample = False
        self.start_error: BlfDscError | None = None
        self.waiting_for = self.untrusted = ''
        self.contacts = Contacts()
        self.silenced = False
        self.foreign = 0
        self.compute_time = 0.0
        self._readings = Readings(config, self.controller)
        self._reference = RunningReference(self.controller)
        self._loads = ToldLoads(config, self.controller)
        self._safe_torque = SafeTorque(n)
        self._safe_torque.scale = self.controller.state.rotors.gain_scale
        sensor = self.controller.checks.sensor
        self._safe_torque.noise = sensor.noise[:n]
        self._safe_torque.resolution = sensor.resolution
        self._held = HeldTorque(config, self.controller, self.samples)
        self._safe_stop = SafeStop(
            config, self.controller, self.samples, self._safe_torque, self._held
        )
        self._takeover = Takeover(self.controller, self._reference, self._held)
        self._clean = True  # whether the window holds valid samples only
        digest = (
            {'law_digest': law_file.digest(config.law)}
            if law_file.is_file(config.law)
            else {}
        )
        self.journal.note(EventType.CONFIGURE, parameters=flatten(config), **digest)

    @property
    def commanding(self) -> bool:
        """Whether a torque has been commanded since the controller was configured."""
        return self.journal.commands > 0

    @property
    def start_stamp(self) -> int:
        """Stamp of t = 0 [ns]; -1 before the first start."""
        return self._reference.start_stamp

    @property
    def last_stamp(self) -> int:
        """Stamp of the law's last sample [ns]."""
        return self._reference.last_stamp

    @property
    def time(self) -> float:
        """Time of the last sample of the law [s]."""
        return self._reference.time

    @property
    def settled(self) -> float:
        """End of the approach or of the blend into a trajectory [s]."""
        return self._reference.settled

    @property
    def turned(self) -> str:
        """How the configured reference is shifted by whole turns; empty if it is not."""
        return self._reference.turned

    @property
    def last_state(self) -> LastState:
        """The last usable joint state."""
        return self._safe_torque.last

    def update(self, stamp: int, measurement: Vector) -> Vector | None:
        """Return the torque for a joint state, with its stamp [ns]; None: no command.

        `measurement` is [q (n,) rad, dq (n,) rad/s, applied torque of the last interval
        (n,) N m].
        """
        self._begin_message()
        gap = (stamp - self.journal.stamp) * NANOSECOND
        self.journal.stamp = stamp
        self._readings.take_stamp(stamp)
        self.watchdog.restart()
        measurement, wrapped = self._counted(measurement)
        self._readings.replace_velocities(stamp, measurement)
        if self._readings.is_after_gap:
            self._held.after_gap = measurement
        if self.supervisor.uses_states:
            fault = self.states.check(self.config.safety, stamp)
            if fault is SKIP:
                return None
            fault = fault or wrapped
            if fault is None and self.supervisor.running:
                fault = self._clock_step(measurement)
            if fault is None:
                return self._use(stamp, measurement)
            if self.supervisor.phase is Phase.STARTING:
                self._wait(fault.text)
            else:
                self._stop(*fault)
        else:
            self._withdraw_after_silence(gap)
            if self.silenced:
                return None
        return self._safe_at(stamp, measurement)

    def _counted(self, measurement: Vector) -> tuple[Vector, Fault | None]:
        """Return a measurement with turns counted on, and a wrap that cannot be one."""
        fastest = self.config.safety.velocity_limit
        counted, wrapped = self._readings.count_turns(measurement, fastest)
        if wrapped is not None and self.supervisor.phase is Phase.STARTING:
            self._readings.believe_positions()
        return counted, wrapped

    def _withdraw_after_silence(self, gap: float) -> None:
        """Stay silent after a long silence in which the law was not in command.

        By then the safe torque has faded to zero, and whoever restarted the driver may
        not expect another. `gap` [s] is the time since the state before.
        """
        faded = self._safe_torque.last.age >= self.config.safety.fade_time
        if not self.silenced and faded and self.commanding and gap > LONG_SILENCE:
            self.withdraw(
                f'joint states are back after {gap:.3g} s, and no torque is commanded until the '
                'next reset or activation'
            )

    def withdraw(self, text: str) -> None:
        """Command nothing until the next reset or activation, for a reason."""
        self._note(EventType.WITHDRAW, text=text)
        self.silenced = True
        self.supervisor.add(text)

    def _with_cause(self, fault: Fault) -> Fault:
        """Return the fault of an arm that is too fast, and why if it oscillates."""
        cause = self.calming.cause if fault.reason is Reason.VELOCITY else ''
        return fault._replace(text='; '.join(filter(None, (cause, fault.text))))

    def _clock_step(self, measurement: Vector) -> Fault | None:
        """Return the fault of a clock that was set while the arm moved."""
        last = self._safe_torque.last
        gap = self._readings.gap
        if gap < LONG_GAP * self.config.sample_time or last.age > 0.0:
            return None
        q, dq, _ = measurement.reshape(3, -1)
        mean = 0.5 * (dq + last.dq)
        if np.abs(dq - last.dq).max() > _CHANGED * np.abs(mean).max():
            return None  # it has been braked or driven on: the time has passed
        return self.states.clock_step(gap, q - last.q, mean)

    def _use(self, stamp: int, measurement: Vector) -> Vector | None:
        """Pass a state to the law, or stop if the law finds it invalid."""
        law = self.controller
        last = self._safe_torque.last
        is_first = self.supervisor.phase is Phase.STARTING
        if is_first:
            if not is_valid_state(law.checks, measurement):
                self._wait(self.states.invalid(self.config.safety, measurement).text)
                return self._safe_at(stamp, measurement)
            self._forget_load_after_gap(stamp, measurement)
            last.take(stamp, measurement, self._slow)
            if not self._start(stamp, measurement):
                return self._safe(self.config.sample_time)
        elif self._held.after_gap is not None and not self._rejoin(stamp, measurement):
            return self._safe_at(stamp, measurement)
        dt = (stamp - self.last_stamp) * NANOSECOND
        before = perf_counter()
        torque = law.update(self._reference.time_of(stamp), dt, measurement)
        self.compute_time = perf_counter() - before
        if law.flags & INVALID:
            self._stop_at_invalid(stamp, measurement)
            return self._safe_at(stamp, measurement)
        last.take(stamp, measurement, self._slow)
        self._advance_to(stamp)
        self._distrust_efforts()
        fault = self.samples.check(dt) or self._calm()
        if fault is not None:
            self._stop(*fault)
            return self._safe(self.config.sample_time)
        self._safe_torque.commanded[:] = torque
        self._held.recent.take(stamp, measurement, torque)
        self.has_sample = True
        self.journal.commands += 1
        return torque

    def _forget_load_after_gap(self, stamp: int, measurement: Vector) -> None:
        """Carry nothing on in a state that does not follow the last one: others may hold it."""
        fastest, period = self.config.safety.velocity_limit, self.config.sample_time
        q = measurement[: self._n]
        if not self._safe_torque.last.leads_to(stamp, q, fastest, period):
            self._takeover.carried = None

    def _stop_at_invalid(self, stamp: int, measurement: Vector) -> None:
        """Stop because of a state that the law has not used."""
        if self.controller.flags & CONTRADICTION:
            self._distrust_velocities(stamp, measurement)
        else:
            invalid = self.states.invalid(self.config.safety, measurement)
            self._stop(*self._with_cause(invalid))

    def _distrust_efforts(self) -> None:
        """Tell that efforts are not those of joint torque sensors, when the law finds it."""
        if not self.controller.flags & NOT_SENSORS:
            return
        joint = not_sensors.joint_of(self.controller, self.config.joints)
        self.untrusted = not_sensors.text_of(self.controller, self.config.joints)
        self.samples.compare_efforts()
        self._note(EventType.TORQUE_SENSORS, joint=joint, text=self.untrusted)

    def _calm(self) -> Fault | None:
        """Soften the feedback of an arm that oscillates; a fault if that has not helped."""
        if not self.controller.flags & OSCILLATES:
            return None
        calming, before = self.calming, self.calming.count
        if not calming.react(self.time):
            return Fault(Reason.OSCILLATION, calming.cause)
        if calming.last is not None and calming.count > before:
            self._note(
                EventType.OSCILLATION,
                **calming.last._asdict(),
                share=calming.share,
                text=calming.text,
            )
        return None

    def load_to_tell(self) -> DriveLoad | None:
        """Return the load to declare to the drives next, None if there is none."""
        return self._loads.next() if self.has_sample else None

    def take_over(self, load: DriveLoad) -> None:
        """Subtract the weight of a load that the drives add from the next state on."""
        self._loads.take(self.config, load)
        self._note(EventType.DRIVE_LOAD, mass=load.mass, centre=list(load.centre))
        self._held.recent.restart()  # the torques so far met drives without it

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

    def perceive(self) -> None:
        """Weigh what the tip holds, and detect contact, by the last state.

        Call it after its torque has been sent.
        """
        if self.has_sample and self.controller.perceive(self.config.sample_time):
            self._react()

    def tare(self) -> None:
        """Take the external torque for zero where the arm rests now.

        Raises:
            TareError: it is not computed, the law is not in command, the arm moves or has
                just come to rest, or something touches it.
        """
        if problem := self._untarable():
            raise TareError(f'tare: {problem}; the external torque is as it was')
        self._note(EventType.TARE)
        self.controller.tare()

    def _untarable(self) -> str:
        """Return why the external torque cannot be tared now; empty if it can."""
        law = self.controller
        if not law.settings.contact.enabled:
            return 'no external torque is computed: set contact.enabled'
        if not (self.supervisor.running and self.has_sample):
            why = self.supervisor.text or self.supervisor.phase
            return f'the law is not in command ({why})'
        return untarable(law, self.config, self.last_stamp, rests=self.is_at_rest)

    def _react(self) -> None:
        """Do what `contact.reaction` wants when something touches the arm."""
        reaction = self.config.contact.reaction
        contact = contact_of(self.controller, self.config, self.last_stamp)
        self.contacts.add(contact)
        text = contact.text
        content = contact._asdict()
        del content['stamp']
        self._note(EventType.CONTACT, reaction=reaction, **content)
        if reaction == 'hold':
            self._reference.brake(self.config)
            self.contacts.hold = True
            self.supervisor.add(f'{text}: the reference brakes, and the arm holds')
        elif reaction != 'none':
            self._stop(Reason.CONTACT, text)
            if reaction == 'yield':
                self._safe_torque.yield_to_contact()

    def _wait(self, problem: str) -> None:
        """Go on waiting for a state to start from."""
        self.waiting_for = problem
        self.states.restart()

    def _safe_at(self, stamp: int, measurement: Vector) -> Vector | None:
        """Return the safe torque for a state that the law has not used."""
        self._compare_velocities(stamp, measurement)
        limit = self.config.safety.velocity_limit
        dt = self.config.sample_time
        self._safe_torque.last.take_usable(stamp, measurement, limit, dt)
        self._observe_speed()
        return self._safe(dt)

    def observe(self, stamp: int, measurement: Vector) -> None:
        """Compare velocities with positions for a state that is held back."""
        self._readings.take_stamp(stamp)
        self._compare_velocities(stamp, self._counted(measurement)[0])

    def _compare_velocities(self, stamp: int, measurement: Vector) -> None:
        if self._readings.compare_velocities(measurement):
            self._distrust_velocities(stamp, measurement)

    def _distrust_velocities(self, stamp: int, measurement: Vector) -> None:
        """Stop, and difference all velocities from the positions from this state on."""
        checks = self.controller.checks
        sensor = checks.sensor
        fault = self.states.contradicted(sensor.derived, sensor.measured)
        worst = int(np.argmax(sensor.mismatch / (sensor.speed + SLOW**2)))
        cause = self.calming.cause if self.supervisor.running else ''
        if cause and is_late(sensor, worst):
            fault = Fault(Reason.OSCILLATION, cause)
        if self.supervisor.uses_states:
            self._stop(*fault)
        else:
            self.supervisor.add(fault.text)
            self._safe_torque.start_observing()  # this has let the error grow
        self._readings.distrust_velocities(stamp, measurement)
        # What the wrong velocities showed of the rotors is as wrong.
        self.controller.state.rotors.gain_scale[:] = checks.estimates.consistent_scale
        # Else the change from the wrong velocity would pass for an acceleration.
        self._safe_torque.last.dq[:] = measurement[self._n : -self._n]

    def _observe_speed(self) -> None:
        """Return to the load known before if the arm speeds up in the safe stop."""
        if self.supervisor.phase is not Phase.SAFE_STOP:
            return
        speed, gap = self._readings.speed, self._readings.gap
        text = self._safe_stop.observe_speed(self.config.safety, speed, gap)
        if text:
            self.supervisor.add(text)

    def _start(self, stamp: int, measurement: Vector) -> bool:
        """Resume the running reference if possible, otherwise start at t = 0."""
        last = self._safe_torque.commanded if self.commanding else None
        try:
            resumed = self._takeover.start(self.config, stamp, measurement, last)
        except (StartError, MotionError) as error:
            self.refuse(error)
            return False
        self._take_command(stamp, resumed=resumed)
        return True

    def _take_command(self, stamp: int, *, resumed: bool) -> None:
        """Go on from a start, or from the return to the reference, with this state."""
        self.journal.note(EventType.START, resumed=resumed)
        self._reference.last_stamp = stamp - self.config.sample_time_ns
        self._takeover.acting = self._takeover.carried = None
        self._held.recent.restart()
        self.watchdog.switch(self.config.safety.watchdog, stamp)
        self.supervisor.enter(Phase.APPROACHING)

    def take_over_from(self, torque: Vector) -> None:
        """Start from a torque (n,) [N m] by which another node holds the arm.

        The watchdog does so after a controller has died.  The first torque continues this
        one, and what it carries besides the model is held from the start.
        """
        self._note(EventType.TAKEOVER, torque=torque.tolist())
        self._takeover.acting = torque.copy()

    def prepare(self, positions: Vector) -> None:
        """Plan the start from rest at `positions` (n,) [rad], before the first state.

        The first torque is then ready within a sample.  If the arm is elsewhere by
        then, the start is planned again.

        Raises:
            StartError: the law cannot take over there.
            MotionError: no approach from there keeps the limits.
        """
        self._reference.prepare(self.config, positions)
        self._note(EventType.PREPARE, positions=positions.tolist())

    def check_support(self, measurement: Vector) -> None:
        """Refuse to start if nothing shows what holds a live arm."""
        if not self.commanding:
            try:
                check_support(self.controller, self.config, measurement)
            except StartError as error:
                self.refuse(error)

    def refuse(self, error: StartError | MotionError) -> None:
        """Stop before the start, for a reason."""
        self.start_error = error
        self._stop(Reason.START_REJECTED, str(error))

    def _rejoin(self, stamp: int, measurement: Vector) -> bool:
        """Return to the reference from where the arm is after a gap, or stop if it is too far.

        Whoever commanded it meanwhile may have braked it.  Without `safety.error_ratio` the
        law goes on instead.  Of an invalid state, the law says what is wrong.
        """
        if not is_valid_state(self.controller.checks, measurement):
            return True
        last = self._safe_torque.commanded if self.commanding else None
        if self._takeover.rejoin(self.config, stamp, measurement, last):
            self._take_command(stamp, resumed=True)
            return True
        if self.config.safety.error_ratio == 0.0:
            return True  # no error stops this arm
        text = (
            f'no joint state came for {self._readings.gap:.3g} s, and the arm is too far from its '
            'reference now'
        )
        self._stop(Reason.STAMP_JUMP, text)
        return False

    def _advance_to(self, stamp: int) -> None:
        self._reference.last_stamp = stamp
        if self.supervisor.phase is Phase.APPROACHING and self.time >= self.settled:
            self.supervisor.enter(Phase.TRACKING)

    def advance(
        self, stamps: Vector, measurements: np.ndarray, torques: np.ndarray
    ) -> None:
        """Advance by k states, all used by the law, with their stamps (k,) [ns].

        `measurements` (k, 3n) and `torques` (k, n) [N m] have a row for each.  All checks
        passed, and `samples.ratio` and the kept estimates are up to date.
        """
        self._held.after_gap = None
        for k in range(max(0, stamps.size - self._held.recent.size), stamps.size):
            self._held.recent.take(int(stamps[k]), measurements[k], torques[k])
        count, stamp, measurement = stamps.size, int(stamps[-1]), measurements[-1]
        self.journal.stamp = stamp
        self._readings.advance(stamp, measurement)
        self.journal.messages += count
        self.journal.commands += count
        self.has_sample = True
        self._safe_torque.last.take(stamp, measurement, self._slow)
        self._safe_torque.commanded[:] = self.controller.state.torque
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
        if self.supervisor.phase is Phase.STARTING:
            self._wait(str(error))
        else:
            self._stop(_REASONS.get(type(error), Reason.BAD_MESSAGE), str(error))
        return self._safe_without_state(self.config.sample_time)

    def watch(self) -> Vector | None:
        """Return a torque during a silence, else None; call it every PERIOD."""
        limit = self.config.sample_time + self.config.safety.state_timeout
        silent = self.watchdog.silence(limit)
        if silent == 0.0 or not (self.watchdog.on and self.commanding):
            return None
        return self.time_out(f'no joint state received for {silent:.3g} s')

    def time_out(self, text: str) -> Vector | None:
        """Return the torque of one watchdog period without a joint state."""
        self._held.after_gap = None
        if self.supervisor.phase is not Phase.STARTING:  # which is waiting for a state
            self._stop(Reason.STATE_TIMEOUT, text)
        self.watchdog.torques += 1
        return self._safe_without_state(PERIOD)

    def end_silence(self) -> None:
        """Record in the journal how many torques the watchdog has commanded."""
        if self.watchdog.torques:
            self.journal.note(EventType.SILENCE, torques=self.watchdog.torques)
            self.watchdog.torques = 0

    def fail(self, text: str) -> Vector | None:
        """Return the torque after an unexpected error."""
        self._held.after_gap = None
        self._stop(Reason.FAILED, text)
        return self._safe_without_state(self.config.sample_time)

    def _begin_message(self) -> None:
        self.end_silence()
        self.waiting_for = ''
        self._held.after_gap = None
        self.has_sample = False
        self.journal.messages += 1

    @property
    def _slow(self) -> Vector:
        """Velocities (n,) [rad/s] to be damped in a stop."""
        return self._readings.slow(self.config.safety.velocity_limit)

    def _stop(self, reason: Reason, text: str) -> None:
        missed = self.states.missed_for_each
        if missed > _MANY and reason is not Reason.OVERRUN:
            T = self.config.sample_time
            text += f'; {rate_mismatch((1.0 + missed) * T, T)}'
        was_running = self.supervisor.running
        if not self.supervisor.stop(reason, text):
            return
        if was_running and reason in WINDING_UP:
            self.samples.return_to_consistent()
        self.journal.note(EventType.STOP, reason=reason, text=text)
        self._clean = self._reference.resumable = False
        self._safe_stop.begin(
            self.config.safety,
            reason,
            self._readings.speed,
            was_running=was_running,
            oscillates=was_running and bool(self.calming.cause),
        )

    def _safe_without_state(self, dt: float) -> Vector | None:
        self.has_sample = False
        self._safe_torque.last.miss(dt)
        return self._safe(dt)

    def _safe(self, dt: float) -> Vector | None:
        """Return the safe torque, `dt` [s] further along the ramp.

        None before the law has commanded any: a controller that never started stays
        silent.
        """
        if not self.commanding:
            return None
        torque = self._safe_stop.advance(self.config.safety, dt)
        self.journal.commands += torque is not None
        missing = self._safe_stop.missing_effect
        if missing and self.supervisor.reason is not Reason.NO_EFFECT:
            self.supervisor.add(missing)
        if swings := self._safe_stop.name_swings():
            self.supervisor.add(swings)
        return torque

    def activate(self) -> None:
        """Take command with the next state, and what was learned before a fault."""
        self._note(EventType.ACTIVATE)
        if self._clean:
            self.controller.state.samples[0] = 0.0
        else:
            self.samples.restore()
        self._start_over()
        self.watchdog.restart()

    def deactivate(self) -> None:
        """Leave command: the torque ramps to the safe torque."""
        self._note(EventType.DEACTIVATE)
        was_running = self.supervisor.running
        self._reference.resumable = was_running
        self.supervisor.enter(Phase.INACTIVE)
        self.samples.relax()
        self.watchdog.restart()
        if was_running:
            self._safe_stop.begin_deactivation(self.config.safety)

    def reset(self) -> None:
        """Discard all estimates and faults, and restart with the next state.

        The law goes on to carry what it carries besides the model, or the safe torque does.
        """
        self._note(EventType.RESET)
        load = self._carried()
        self._reference.resumable = False
        self.controller.reset()
        self._loads.forget()
        self.samples.keep()
        self._start_over()
        self._takeover.carried = load
        if load is not None:
            self._safe_stop.begin_anew(self.config.safety, load)

    def _carried(self) -> Vector | None:
        """Return the load (n,) [N m] besides the initial estimate that is carried now, if any."""
        if self.supervisor.running:
            return self._held.load_before_learning()
        if self.supervisor.phase is Phase.STARTING:
            return self._takeover.carried  # of a reset just before
        if not self.commanding or self.silenced:
            return None
        return self._safe_stop.carried(self.config.safety)

    def plan(self, command: Trajectory | Target, at: float | None = None) -> Plan:
        """Plan a motion, in any thread, to `adopt` by the time `at` [s] (now).

        Raises:
            TrajectoryError: it cannot be followed.
        """
        self._check_running()
        at = self.time if at is None else at
        before = self.controller.reference_vector
        return plan_motion(command, before, at, self.config)

    def adopt(self, planned: Plan) -> None:
        """Follow a planned motion.

        Raises:
            LatePlanError: it begins in the past.
            TrajectoryError: it does not continue the current reference, which stays in force.
        """
        self._check_running()
        planned.check(self.controller.reference_vector, self.time)
        if isinstance(planned.command, Target):
            self._adopt_target(planned)
            return
        self.end_silence()
        self.journal.add(EventType.TRAJECTORY, planned.content)
        self._reference.follow(planned.motion.vector)
        self.contacts.hold = False
        self._reference.settled = planned.motion.settled
        is_settled = self.settled <= self.time
        self.supervisor.enter(Phase.TRACKING if is_settled else Phase.APPROACHING)

    def _adopt_target(self, planned: Plan) -> None:
        """Follow a target; raise TrajectoryError if the arm holds after a contact."""
        self.contacts.check_target()
        self._note(EventType.TARGET, **planned.content)
        self._reference.follow(planned.motion.vector)

    def brake(self) -> float:
        """Bring the reference to rest within the limits; return when it rests [s].

        Raises:
            TrajectoryError: the controller is not in command.
        """
        self._check_running()
        self._note(EventType.BRAKE)
        return self._reference.brake(self.config)

    def retune(self, config: ControllerConfig) -> None:
        """Apply a configuration, between two samples."""
        self._note(EventType.PARAMETERS, parameters=differences(self.config, config))
        self._reference.drop_prepared()
        if self.supervisor.running:
            last = self._safe_torque.last.measurement
            retuning.apply_bumpless(self.controller, config, self.time, last)
        else:
            retuning.apply(self.controller, config)
        self._loads.take_again()
        self.config = config
        self.calming.configure(config)
        self.samples.set_limits(config.safety)

    def problems(self, config: ControllerConfig) -> list[str]:
        """Return why a configuration cannot be applied now; empty if it can."""
        if not self.supervisor.running:
            return []
        return list(retuning.problems(self.controller, config, self.time))

    @property
    def is_at_rest(self) -> bool:
        """Whether the reference and the arm rest, while the law is in command."""
        signals = self.controller.signals
        speed = np.abs(np.concatenate((signals.dq, signals.dqr))).max()
        return bool(speed < AT_REST)

    @property
    def is_settled(self) -> bool:
        """Whether the arm rests under the safe torque."""
        return not self.supervisor.running and self._safe_torque.is_settled

    def release(self) -> Vector | None:
        """Return the last torque, if any: the safe torque of an arm at rest."""
        self._note(EventType.RELEASE, resting=bool(self.is_settled))
        self.has_sample = False  # the last torque is not the law's
        if not self.commanding or self.silenced:
            return None
        return self._safe_stop.leave(
            self.config.safety, was_running=self.supervisor.running
        )

    def _note(self, event: EventType, **content: Any) -> None:
        self.end_silence()
        self.journal.note(event, **content)

    def _start_over(self) -> None:
        self.supervisor.enter(Phase.STARTING)
        self.calming.restart()
        self.untrusted = not_sensors.text_of(self.controller, self.config.joints)
        self.states.restart()
        self.samples.restart()
        self.start_error = None
        self._takeover.acting = self._takeover.carried = None
        self.silenced = self.contacts.hold = False
        self.has_sample = False
        self._clean = True
        self._readings.restart()
        if self._safe_torque.last.age >= self.config.safety.fade_time:
            # else a torque may have to fade, which a driver must not hold
            self.watchdog.wait()

    def _check_running(self) -> None:
        supervisor = self.supervisor
        if not supervisor.running:
            why = supervisor.text or supervisor.phase
            raise TrajectoryError([f'the controller is not in command: {why}'])
