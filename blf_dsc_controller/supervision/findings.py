# SPDX-License-Identifier: Apache-2.0
"""Reactions to what the law detects: contacts, oscillations, wrong sensors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.errors import TareError
from blf_dsc_controller.law.check_state import CONTRADICTION, NOT_SENSORS, OSCILLATES
from blf_dsc_controller.law.contact import is_touched
from blf_dsc_controller.law.sensor import SLOW, is_late
from blf_dsc_controller.messages.journal import EventType
from blf_dsc_controller.supervision import not_sensors
from blf_dsc_controller.supervision.contact import Contacts, contact_of
from blf_dsc_controller.supervision.in_command import InCommand
from blf_dsc_controller.supervision.reading import Reading
from blf_dsc_controller.supervision.state_check import velocity_lag_remedy
from blf_dsc_controller.supervision.supervisor import Fault, Reason

Vector = NDArray[np.float64]


class Findings:
    """Reacts to what the law of one arm has detected.

    Attributes:
        contacts: what has touched the arm.
        untrusted: what is wrong with the efforts that joint torque sensors should show; or empty.
    """

    def __init__(self, command: InCommand) -> None:
        """React to what the law of `command` finds."""
        self.contacts = Contacts()
        self.untrusted = ''
        self._command = command

    def restart(self) -> None:
        """Begin again before a start: the arm no longer holds after a contact."""
        command = self._command
        self.untrusted = not_sensors.text_of(command.controller, command.config)
        self.contacts.hold = False

    def check_efforts(self) -> None:
        """Record that efforts are not those of joint torque sensors, once the law detects it."""
        command, controller = self._command, self._command.controller
        if not controller.flags & NOT_SENSORS:
            return
        joint = command.config.joints[int(controller.state.sensors.joint[0])]
        self.untrusted = not_sensors.text_of(controller, command.config)
        command.samples.compare_efforts()
        command.note(EventType.TORQUE_SENSORS, joint=joint, text=self.untrusted)

    def check_oscillation(self) -> Fault | None:
        """Return the fault of an arm that oscillates, or record what it is warned of."""
        command, check = self._command, self._command.oscillation
        if not (command.controller.flags & OSCILLATES or check.only_warns):
            return None
        before = check.count
        if check.must_stop(command.reference.time):
            return Fault(Reason.OSCILLATION, check.cause)
        if check.last is not None and check.count > before:
            content = check.last._asdict()
            command.note(EventType.OSCILLATION, **content, text=check.text)
        return None

    def react_to_contact(self) -> None:
        """React to a contact of the last sample, as `contact.reaction` says.

        The arm goes on, holds its reference, stops, or yields; the journal has it in each case.
        """
        command = self._command
        reaction = command.config.contact.reaction
        stamp = command.reference.last_stamp
        contact = contact_of(command.controller, command.config, stamp)
        self.contacts.add(contact)
        text = contact.text
        content = contact._asdict()
        del content['stamp']
        command.note(EventType.CONTACT, reaction=reaction, **content)
        if reaction == 'hold':
            command.reference.brake(command.config)
            self.contacts.hold = True
            command.supervisor.add(f'{text}: the reference brakes, and the arm holds')
        elif reaction != 'none':
            command.stop(Reason.CONTACT, text)
            if reaction == 'yield':
                command.hold.yield_to_contact()

    def tare(self) -> None:
        """Take the external torque for zero where the arm rests now.

        Raises:
            TareError: it is not computed, the law is not in command, the arm moves or has
                just come to rest, or something touches it.
        """
        if problem := self._untarable():
            raise TareError(f'tare: {problem}; the external torque is as it was')
        self._command.note(EventType.TARE)
        self._command.controller.tare()

    def _untarable(self) -> str:
        """Return why the external torque cannot be tared now; empty if it can."""
        command = self._command
        law, supervisor = command.controller, command.supervisor
        if not law.settings.contact.enabled:
            return 'no external torque is computed: set contact.enabled'
        if not (supervisor.running and command.has_sample):
            why = supervisor.text or supervisor.phase
            return f'the law is not in command ({why})'
        if is_touched(law.state.contact):
            contact = contact_of(law, command.config, command.reference.last_stamp)
            return f'{contact.text}: clear it first'
        if not (command.is_at_rest and law.can_tare):
            rest = f'{law.tare_rest:.2g} s'
            return f'the arm moves, or has just come to rest: hold it still for {rest}'
        return ''

    def stop_at_invalid(self, reading: Reading) -> None:
        """Stop because of a state that the law has not used."""
        command = self._command
        if command.controller.flags & CONTRADICTION:
            self._distrust_velocities(reading)
            return
        invalid = command.states.invalid(command.config.safety, reading)
        # of an arm that is too fast, why if it oscillates
        cause = command.oscillation.cause if invalid.reason is Reason.VELOCITY else ''
        command.stop(invalid.reason, '; '.join(filter(None, (cause, invalid.text))))

    def compare_velocities(self, reading: Reading) -> None:
        """Distrust velocities that contradict the positions, in a state beside the law."""
        is_next = reading.gap > 0.0 and not reading.is_after_gap
        if not is_next or not np.isfinite((reading.q, reading.dq)).all():
            return
        law = self._command.controller
        if law.compare_velocities(reading.gap, reading.measurement):
            self._distrust_velocities(reading)

    def _distrust_velocities(self, reading: Reading) -> None:
        """Stop, and difference all velocities from the positions from this state on."""
        command = self._command
        sensor = command.controller.checks.sensor
        lags = command.held.recent.velocity_lags
        fault = command.states.contradicted(sensor.derived, sensor.measured, lags)
        worst = int(np.argmax(sensor.mismatch / (sensor.speed + SLOW**2)))
        cause = command.oscillation.cause if command.supervisor.running else ''
        if cause and is_late(sensor, worst):
            lag = lags[worst]
            lag_text = '' if lag is None else velocity_lag_remedy(lag)
            fault = Fault(
                Reason.OSCILLATION, '; '.join(filter(None, (lag_text, cause)))
            )
        if command.supervisor.uses_states:
            command.stop(*fault)
        else:
            command.supervisor.add(fault.text)
            command.hold.start_observing()  # this has let the error grow
        command.readings.difference_velocities(reading)
        # Else the change from the wrong velocity would pass for an acceleration.
        command.readings.last.dq[:] = reading.dq
