# SPDX-License-Identifier: Apache-2.0
"""The guarded controller on recorded joint states, with every event of its journal.

For each message that the controller answered, it published a tracking error with that
message's stamp: `answers`. An event of the journal states how many torques had been
commanded before it. Both together give the exact order of messages and events; what was
dropped has no answer.
"""

from __future__ import annotations

import heapq
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.bags.sources import BagMessage
from blf_dsc_controller.bags.topic_messages import JointStates, TopicMessages
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import change, parameters
from blf_dsc_controller.control.guarded_loop import GuardedLoop
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.errors import MessageError
from blf_dsc_controller.messages.journal import MOTIONS, Event, EventType
from blf_dsc_controller.messages.topics import JOURNAL, TRACKING_ERROR, Message, Topic
from blf_dsc_controller.reference.retargeting import TrajectoryError
from blf_dsc_controller.replay.guard_calls import GUARD_CALLS
from blf_dsc_controller.run import Floats
from blf_dsc_controller.supervision.supervisor import Reason

_UNREADABLE = frozenset(
    (
        Reason.BAD_MESSAGE,
        Reason.JOINT_MISSING,
        Reason.JOINT_DUPLICATED,
        Reason.FIELD_MISSING,
    )
)
_EXTERNAL = (Reason.STATE_TIMEOUT, Reason.FAILED)
_REASONS = frozenset(reason.value for reason in Reason)
_FIXED = frozenset(each.name for each in parameters(ControllerConfig) if each.read_only)
_BLOCK = 4096  # states in memory
_AXES = 3
_MOST_TORQUES = 1_000_000  # of the watchdog: an hour without joint states


class Difference(NamedTuple):
    """The first number of a topic, or part of an event, that differs."""

    topic: str
    field: str
    stamp: int  # ns
    time: float  # s since the first state
    recorded: float | str
    replayed: float | str

    def __str__(self) -> str:
        return (
            f'{self.time:.6f} s (stamp {self.stamp} ns), {self.topic}, {self.field}: '
            f'recorded {self.recorded!r}, replayed {self.replayed!r}'
        )


