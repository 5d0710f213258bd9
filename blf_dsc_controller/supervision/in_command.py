# SPDX-License-Identifier: Apache-2.0
"""The law in command of an arm, or the safe torque in its place; how the law leaves command.

`Supervisor` holds the phase, `Readings` reads joint states, `RunningReference` holds the
reference and the time of the law.  `HeldTorque` finds the torque that holds the arm, from
which `SafeStop` and `Hold` compute the torque without the law.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration import law_file
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import flatten
from blf_dsc_controller.factory.controller import controller_of
from blf_dsc_controller.messages.journal import EventType, Journal
from blf_dsc_controller.reference.approach import AT_REST
from blf_dsc_controller.reference.retargeting import TrajectoryError
from blf_dsc_controller.supervision.envelope_limits import envelope_of
from blf_dsc_controller.supervision.held_torque import HeldTorque
from blf_dsc_controller.supervision.hold import FADE_TIME, Hold
from blf_dsc_controller.supervision.kept_estimates import KeptEstimates
from blf_dsc_controller.supervision.oscillation_check import OscillationCheck
from blf_dsc_controller.supervision.reading import Doubt, Reading, Readings
from blf_dsc_controller.supervision.running_reference import RunningReference
from blf_dsc_controller.supervision.safe_stop import SafeStop
from blf_dsc_controller.supervision.sample_check import SampleCheck
from blf_dsc_controller.supervision.state_check import StateCheck, rate_mismatch
from blf_dsc_controller.supervision.state_watchdog import LONG_SILENCE, Watchdog
from blf_dsc_controller.supervision.supervisor import (
    Doubtful,
    Phase,
    Reason,
    Supervisor,
    is_in_doubt,
)

Vector = NDArray[np.float64]
_MANY = 0.5  # states missed for each that came
# stops of a law that may have begun with a state of another sender
_NOT_ITS_ARM = (Reason.JUMPED, Reason.START_REJECTED)


class InCommand:
    """The law of an arm, the safe torque in its place, and which of the two is in command.

    Attributes:
        config: configuration in force.
        controller: the law.
        supervisor: phase, and the reason of a stop.
        states, samples: the checks before and after the law.
        estimates: those that count for the torque without the law, and for its next start.
        watchdog: the check for missing states.
        journal: events, and counts of what has been processed so far.
        oscillation: what follows from an oscillation, and the last one that is warned of.
        readings: stamps, turns and velocities of the joint states.
        reference: the reference in force, and the time of the law.
        hold: the ramp to the torque that holds the arm without the law.
        envelope: what no law may ask of the arm.
        held: the torque that holds the arm, by its last motion.
        safe_stop: computes the torque while the law is not in command.
        has_sample: whether the law used the last message, so that there is new telemetry.
        silenced: whether nothing is commanded until the next reset or activation.
        clean: whether the window of the law holds valid samples only.
    """

    def __init__(
        self,
        config: ControllerConfig,
        steady: Callable[[], int] = time.monotonic_ns,
        wall: Callable[[], int] = time.time_ns,
    ) -> None:
        """Compile the law; `steady` and `wall` are the clocks [ns]."""
        self.config = config
        self.controller = controller_of(config)
        self.supervisor = Supervisor()
        self.states = StateCheck(config.joints, config.units, config.sample_time)
        self.oscillation = OscillationCheck(config, self.controller)
        self.estimates = KeptEstimates(self.controller)
        self.samples = SampleCheck(
            config, self.controller, self.oscillation, self.estimates
        )
        self.watchdog = Watchdog(steady, wall)
        self.journal = Journal()
        self.has_sample = self.silenced = False
        self.clean = True
        self.readings = Readings(config, self.controller.checks.sensor)
        self.reference = RunningReference(self.controller)
        self.hold = Hold(
            self.readings,
            self.controller.settings,
            self.estimates.estimate,
            config.sample_time,
        )
        self.envelope = envelope_of(config, self.controller.settings)
        self.held = HeldTorque(config, self.controller, self.estimates)
        self.safe_stop = SafeStop(
            config, self.controller, self.estimates, self.hold, self.held
        )
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
    def commanded(self) -> Vector | None:
        """The last torque (n,) [N m]; None before the first one."""
        return self.hold.commanded if self.commanding else None

    @property
    def is_at_rest(self) -> bool:
        """Whether the reference and the arm rest, while the law is in command."""
        signals = self.controller.signals
        speed = np.abs(np.concatenate((signals.dq, signals.dqr))).max()
        return bool(speed < AT_REST)

    @property
    def is_settled(self) -> bool:
        """Whether the arm rests under the safe torque."""
        return not self.supervisor.running and self.hold.is_settled

    def check_running(self) -> None:
        """Raise TrajectoryError if the law is not in command."""
        supervisor = self.supervisor
        if not supervisor.running:
            why = supervisor.text or supervisor.phase
            raise TrajectoryError([f'the controller is not in command: {why}'])

    def note(self, event: EventType, **content: Any) -> None:
        """Record an event in the journal, after what the watchdog has commanded."""
        self.end_silence()
        self.journal.note(event, **content)

    def end_silence(self) -> None:
        """Record in the journal how many torques the watchdog has commanded."""
        if self.watchdog.torques:
            self.journal.note(EventType.SILENCE, torques=self.watchdog.torques)
            self.watchdog.torques = 0

    def start_over(self) -> None:
        """Wait for a state to start from, without the faults so far."""
        self.supervisor.enter(Phase.STARTING)
        self.oscillation.restart()
        self.envelope.restart()
        self.states.restart()
        self.samples.restart()
        self.silenced = self.has_sample = False
        self.clean = True
        self.readings.restart()
        if self.readings.last.age >= FADE_TIME:
            # else a damping torque may have to fade, which a driver must not hold
            self.watchdog.wait()

    def stop(self, reason: Reason, text: str) -> None:
        """Enter the safe stop for a reason, if the law is in command or about to be.

        `text` says what happened and what to do; it is recorded in the journal.
        """
        missed = self.states.missed_per_state
        if missed > _MANY and reason is not Reason.OVERRUN:
            T = self.config.sample_time
            text += f'; {rate_mismatch((1.0 + missed) * T, T)}'
        was_running = self.supervisor.running
        if not self.supervisor.stop(reason, text):
            return
        if is_in_doubt(reason, Doubtful.ESTIMATES):
            self.estimates.return_to_consistent()
        if reason in _NOT_ITS_ARM and self.readings.return_home():
            was_running = False
        self.journal.note(EventType.STOP, reason=reason, text=text)
        self.clean = self.reference.resumable = False
        self.safe_stop.begin(
            reason,
            self.readings.speed,
            was_running=was_running,
            oscillates=was_running and bool(self.oscillation.cause),
        )

    def deactivate(self) -> None:
        """Take the law out of command in order: its torque ramps to the safe torque."""
        self.note(EventType.DEACTIVATE)
        was_running = self.supervisor.running
        self.reference.resumable = was_running
        self.supervisor.enter(Phase.INACTIVE)
        self.samples.relax()
        self.watchdog.restart()
        if was_running:
            self.safe_stop.begin_deactivation(self.config.safety)

    def withdraw(self, text: str) -> None:
        """Command nothing until the next reset or activation, for a reason."""
        self.note(EventType.WITHDRAW, text=text)
        self.silenced = True
        self.supervisor.add(text)

    def withdraw_after_silence(self, gap: float) -> None:
        """Stay silent after a long silence in which the law was not in command.

        Whoever restarted the driver meanwhile may not expect a torque.  `gap` [s] is the time
        since the state before.
        """
        faded = self.readings.last.age >= FADE_TIME
        if not self.silenced and faded and self.commanding and gap > LONG_SILENCE:
            self.withdraw(
                f'joint states are back after {gap:.3g} s, and no torque is commanded until the '
                'next reset or activation'
            )

    def safe(self, dt: float) -> Vector | None:
        """Return the safe torque, `dt` [s] further along the ramp.

        None before the law has commanded any: a controller that never started stays
        silent.
        """
        if not self.commanding:
            return None
        torque = self.hold.advance(self.config.safety, dt)
        self.journal.commands += torque is not None
        missing = self.safe_stop.missing_effect
        if missing and self.supervisor.reason is not Reason.NO_EFFECT:
            self.supervisor.add(missing)
        if swings := self.safe_stop.name_swings():
            self.supervisor.add(swings)
        return torque

    def safe_at(self, reading: Reading) -> Vector | None:
        """Return the safe torque for a state that the law has not used.

        A state in doubt is as good as one that is missing.
        """
        T, last = self.config.sample_time, self.readings.last
        if reading.doubt is not None:
            if reading.doubt is Doubt.OUT_OF_REACH:
                self.readings.return_home()
            last.skip(T)
            return self.safe(T)
        # a gap counts as the states that are missing in it, else the ramp would last longer
        passed = reading.gap - min(last.age, reading.gap)  # without torques sent since
        self.readings.follow(reading)
        self._observe_speed(reading.gap)
        return self.safe(passed if 0.0 < passed < T else T * max(1, round(passed / T)))

    def safe_without_state(self, dt: float) -> Vector | None:
        """Return the safe torque, `dt` [s] later, by the last state."""
        self.has_sample = False
        self.readings.last.miss(dt)
        return self.safe(dt)

    def _observe_speed(self, gap: float) -> None:
        """Return to the load known before if the arm speeds up, `gap` [s] after the last state."""
        if self.supervisor.phase is not Phase.SAFE_STOP:
            return
        speed = self.readings.speed
        if not self.safe_stop.observe_speed(self.config.safety, speed, gap):
            return
        when = 'in the safe stop' if self.commanding else 'while nothing is commanded'
        fastest = int(np.abs(self.readings.velocity).argmax())
        unit = self.config.units[fastest].of('rad/s')
        self.supervisor.add(
            f'the arm speeds up {when}, to {speed:.3g} {unit}: engage the brakes'
        )

    def release(self) -> Vector | None:
        """Return the last torque, if any: the safe torque of an arm at rest."""
        self.note(EventType.RELEASE, resting=bool(self.is_settled))
        self.has_sample = False  # the last torque is not the law's
        if not self.commanding or self.silenced:
            return None
        return self.safe_stop.leave(
            self.config.safety, was_running=self.supervisor.running
        )
