# SPDX-License-Identifier: Apache-2.0
"""The guarded controller on recorded joint states, with every event of its journal.

The journal tells how many joint-state messages were processed before an event, and the stamp of the
last. Where the bag holds as many in between, each is processed again. Where it holds more, the
middleware has dropped some (in real time): the telemetry tells which ones the law used; out of
command all are used, and the torques are compared as far as they match.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeGuard

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.law.factory import estimate_names
from blf_dsc_controller.law.settings import Settings
from blf_dsc_controller.law.state import Sample, sample_of
from blf_dsc_controller.messages.journal import Event, EventType
from blf_dsc_controller.messages.telemetry import DECIMATION, Monitor
from blf_dsc_controller.messages.topics import FOREVER, TRACKING_ERROR
from blf_dsc_controller.reference.trajectory import (
    Trajectory,
    TrajectoryError,
    TrajectoryPoint,
)
from blf_dsc_controller.replay.comparison import Commands, Difference
from blf_dsc_controller.replay.states import Arrivals, States
from blf_dsc_controller.run import Floats, Stamps
from blf_dsc_controller.supervision.guard import Guard
from blf_dsc_controller.supervision.reasons import Phase, Reason

_UNREADABLE = frozenset(
    (Reason.BAD_MESSAGE, Reason.JOINT_MISSING, Reason.JOINT_DUPLICATED, Reason.FIELD_MISSING)
)


@dataclass(frozen=True)
class Rerun:
    """What the replayed controller did.

    Attributes:
        states: that the law used.
        samples: columns of the law's telemetry samples, each (N, its length).
        monitored: messages of the monitor, by the number of their state.
        commands: every torque.
        events: that were replayed.
        departure: where it did something else than the journal says; the replay ends there.
        end: why else the replay ended before the bag; empty if it did not.
    """

    states: States
    samples: Sample
    monitored: dict[int, bytes]
    commands: Commands
    events: tuple[Event, ...]
    departure: Difference | None
    end: str


def rerun(
    config: ControllerConfig,
    events: Sequence[Event],
    came: Arrivals,
    sampled: Stamps | None,
    *,
    in_step: bool,
) -> Rerun:
    """Run the guarded controller over joint states.

    Args:
        config: in force at first.
        events: of the journal after the configuration, in turn.
        came: joint states.
        sampled: stamps of those that the law used [ns], increasing; None without telemetry.
        in_step: whether the plant waited for each command, so that none was dropped at the end.
    """
    silence = sum(1 + event.content.get('torques', 0) for event in events)
    return _Rerun(config, came, sampled, len(came.stamp) + silence).run(events, in_step=in_step)


def columns_of(rows: Floats, settings: Settings) -> Sample:
    """Columns by name of packed samples (N, s): their places are found on a row of indices."""
    places = sample_of(np.arange(rows.shape[1], dtype=np.float64), settings)
    return Sample(*(rows[:, part.astype(np.intp)] for part in places))


class _Rerun:
    def __init__(
        self, config: ControllerConfig, came: Arrivals, sampled: Stamps | None, most: int
    ) -> None:
        self._config = config
        self._guard = Guard(config, _no_time, _no_time)
        self._guard.journal.pending.clear()
        self._came = came
        self._sampled = None if sampled is None else frozenset(sampled.tolist())
        lost = np.setdiff1d([] if sampled is None else sampled, came.stamp)
        self._lost = int(lost[0]) if lost.size else FOREVER
        self._position = -1  # number of the last joint state before now
        self._messages = 0  # that were processed by then, according to the journal
        self._last = -1  # stamp of the last state that the law used [ns]
        self._passed_over = 0
        self._numbers: list[int] = []  # of the joint states that the law used
        self._rows = np.empty((len(came.stamp), self._guard.controller.sample_vector.size))
        self._monitor: Monitor | None = None
        self._monitored: dict[int, bytes] = {}
        self._commands = Commands(
            np.zeros(most, dtype=np.int64),
            np.zeros((most, len(config.joints))),
            np.zeros(most, dtype=np.bool_),
            np.zeros(most, dtype=np.bool_),
            np.arange(most),
        )
        self._count = 0  # of the torques commanded
        self._offsets: list[tuple[int, int]] = [(0, 0)]  # from a torque on: its number in the bag
        self._failed = False
        self._departure: Difference | None = None
        self._end = ''

    def run(self, events: Sequence[Event], *, in_step: bool) -> Rerun:
        done: list[Event] = []
        for event in events:
            if event.number != len(done) + 1:
                self._end = 'an event of the journal is not in the bag'
                break
            self._feed(event, *self._locate(event))
            if self._is_over:
                break
            self._repeat(event)
            done.append(event)
            if self._is_over or event.type is EventType.RELEASE:
                break
        else:
            self._feed(None, len(self._came.stamp) - 1, is_exact=in_step)
        return self._result(tuple(done))

    @property
    def _is_over(self) -> bool:
        return bool(self._end or self._departure)

    @property
    def _in_command(self) -> bool:
        return self._guard.supervisor.phase not in (Phase.SAFE_STOP, Phase.INACTIVE)

    # Between two events.

    def _locate(self, event: Event) -> tuple[int, bool]:
        """Number of the last joint state before an event, and whether none before was dropped."""
        came, processed = self._came, event.messages - self._messages
        self._messages = event.messages
        end = self._position + processed
        if processed == 0 or (end < len(came.stamp) and self._seen(end) == event.stamp):
            return end, True
        is_unreadable = _reason(event) in _UNREADABLE
        for k in range(self._position + 1, len(came.stamp)):
            is_it = (k in came.errors) == is_unreadable and self._seen(k) == event.stamp
            if is_it and (k >= end or not self._is_again(k + 1, event.stamp)):
                return k, False
        if self._numbers:
            self._end = f'the state of stamp {event.stamp} ns came but is not in the bag'
        return self._position, False

    def _seen(self, k: int) -> int:
        """Stamp of the last readable state up to number k."""
        while k in self._came.errors:
            k -= 1
        return self._came.stamp[k] if k >= 0 else -1

    def _is_again(self, k: int, stamp: int) -> bool:
        return k < len(self._came.stamp) and self._came.stamp[k] == stamp

    def _feed(self, event: Event | None, end: int, is_exact: bool) -> None:  # noqa: FBT001
        """Process the joint states up to number `end`, before an event."""
        for k in range(self._position + 1, end + 1):
            if self._is_over:
                return
            if event is not None and k == end and _reason(event) is Reason.FAILED:
                continue  # nothing tells how far the law came with this one
            if self._is_processed(k, event, end, is_exact=is_exact):
                self._process(k, event, is_exact=is_exact)
            else:
                self._passed_over += 1
        self._position = end

    def _is_processed(self, k: int, event: Event | None, end: int, *, is_exact: bool) -> bool:
        stamp, phase = self._came.stamp[k], self._guard.supervisor.phase
        if not self._in_command:
            return True
        if event is not None and (is_exact or k == end or stamp == event.stamp):
            return True
        if k in self._came.errors or stamp == self._last or phase is Phase.STARTING:
            return False
        return self._sampled is None or stamp in self._sampled

    def _process(self, k: int, event: Event | None, *, is_exact: bool) -> None:
        guard, stamp = self._guard, self._came.stamp[k]
        if k in self._came.errors:
            torque = guard.reject(self._came.errors[k])
            self._command(guard.journal.stamp, torque, is_exact=is_exact)
        elif self._in_command and stamp > self._lost:
            self._end = f'the state of stamp {self._lost} ns was used but is not in the bag'
        else:
            is_due = self._in_command and stamp > self._last
            is_due = is_due and self._sampled is not None and stamp in self._sampled
            torque = guard.update(stamp, self._came.measurement[k])
            if guard.has_sample and stamp <= self._last:
                self._end = f'the stamps begin again with {stamp} ns'
                return
            if guard.has_sample:
                self._sample(k, stamp)
            self._command(stamp, torque, is_exact=is_exact)
            if is_due and not guard.has_sample and not _is_stop(event, stamp):
                self._depart(f'answered ({guard.supervisor.text})', stamp)
        if guard.journal.pending and not _is_same(guard.journal.pending[0], event):
            self._depart_by(guard.journal.pending[0], event)

    def _sample(self, k: int, stamp: int) -> None:
        guard = self._guard
        controller, row = guard.controller, len(self._numbers)
        self._last = stamp
        self._numbers.append(k)
        self._rows[row] = controller.sample_vector
        samples = controller.samples
        if samples == 1 or self._monitor is None:
            names = estimate_names(self._config)
            self._monitor = Monitor(self._config.joints, names, controller.settings)
        if (samples - 1) % DECIMATION == 0:
            sample = controller.sample
            message = self._monitor.message(stamp, sample, guard.ratio, sample.bound)
            self._monitored[row] = message[1]

    def _command(self, stamp: int, torque: Floats | None, *, is_exact: bool) -> None:
        if torque is not None:
            k, of_law, commands = self._count, self._guard.has_sample, self._commands
            commands.stamp[k], commands.torque[k], commands.of_law[k] = stamp, torque, of_law
            commands.exact[k] = of_law or (is_exact and not self._failed)
            self._count += 1

    # Events.

    def _repeat(self, event: Event) -> None:
        """Do what the journal says, or see that it has happened."""
        pending = self._guard.journal.pending
        is_own = event.type is EventType.START or (
            event.type is EventType.STOP
            and _reason(event) not in (Reason.STATE_TIMEOUT, Reason.FAILED)
        )
        if not is_own and pending:
            self._depart_by(pending[0], event)
            return
        try:
            self._act(event)
        except TrajectoryError as error:
            self._depart(f'trajectory accepted ({error})', event.stamp)
            return
        if not pending or not _is_same(pending[0], event):
            what = _reason(event).value if event.type is EventType.STOP else ''
            self._depart(f'{event.type}: {what}' if what else event.type, event.stamp)
            return
        own = pending.popleft()
        self._offsets.append((own.commands, event.commands))

    def _act(self, event: Event) -> None:
        guard, content = self._guard, event.content
        if event.type in (EventType.ACTIVATE, EventType.RESET):
            self._failed = False
            (guard.activate if event.type is EventType.ACTIVATE else guard.reset)()
        elif event.type is EventType.DEACTIVATE:
            guard.deactivate()
        elif event.type is EventType.RELEASE:
            guard.release()
        elif event.type is EventType.TRAJECTORY:
            points = tuple(TrajectoryPoint(**point) for point in content['points'])
            guard.follow(Trajectory(tuple(content['joints']), points, content['begin']))
        elif event.type is EventType.PARAMETERS:
            guard.retune(change(guard.config, content['parameters']))
        elif event.type is EventType.SILENCE:
            while guard.watchdog_torques < content['torques']:
                self._command(event.stamp, guard.time_out(''), is_exact=True)
            guard.end_silence()
        elif _reason(event) is Reason.STATE_TIMEOUT:
            self._command(event.stamp, guard.time_out(content['text']), is_exact=True)
        elif _reason(event) is Reason.FAILED:
            self._failed = True
            guard.journal.stamp = event.stamp
            self._command(event.stamp, guard.fail(content['text']), is_exact=True)

    def _depart_by(self, own: Event, event: Event | None) -> None:
        """The replayed controller started or stopped where the recorded one did not, or not so."""
        text = own.content['text'] if own.type is EventType.STOP else own.type
        what = f'stop: {_reason(event).value}' if _is_stop(event, own.stamp) else 'answered'
        self._depart(f'{what} ({text})', own.stamp)

    def _depart(self, what: str, stamp: int) -> None:
        begin = self._came.stamp[self._numbers[0]] if self._numbers else stamp
        if self._departure is None:
            time = (stamp - begin) * 1e-9
            self._departure = Difference(TRACKING_ERROR.resolved, what, stamp, time, 1.0, 0.0)

    def _result(self, done: tuple[Event, ...]) -> Rerun:
        settings = self._guard.controller.settings
        stamps = np.array(self._came.stamp, dtype=np.int64)[self._numbers]
        measurement = self._came.measurement[self._numbers]
        number = self._commands.number
        for own, recorded in self._offsets:
            number[own:] = np.arange(recorded, recorded + len(number) - own)
        return Rerun(
            States(stamps, measurement, self._passed_over),
            columns_of(self._rows[: len(self._numbers)], settings),
            self._monitored,
            self._commands.first(self._count),
            done,
            self._departure,
            self._end,
        )


def _reason(event: Event) -> Reason:
    return Reason(event.content['reason']) if event.type is EventType.STOP else Reason.NONE


def _is_same(own: Event, event: Event | None) -> bool:
    return event is not None and (own.type, own.stamp, _reason(own)) == (
        event.type,
        event.stamp,
        _reason(event),
    )


def _is_stop(event: Event | None, stamp: int) -> TypeGuard[Event]:
    return event is not None and event.type is EventType.STOP and event.stamp == stamp


def _no_time() -> int:
    return 0