class Rerun:
    """Replay of the guarded controller.

    Attributes:
        events: replayed events but motions.
        motions: number of replayed trajectories and targets.
        topics: what its node would have published, received at the stamp of its state.
        samples: number of samples of the law.
        first, last: stamps [ns] of its first and last sample; -1 before the first.
        answers: number of answers reached.
        skipped: number of joint states that the controller did not answer.
        departure: how the controller differed first from the recorded one in what it started,
            stopped or accepted; this ends the replay.
        alteration: the first event that happened alike, but says something else; or None.
        end: any other reason why the replay ended before the bag, or empty.
    """

    def __init__(
        self,
        config: ControllerConfig,
        states: JointStates,
        errors: Mapping[int, MessageError],
        answers: JointStates,
        commands: int,
    ) -> None:
        """Start with `config`.

        `errors` maps the number of each unreadable state to its error.

        `commands` is the number of torques in the bag.
        """
        self.events: list[Event] = []
        self.motions = 0
        self.topics: dict[Topic, TopicMessages] = {}
        self.samples = 0
        self.skipped = 0
        self.answers = 0
        self.first = -1
        self.last = -1
        self.departure: Difference | None = None
        self.alteration: Difference | None = None
        self.end = ''
        self._loop = GuardedLoop(config, lambda: 0, lambda: 0)
        self._guard = self._loop.guard
        self._guard.journal.pending.clear()
        self._states = states
        self._values = np.empty((0, 3, 0))
        self._loaded = range(0)
        # All messages in order: row of the state, or of an error after them, whose
        # stamp is -1.
        numbers = np.append(states.number, np.array([*errors], dtype=np.int64))
        self._row = np.argsort(numbers, kind='stable').astype(np.int32)
        self._stamp = np.append(states.stamp, np.full(len(errors), -1))[self._row]
        self._unreadable = dict(enumerate(errors.values(), states.size))
        self._answered = answers.stamp
        self._commands = commands
        self._numbered = bool(answers.sequence.any())
        self._gap = _first_gap(answers)
        self._position = -1  # of the last message processed or passed over
        self._answered_at = -1  # stamp of the last answer

    def run(self, events: Sequence[Event], motions: Iterable[Event] = ()) -> None:
        """Process the joint states with the events after the configuration, in order.

        `motions` are the trajectories and targets among them, of which one is held at a
        time.

        Raises:
            BlfDscError: an event cannot be repeated.
        """
        _check(events)
        self._gap = min(self._gap, self._first_unknown(events))
        for event in heapq.merge(events, motions, key=lambda each: each.number):
            if event.number != len(self.events) + self.motions + 1:
                self.end = 'an event of the journal, or a target, is not in the bag'
                return
            self._approach(event)
            if not self._is_over:
                self._repeat(event)
            if self._is_over:
                return
            if event.type in MOTIONS:
                self.motions += 1
            else:
                self.events.append(event)
            if event.type is EventType.RELEASE:
                return
        while not self._is_over and self._next():
            pass

    @property
    def _is_over(self) -> bool:
        return bool(self.end or self.departure)

    def _first_unknown(self, events: Sequence[Event]) -> int:
        """Return the number of answers before the first that may be missing.

        Answers without sequence numbers are counted by the torques that the journal
        states. If some are missing, the first state without an answer may have been
        used as well as dropped.
        """
        size = self._answered.size
        if self._numbered:
            return size + 1
        starts = [event.stamp for event in events if event.type is EventType.START]
        if starts and starts[0] not in self._answered[:1]:
            return 0
        if not starts or size >= _commanded_by_states(events, self._commands):
            return size + 1
        used = self._states.stamp
        used = used[used >= starts[0]]
        unanswered = used[~np.isin(used, self._answered)]
        if not unanswered.size:
            return size + 1
        return int(np.searchsorted(self._answered, unanswered[0]))

    # Messages.

    def _next(self) -> bool:
        """Process the message of the next answer; return False if there is none."""
        if self._guard.journal.pending:  # the controller started or stopped on its own
            self._report_departure(self._guard.journal.pending[0], None)
            return False
        if self.answers == self._gap:
            self.end = f'the recorder missed messages of {TRACKING_ERROR.resolved}'
        if self.answers >= min(self._gap, self._answered.size):
            return False
        stamp = int(self._answered[self.answers])
        k = self._find(stamp)
        if k < 0:
            self.end = f'the state with stamp {stamp} ns was used but is not in the bag'
            return False
        self.answers += 1
        commands = self._guard.journal.commands
        self._process(k)
        while stamp == self._answered_at and self._guard.journal.commands == commands:
            k = self._find(stamp)  # a repeated stamp is skipped at first
            if k < 0:
                break
            self._process(k)
        self._answered_at = stamp
        if self._guard.journal.commands == commands and not self._is_over:
            self._depart(f'used by the law ({self._guard.supervisor.text})', stamp)
        return True

    def _find(self, stamp: int) -> int:
        """Return the next message with a stamp, -1 if there is none.

        Unreadable ones have the stamp -1; after the last message, one with its stamp
        may be one.
        """
        wanted = (stamp, -1) if stamp == self._answered_at else (stamp,)
        for k in range(self._position + 1, self._stamp.size):
            if self._stamp[k] in wanted:
                return k
        return -1

    def _approach(self, event: Event) -> None:
        """Process the messages before an event, and the one that causes it."""
        guard = self._guard
        before = event.commands
        if event.type is EventType.SILENCE:  # noted after its torques
            before -= event.content['torques'] - guard.watchdog.torques
        while guard.journal.commands < before and not self._is_over:
            if not self._next():
                self.end = self.end or 'the bag does not say which states were used'
        while not (is_own(event) or guard.commanding or guard.supervisor.uses_states):
            k = self._position + 1
            if k >= self._stamp.size or self._stamp[k] > event.stamp:
                break
            self._process(k)  # nothing was commanded for it
        if is_own(event) and not guard.journal.pending and not self._is_over:
            self._reach(event)

    def _reach(self, event: Event) -> None:
        """Process the message in which the controller should start or stop."""
        if self._answered[self.answers :][:1].tolist() == [event.stamp]:
            self._next()  # it was answered, at least with a safe torque
        else:
            k = self._find(-1 if _reason(event) in _UNREADABLE else event.stamp)
            if k >= 0:
                self._process(k)

    def _process(self, k: int) -> None:
        guard, stamp = self._guard, int(self._stamp[k])
        self.skipped += k - self._position - 1
        self._position, row = k, int(self._row[k])
        if row in self._unreadable:
            torque = guard.reject(self._unreadable[row])
            stamp = guard.journal.stamp
        else:
            torque = guard.update(stamp, self._measurement(row))
            guard.perceive()
        if guard.has_sample:
            if stamp <= self.last:
                self.end = f'the stamps restart at {stamp} ns'
                return
            self.first = stamp if self.first < 0 else self.first
            self.last = stamp
            self.samples += 1
        guard.compute_time = 0.0  # of another computer
        for message in self._loop.messages(torque):
            self._add(stamp, message)
        self._command(stamp, torque)

    def _measurement(self, row: int) -> Floats:
        if row not in self._loaded:
            self._loaded = range(row, min(row + _BLOCK, self._states.size))
            rows = slice(self._loaded.start, self._loaded.stop)
            self._values = np.stack(
                [self._states.field(k)[rows] for k in range(3)], axis=1
            )
        return np.ravel(self._values[row - self._loaded.start])

    # Outputs.

    def _command(self, stamp: int, torque: Floats | None) -> None:
        """Add a torque (n,) [N m], if any, commanded after this state's stamp [ns]."""
        if torque is not None:
            self._add(stamp, self._loop.telemetry.command(torque))

    def _add(self, stamp: int, message: Message) -> None:
        topic, raw = message
        if topic not in self.topics:
            self.topics[topic] = TopicMessages(topic.resolved, topic.type)
        messages = self.topics[topic]
        messages.add(BagMessage(messages.name, stamp, raw, messages.size + 1))

    # Events.

    def _repeat(self, event: Event) -> None:
        """Repeat an event, or check that the controller has produced it itself."""
        pending = self._guard.journal.pending
        if _reason(event) is Reason.FAILED:  # nothing shows how far the law got
            self.end = f'the law failed, {event.content["text"]}'
            return
        if pending and not is_own(event):
            self._report_departure(pending[0], event)
            return
        try:
            self._act(event)
        except TrajectoryError as error:
            self._depart(f'trajectory accepted ({error})', event.stamp)
            return
        except BlfDscError as error:
            self._depart(f'{event.type} ({error})', event.stamp)
            return
        if pending and _key(pending[0]) == _key(event):
            self._compare(event, pending.popleft())
        elif pending and is_own(event):
            self._report_departure(pending[0], event)
        else:
            is_stop = event.type is EventType.STOP
            self._depart(
                f'{event.type}: {_reason(event)}' if is_stop else event.type,
                event.stamp,
            )

    def _act(self, event: Event) -> None:
        """Do what caused an event, unless a message did."""
        if _reason(event) is Reason.STATE_TIMEOUT:
            torque = self._guard.time_out(event.content['text'])
            self._command(event.stamp, torque)
        elif event.type in GUARD_CALLS:
            GUARD_CALLS[event.type](self._guard, event.content)
        elif event.type is EventType.RELEASE:
            self._release(event)
        elif event.type is EventType.PARAMETERS:
            self._retune(event)
        elif event.type is EventType.SILENCE:
            self._stay_silent(event)

    def _release(self, event: Event) -> None:
        """Command the torque to leave behind."""
        torque = self._guard.release()
        self._guard.journal.commands += torque is not None  # after the event's count
        self._command(event.stamp, torque)

    def _retune(self, event: Event) -> None:
        """Change parameters, and publish the bound by the new ones as the node does."""
        guard = self._guard
        where = f'event {event.number} of the journal'
        given = event.content['parameters']
        message = self._loop.retune(change(guard.config, given, where))
        if message is not None:
            self._add(guard.journal.stamp, message)

    def _stay_silent(self, event: Event) -> None:
        """Command what the watchdog commanded in a silence."""
        while self._guard.watchdog.torques < event.content['torques']:
            self._command(event.stamp, self._guard.time_out(''))
        self._guard.end_silence()

    def _compare(self, event: Event, own: Event) -> None:
        """Note what an event says otherwise than the controller's own.

        Of what came from outside, the replay only repeats the text.
        """
        if self.alteration is not None or _reason(event) in _EXTERNAL:
            return
        for name in filter(own.content.__contains__, event.content):
            texts = [json.dumps(each.content[name]) for each in (event, own)]
            if texts[0] != texts[1]:
                field = f'{name} of event {event.number} ({event.type})'
                self.alteration = self._difference(JOURNAL, field, event.stamp, *texts)
                return

    def _report_departure(self, own: Event, event: Event | None) -> None:
        """Note that the controller started or stopped unlike the recorded one."""
        text = own.content['text'] if own.type is EventType.STOP else own.type
        is_stop = (
            event is not None
            and event.type is EventType.STOP
            and event.stamp == own.stamp
        )
        what = f'stop: {_reason(event)}' if is_stop else 'used by the law'
        self._depart(f'{what} ({text})', own.stamp)

    def _depart(self, what: str, stamp: int) -> None:
        self.departure = self.departure or self._difference(
            TRACKING_ERROR, what, stamp, 1.0, 0.0
        )

    def _difference(
        self,
        topic: Topic,
        field: str,
        stamp: int,
        recorded: float | str,
        replayed: float | str,
    ) -> Difference:
        time = (stamp - max(self.first, 0)) * 1e-9
        return Difference(topic.resolved, field, stamp, time, recorded, replayed)


