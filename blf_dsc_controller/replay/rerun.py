# SPDX-License-Identifier: Apache-2.0
"""The guarded controller on recorded joint states, with every event of its journal.

The journal states how many joint-state messages were processed before an event, and the stamp of
the last. If the bag holds as many in between, each is processed again. If it holds more, the
middleware has dropped some (in real time): the telemetry shows which ones the law used; out of
command all are used, and the torques are compared as long as they match.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from blf_dsc_controller.bags.topic_messages import JointStates
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.messages.cdr import MessageError
from blf_dsc_controller.messages.journal import Event, EventType
from blf_dsc_controller.messages.topics import FOREVER, TRACKING_ERROR
from blf_dsc_controller.reference.trajectory import Trajectory, TrajectoryError, TrajectoryPoint
from blf_dsc_controller.replay.comparison import Difference
from blf_dsc_controller.replay.outputs import Outputs
from blf_dsc_controller.run import Floats, Stamps
from blf_dsc_controller.supervision.guard import Guard
from blf_dsc_controller.supervision.supervisor import Phase, Reason

_UNREADABLE = frozenset(
    (Reason.BAD_MESSAGE, Reason.JOINT_MISSING, Reason.JOINT_DUPLICATED, Reason.FIELD_MISSING)
)


class Rerun:
    """Replay of the guarded controller.

    Attributes:
        events: replayed events.
        outputs: replayed samples and torques.
        passed_over: number of joint states that the law did not use.
        departure: where the controller departed from the journal, which ends the replay.
        end: any other reason why the replay ended before the bag, or empty.
    """

    def __init__(
        self,
        config: ControllerConfig,
        states: JointStates,
        errors: Mapping[int, MessageError],
        sampled: Stamps | None,
    ) -> None:
        """Start with `config`.

        `errors` maps the number of each unreadable joint state to its error; `sampled` are the
        stamps [ns] with telemetry, None if there is no telemetry.
        """
        self.events: list[Event] = []
        self.passed_over = 0
        self.departure: Difference | None = None
        self.end = ''
        self._guard = Guard(config, lambda: 0, lambda: 0)
        self._guard.journal.pending.clear()
        self._states, self._errors = states, errors
        self._stamps = states.stamp.tolist()
        self.outputs = Outputs(self._guard, len(self._stamps))
        self._sampled = None if sampled is None else frozenset(sampled.tolist())
        lost = np.setdiff1d([] if sampled is None else sampled, states.stamp)
        self._lost = int(lost[0]) if lost.size else FOREVER
        self._position = -1  # number of the last joint state handled so far
        self._messages = 0  # processed by then, according to the journal
        self._failed = False

    def run(self, events: Sequence[Event], *, in_step: bool) -> None:
        """Process the joint states with the events after the configuration, in order.

        `in_step`: the plant waited for each command, so that no state was dropped at the end.
        """
        for event in events:
            if event.number != len(self.events) + 1:
                self.end = 'an event of the journal is not in the bag'
                return
            end, is_exact = self._locate(event)
            self._feed(event, end, is_exact=is_exact)
            if self._is_over:
                return
            self._repeat(event, is_exact=is_exact)
            self.events.append(event)
            if self._is_over or event.type is EventType.RELEASE:
                return
        self._feed(None, len(self._stamps) - 1, is_exact=in_step)

    @property
    def _is_over(self) -> bool:
        return bool(self.end or self.departure)

    # Between two events.

    def _locate(self, event: Event) -> tuple[int, bool]:
        """Return the number of the last joint state before an event; True if none was dropped."""
        stamps, processed = self._stamps, event.messages - self._messages
        self._messages = event.messages
        end = self._position + processed
        if processed == 0 or (end < len(stamps) and self._seen(end) == event.stamp):
            return end, True
        is_unreadable = _reason(event) in _UNREADABLE
        for k in range(self._position + 1, len(stamps)):
            is_it = (k in self._errors) == is_unreadable and self._seen(k) == event.stamp
            if is_it and (k >= end or stamps[k + 1 : k + 2] != [event.stamp]):
                return k, False
        if self.outputs.last >= 0:
            self.end = f'the state with stamp {event.stamp} ns was received but is not in the bag'
        return self._position, False

    def _seen(self, k: int) -> int:
        """Return the stamp of the last readable state up to number k."""
        while k in self._errors:
            k -= 1
        return self._stamps[k] if k >= 0 else -1

    def _feed(self, event: Event | None, end: int, *, is_exact: bool) -> None:
        """Process the joint states up to number `end`, before an event."""
        for k in range(self._position + 1, end + 1):
            if self._is_over:
                return
            if k == end and _reason(event) is Reason.FAILED:
                continue  # nothing shows how far the law got with this state
            is_certain = event and (is_exact or k == end or self._stamps[k] == event.stamp)
            if is_certain or self._was_used(k):
                self._process(k, event, is_exact=is_exact)
            else:
                self.passed_over += 1
        self._position = end

    def _was_used(self, k: int) -> bool:
        """Return whether the recorded controller processed a state that it may have missed."""
        stamp = self._stamps[k]
        if not self._guard.supervisor.uses_states:
            return True
        if k in self._errors or stamp == self.outputs.last:
            return False
        is_starting = self._guard.supervisor.phase is Phase.STARTING
        return not is_starting and (self._sampled is None or stamp in self._sampled)

    def _process(self, k: int, event: Event | None, *, is_exact: bool) -> None:
        guard, stamp = self._guard, self._stamps[k]
        if k in self._errors:
            torque = guard.reject(self._errors[k])
            self._command(guard.journal.stamp, torque, is_exact=is_exact)
        elif guard.supervisor.uses_states and stamp > self._lost:
            self.end = f'the state with stamp {self._lost} ns was used but is not in the bag'
        else:
            is_new = stamp > self.outputs.last and stamp in (self._sampled or ())
            is_due = guard.supervisor.uses_states and is_new
            torque = guard.update(stamp, self._states.values[k].ravel())
            if guard.has_sample:
                if stamp <= self.outputs.last:
                    self.end = f'the stamps restart at {stamp} ns'
                    return
                self.outputs.add_sample(stamp)
            self._command(stamp, torque, is_exact=is_exact)
            if is_due and not guard.has_sample and not _stops_at(event, stamp):
                self._depart(f'used by the law ({guard.supervisor.text})', stamp)
        pending = guard.journal.pending
        if pending and _key(pending[0]) != _key(event):
            self._report_departure(pending[0], event)

    def _command(self, stamp: int, torque: Floats | None, *, is_exact: bool) -> None:
        if torque is not None:
            self.outputs.add_command(stamp, torque, is_exact=is_exact and not self._failed)

    # Events.

    def _repeat(self, event: Event, *, is_exact: bool) -> None:
        """Repeat an event, or check that the controller has produced it itself."""
        pending = self._guard.journal.pending
        is_own = event.type is EventType.START or (
            event.type is EventType.STOP
            and _reason(event) not in (Reason.STATE_TIMEOUT, Reason.FAILED)
        )
        if not is_own and pending:
            self._report_departure(pending[0], event)
            return
        try:
            self._act(event, is_exact=is_exact)
        except TrajectoryError as error:
            self._depart(f'trajectory accepted ({error})', event.stamp)
            return
        if not pending or _key(pending[0]) != _key(event):
            is_stop = event.type is EventType.STOP
            self._depart(f'{event.type}: {_reason(event)}' if is_stop else event.type, event.stamp)
            return
        self.outputs.count_from(pending.popleft().commands, event.commands)

    def _act(self, event: Event, *, is_exact: bool) -> None:
        guard, content = self._guard, event.content
        if event.type in (EventType.ACTIVATE, EventType.RESET):
            self._failed = False
            (guard.activate if event.type is EventType.ACTIVATE else guard.reset)()
        elif event.type is EventType.DEACTIVATE:
            guard.deactivate()
        elif event.type is EventType.RELEASE:
            self._command(event.stamp, guard.release(), is_exact=is_exact)
        elif event.type is EventType.TRAJECTORY:
            points = tuple(TrajectoryPoint(**point) for point in content['points'])
            trajectory = Trajectory(tuple(content['joints']), points, content['begin'])
            guard.adopt(guard.plan(trajectory, content['at']))
        elif event.type is EventType.PARAMETERS:
            guard.retune(change(guard.config, content['parameters']))
        elif event.type is EventType.SILENCE:
            while guard.watchdog.torques < content['torques']:
                self._command(event.stamp, guard.time_out(''), is_exact=True)
            guard.end_silence()
        elif _reason(event) is Reason.STATE_TIMEOUT:
            self._command(event.stamp, guard.time_out(content['text']), is_exact=True)
        elif _reason(event) is Reason.FAILED:
            self._failed = True
            guard.journal.stamp = event.stamp
            self._command(event.stamp, guard.fail(content['text']), is_exact=True)

    def _report_departure(self, own: Event, event: Event | None) -> None:
        """Note that the controller started or stopped differently from the recorded one."""
        text = own.content['text'] if own.type is EventType.STOP else own.type
        what = f'stop: {_reason(event)}' if _stops_at(event, own.stamp) else 'used by the law'
        self._depart(f'{what} ({text})', own.stamp)

    def _depart(self, what: str, stamp: int) -> None:
        if self.departure is None:
            begin = int(self.outputs.stamp[0]) if self.outputs.last >= 0 else stamp
            time = (stamp - begin) * 1e-9
            self.departure = Difference(TRACKING_ERROR.resolved, what, stamp, time, 1.0, 0.0)


def _reason(event: Event | None) -> Reason:
    is_stop = event is not None and event.type is EventType.STOP
    return Reason(event.content['reason']) if event and is_stop else Reason.NONE


def _key(event: Event | None) -> tuple[EventType, int, Reason] | None:
    return (event.type, event.stamp, _reason(event)) if event else None


def _stops_at(event: Event | None, stamp: int) -> bool:
    return event is not None and event.type is EventType.STOP and event.stamp == stamp
