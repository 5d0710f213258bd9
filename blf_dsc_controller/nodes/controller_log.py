# SPDX-License-Identifier: Apache-2.0
"""What the controller's node logs of its law: phases, findings and learning, each once."""

from __future__ import annotations

from collections.abc import Mapping

from blf_dsc_controller.configuration.rules import When
from blf_dsc_controller.messages import topics
from blf_dsc_controller.nodes.diagnostics import ControllerStatus
from blf_dsc_controller.nodes.process import PlainNode
from blf_dsc_controller.run import unit_of_all
from blf_dsc_controller.supervision.guard import Guard
from blf_dsc_controller.supervision.supervisor import STAMPS, Phase, Reason
from blf_dsc_controller.warnings.table import config_warnings

NOTHING_COMMANDED = 'nothing is commanded'
"""Begins what is logged of a stop before the first torque."""
WAITS_FOR_RESET = '/reset starts again'
"""Ends what is logged of a stop that the node outlives."""


class ControllerLog:
    """Logs what is new of a guard; it remembers what has been logged.

    Attributes:
        warns_of_gains: whether to warn, once, of gains whose margin nobody has measured.
    """

    def __init__(self, node: PlainNode) -> None:
        """Write to the log of a node."""
        self.warns_of_gains = True
        self._node = node
        self._log = node.get_logger()
        self._phase = Phase.INACTIVE, 0, False, ''  # stops, silenced, text of a stop
        self._turned_at = -1  # ns, start of the last reference shifted by turns
        self._rejected: Mapping[str, str] = {}
        self._model_changes = 0.0
        self._contacts = self._oscillations = 0
        self._untrusted = ''  # sentence about the torque sensors

    def begin(self) -> None:
        """Begin with a new law, which has found nothing yet."""
        self._contacts = self._oscillations = 0

    def log_phase(self, guard: Guard, *, ends: bool) -> None:
        """Log the phase, the cause of a stop, and that the reference is shifted by turns.

        `ends`: whether the node ends by that stop.
        """
        supervisor = guard.supervisor
        is_stopped = supervisor.phase is Phase.SAFE_STOP  # its text may grow
        text = supervisor.text if is_stopped else ''
        now = supervisor.phase, supervisor.stops, guard.silenced, text
        before = self._phase
        if now == before:
            return
        self._phase = now
        if guard.reference.turned and guard.reference.start_stamp != self._turned_at:
            self._turned_at = guard.reference.start_stamp
            self._log.info(f'the reference {guard.reference.turned}')
        if guard.silenced:
            self._log.warning(supervisor.text)
        elif is_stopped:
            self._log_stop(guard, _added(before, now), ends=ends)
        elif supervisor.phase is Phase.APPROACHING:
            left = guard.reference.settled - guard.reference.time
            self._log.info(f'approaching the reference, for {left:.3g} s')
        elif supervisor.phase is Phase.TRACKING:
            self._log.info('tracking the reference')

    def _log_stop(self, guard: Guard, added: str, *, ends: bool) -> None:
        """Log why the law stopped, or what has been `added` to the text of this stop."""
        if added:
            self._log.fatal(f'in this stop: {added}')
            return
        torque = f'{guard.config.safety.torque} torque'
        if not guard.commanding:
            torque = NOTHING_COMMANDED
        after = f'{self._node.get_fully_qualified_name()}{WAITS_FOR_RESET}'
        if ends:
            after = 'this node ends'
        texts = (
            guard.supervisor.text,
            self._several_arms(guard.supervisor.reason),
            after,
        )
        self._log.fatal(f'{torque}: {"; ".join(filter(None, texts))}')

    def _several_arms(self, reason: Reason) -> str:
        """Return who publishes joint states, if the stamps of several have caused a stop."""
        if reason not in STAMPS:
            return ''
        found = self._node.get_publishers_info_by_topic(topics.JOINT_STATES.relative)
        if len(found) < 2:
            return ''
        names = ', '.join(
            f'{each.node_namespace.rstrip("/")}/{each.node_name}' for each in found
        )
        return f'{len(found)} publishers send joint states: {names}: stop all but one'

    def warn_of_findings(self, guard: Guard) -> None:
        """Warn of contacts, oscillations and efforts of no sensors since the last call."""
        contacts = guard.findings.contacts
        if contacts.last is not None and contacts.count != self._contacts:
            self._contacts = contacts.count
            self._log.warning(contacts.last.text)
        if guard.oscillation.count != self._oscillations:
            self._oscillations = guard.oscillation.count
            self._log.warning(guard.oscillation.text)
        if guard.findings.untrusted != self._untrusted:
            self._untrusted = guard.findings.untrusted
            if self._untrusted:
                self._log.warning(self._untrusted)

    def warn_of_start(self, guard: Guard) -> None:
        """Say what matters to a robot, and not to a simulated arm, which waits in lock-step."""
        if guard.watchdog.why_off:
            self._log.warning(guard.watchdog.why_off)
        if self.warns_of_gains:
            for text in config_warnings(guard.config, When.ROBOT):
                self.warns_of_gains = False
                self._log.warning(text)

    def warn_of_learning(self, guard: Guard, status: ControllerStatus) -> bool:
        """Warn of changes of the arm, and of rejected columns, since the last call.

        The columns are in the status, too; return whether it is to be published.
        """
        change = guard.controller.state.change
        has_changed = bool(change.changes[0] > self._model_changes)
        self._model_changes = change.changes[0]
        if has_changed:
            residual = change.contradiction[0] ** 0.5
            unit = unit_of_all(guard.config.units, 'N m')
            self._log.warning(
                f'the arm has changed: torques differ by {residual:.3g} {unit} from those '
                'expected; learning restarts'
            )
        rejected = status.rejected(guard)
        if rejected is self._rejected:
            return has_changed
        self._rejected = rejected
        for reason in rejected.values():
            self._log.warning(reason)
        return has_changed or bool(rejected)


def _added(before: tuple[object, ...], now: tuple[Phase, int, bool, str]) -> str:
    """Return what the text of a stop has more than before; empty for another stop."""
    text = str(before[-1])
    if before[:-1] != now[:-1] or not text or not now[-1].startswith(text):
        return ''
    return now[-1][len(text) :].removeprefix('; ')