def _first_gap(answers: JointStates) -> int:
    """Return the number of answers before the first that the recorder missed."""
    sequence = answers.sequence
    if not sequence.any():
        return sequence.size + 1
    gaps = np.flatnonzero(np.diff(sequence, prepend=0) > 1)
    return int(gaps[0]) if gaps.size else sequence.size + 1


def _commanded_by_states(events: Sequence[Event], commands: int) -> int:
    """Return how many torques, of so many in the bag, were commanded for states.

    The others are those of the watchdog and of the release.
    """
    by_watchdog = 0
    stated = 0
    for event in events:
        if event.type is EventType.SILENCE:
            by_watchdog += int(event.content['torques'])
        stated = event.commands
    is_released = bool(events) and events[-1].type is EventType.RELEASE
    return max(stated, commands - is_released) - by_watchdog


def _check(events: Sequence[Event]) -> None:
    """Raise BlfDscError if an event cannot be repeated."""
    silent_torques = 0
    for event in events:
        problem = _problem_of(event)
        if event.type is EventType.SILENCE:
            silent_torques += event.content['torques']
            if silent_torques > _MOST_TORQUES:
                problem = f'{silent_torques} torques of the watchdog, more than {_MOST_TORQUES}'
        if problem:
            raise BlfDscError(
                f'event {event.number} of the journal cannot be repeated: {problem}; it is '
                'damaged or of a later version'
            )


def _problem_of(event: Event) -> str:
    """Return why an event cannot be repeated; empty if it can."""
    content = event.content
    if event.type is EventType.STOP and content['reason'] not in _REASONS:
        return f'a stop for the unknown reason {content["reason"][:40]!r}'
    if event.type is EventType.PARAMETERS:
        fixed = _FIXED & content['parameters'].keys()
        if fixed:
            names = ', '.join(sorted(fixed))
            return f'a change of what is fixed at the start: {names}'
    if event.type is EventType.DRIVE_LOAD and len(content['centre']) != _AXES:
        return f'a centre with {len(content["centre"])} coordinates'
    return ''


def is_own(event: Event) -> bool:
    """Whether the controller decides on an event itself, because of a message."""
    is_stop = event.type is EventType.STOP
    own = (
        EventType.START,
        EventType.CONTACT,
        EventType.OSCILLATION,
        EventType.TORQUE_SENSORS,
    )
    return event.type in own or (is_stop and _reason(event) not in _EXTERNAL)


def _reason(event: Event | None) -> Reason:
    is_stop = event is not None and event.type is EventType.STOP
    return Reason(event.content['reason']) if event and is_stop else Reason.NONE


def _key(event: Event) -> tuple[EventType, int, Reason]:
    return event.type, event.stamp, _reason(event)
