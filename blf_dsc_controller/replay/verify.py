# SPDX-License-Identifier: Apache-2.0
"""Replay of a bag with its own configuration: equal, or the first difference."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from blf_dsc_controller import __version__
from blf_dsc_controller.bags.content import NO_NAMES, Content, NameMap, read_content
from blf_dsc_controller.bags.topic_messages import (
    JointStates,
    TopicMessages,
    UnreadableMessageError,
)
from blf_dsc_controller.configuration import law_file
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import CONTROLLER
from blf_dsc_controller.configuration.schema import flatten
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import JOINT_STATE_FIELDS
from blf_dsc_controller.messages.errors import MessageError
from blf_dsc_controller.messages.event_content import FORMAT
from blf_dsc_controller.messages.journal import Event, EventType
from blf_dsc_controller.replay.rerun import Alteration, Rerun
from blf_dsc_controller.run import Floats, Stamps

_BLOCK = 4096  # messages compared at once
_COMPARED = {  # topic: fields
    topics.COMMANDS: (2,),
    topics.TRACKING_ERROR: (0, 1, 2),
    topics.REFERENCE: (0, 1),
    topics.MONITOR: (0,),
    topics.BOUND: (0, 2),
    topics.EXTERNAL_TORQUE: (2,),
}
_OTHERS = (topics.STATE, topics.DIAGNOSTICS, topics.EXTERNAL_WRENCH)
_BY_STAMP = (topics.REFERENCE, topics.MONITOR, topics.EXTERNAL_TORQUE)
_TRANSITIONS = (
    EventType.ACTIVATE,
    EventType.DEACTIVATE,
    EventType.RESET,
    EventType.STOP,
)


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


@dataclass
class Comparison:
    """Result of comparing one topic."""

    topic: str  # name in the bag
    recorded: int  # numbers in the bag that a complete replay would give
    values: int = 0  # numbers compared
    difference: Difference | None = None
    # difference of two numbers; infinite if only one of them is finite
    largest: float = 0.0
    left_out: str = ''  # what was not compared, and why
    missing: int = 0  # messages that the replay gives and the bag does not hold

    def add(
        self,
        stamp: Stamps,
        start: int,
        names: Sequence[str],
        recorded: Floats,
        replayed: Floats,
    ) -> None:
        """Compare tables (N, names) of stamps (N,), of a run that began at `start`."""
        self.values += recorded.size
        bits = np.ascontiguousarray(recorded).view(np.int64)
        unlike = bits != np.ascontiguousarray(replayed).view(np.int64)
        unlike &= ~(np.isnan(recorded) & np.isnan(replayed))
        if not unlike.any():
            return
        with np.errstate(invalid='ignore', over='ignore'):
            sizes = np.abs(recorded[unlike] - replayed[unlike])
        self.largest = max(self.largest, float(np.nan_to_num(sizes, nan=np.inf).max()))
        if self.difference is None:
            k, j = np.argwhere(unlike)[0]
            pair = float(recorded[k, j]), float(replayed[k, j])
            time = (int(stamp[k]) - start) * 1e-9
            self.difference = Difference(
                self.topic, names[j], int(stamp[k]), time, *pair
            )


class Verification(NamedTuple):
    """Result of a verification."""

    samples: int  #: number of states that the law used
    duration: float  #: s, from the first of them to the last
    skipped: int  #: number of states that the controller did not answer
    #: one for each topic of the controller with numbers
    comparisons: tuple[Comparison, ...]
    not_compared: tuple[str, ...]  #: topics with text, and what follows from others
    events: tuple[Event, ...]  #: replayed events but motions
    motions: int  #: number of replayed trajectories and targets of streams
    remarks: tuple[str, ...]  #: limitations of the result
    incomplete: tuple[str, ...]  #: what is missing in the recording
    difference: Difference | None  #: the earliest, in a topic or in an event

    @property
    def compared(self) -> float:
        """Fraction of the controller's outputs in the bag that could be compared."""
        recorded = sum(found.recorded for found in self.comparisons)
        return (
            sum(found.values for found in self.comparisons) / recorded
            if recorded
            else 0.0
        )

    @property
    def is_partial(self) -> bool:
        """Whether a number could not be compared, or is missing in the bag."""
        return self.compared < 1.0 or bool(self.incomplete)

    @property
    def transitions(self) -> list[str]:
        """Activations, deactivations, resets and safe stops in order."""
        return [
            f'safe stop ({event.content["reason"]})'
            if event.type is EventType.STOP
            else event.type
            for event in self.events
            if event.type in _TRANSITIONS
        ]


def verify(
    path: str | Path, namespace: str = '', names: NameMap = NO_NAMES, law: str = ''
) -> Verification:
    """Replay a bag and compare every number of the controller bit for bit.

    `namespace` is that of the robot, if the bag holds several; `names` maps topics and
    joints that have other names in the bag. If the recorded law is a file, `law` names
    the file that runs in its place, and the SHA-256 of its content, as FILE@DIGEST: a
    bag may come from anybody.

    Raises:
        ConfigurationError: this version of the package cannot run the configuration.
        BlfDscError: the bag holds no journal or nothing to compare, begins after the
            controller, or cannot be read; or its law is a file and `law` does not name
            one.
    """
    path = Path(path)
    if law:  # before a large bag is read
        law_file.check_pinned(law)
    content = read_content(path, namespace, names)
    events, until, other = _events(content)
    _check_format(path, events[0])
    config = content.exact_config(law)
    errors: dict[int, MessageError] = {}
    states = content.topics[topics.JOINT_STATES].joint_states(
        names.joints_of(config.joints), ('position',), errors
    )
    _check_first_state(path, events, states)
    messages = content.topics[topics.TRACKING_ERROR]
    answers = _before(messages.joint_states(config.joints, ()), until)
    commands = _commands_before(content, until)
    run = Rerun(config, _before(states, until), errors, answers, commands)
    motions = (event for received, event in content.motions if received < until)
    run.run(events[1:], motions)
    comparisons = tuple(_compared(content, run, answers, config.joints))
    is_compared = any(found.values for found in comparisons)
    if run.departure is None and not is_compared:
        raise _nothing_to_compare(content)
    end = run.end or other
    newer = _newer_parameters(content, config)
    changed_law = _changed_law(config, events[0])
    return Verification(
        samples=run.samples,
        duration=(run.last - run.first) * 1e-9,
        skipped=run.skipped,
        comparisons=comparisons,
        not_compared=_names_of_others(content),
        events=tuple(run.events),
        motions=run.motions,
        remarks=tuple(_remarks(content, end, newer, changed_law)),
        incomplete=tuple(
            _incomplete(content, events, comparisons, end, run.alteration)
        ),
        difference=_first_difference(content, run, comparisons),
    )


def _newer_parameters(content: Content, config: ControllerConfig) -> list[str]:
    """Return the parameters that the recorded configuration does not have, by name."""
    recorded = content.configurations[CONTROLLER]
    return sorted(flatten(config).keys() - recorded.keys() - {'insist'})


def _names_of_others(content: Content) -> tuple[str, ...]:
    """Return the names of the topics in the bag that are not compared."""
    return tuple(
        content.topics[topic].name for topic in _OTHERS if topic in content.topics
    )


def _first_difference(
    content: Content, run: Rerun, comparisons: Sequence[Comparison]
) -> Difference | None:
    """Return the earliest difference; of those with the same stamp, the departure."""
    differences = [found.difference for found in comparisons if found.difference]
    if run.departure is not None:
        differences.insert(0, _departed(run, *run.departure))
    if run.alteration is not None and content.version == __version__:
        differences.append(_altered(content, run, run.alteration))
    return min(differences, key=lambda found: found.stamp, default=None)


def _check_format(path: Path, configure: Event) -> None:
    """Raise BlfDscError if a journal is of a later version."""
    number = configure.content.get('format', 0)
    if number > FORMAT:
        version = configure.content.get('version', 'unknown')
        raise BlfDscError(
            f'{path} has a journal of format {number}, recorded by version {version}; this '
            f'version, {__version__}, reads formats up to {FORMAT}: replay it with that version'
        )


def _check_first_state(
    path: Path, events: Sequence[Event], states: JointStates
) -> None:
    """Raise BlfDscError if the bag lacks the state with which the law started."""
    starts = [event.stamp for event in events if event.type is EventType.START]
    if starts and starts[0] not in states.stamp:
        raise BlfDscError(
            f'{path} does not hold the first state that the controller used, with the stamp '
            f'{starts[0]} ns, so its outputs cannot be reproduced: start the recorder first'
        )


def _departed(run: Rerun, what: str, stamp: int) -> Difference:
    """Return the departure of a replay as a difference."""
    time = (stamp - max(run.first, 0)) * 1e-9
    return Difference(topics.TRACKING_ERROR.resolved, what, stamp, time, 1.0, 0.0)


def _altered(content: Content, run: Rerun, found: Alteration) -> Difference:
    """Return an event that says something else as a difference."""
    event = found.event
    time = (event.stamp - max(run.first, 0)) * 1e-9
    what = f'{found.name} of event {event.number} ({event.type})'
    journal = content.topics[topics.JOURNAL].name
    return Difference(journal, what, event.stamp, time, found.recorded, found.replayed)


def _events(content: Content) -> tuple[list[Event], int, str]:
    """Return the first controller's events, when the next begins [ns], a remark."""
    if not {topics.JOURNAL, topics.TRACKING_ERROR} <= content.topics.keys():
        raise _nothing_to_compare(content)
    begins = [
        k
        for k, (_, event) in enumerate(content.events)
        if event.type is EventType.CONFIGURE
    ]
    events = [event for _, event in content.events]
    if not begins or begins[0] > 0:
        raise BlfDscError(
            f'{content.path} does not hold the beginning of {content.topics[topics.JOURNAL].name}: '
            'start the recorder first'
        )
    if len(begins) > 1:
        return (
            events[: begins[1]],
            content.events[begins[1]][0],
            'another controller was started',
        )
    return events, topics.FOREVER, ''


def _before(states: JointStates, until: int) -> JointStates:
    """Return the messages received before a time [ns]."""
    rows = np.flatnonzero(states.received < until)
    return states if rows.size == states.size else states.select(rows)


def _commands_before(content: Content, until: int) -> int:
    """Return the number of torques received before a time [ns].

    0 if it is not known.
    """
    messages = content.topics.get(topics.COMMANDS)
    if messages is None:
        return 0
    with suppress(UnreadableMessageError):
        return _before(messages.joint_states(messages.joint_names(), ()), until).size
    return 0


def _nothing_to_compare(content: Content) -> BlfDscError:
    listing = ''.join(
        f'\n  {name} ({count})' for name, count in content.message_counts.items()
    )
    return BlfDscError(
        f'{content.path} lacks the messages of the controller or its journal, so '
        f'there is nothing to compare; it holds:{listing}'
    )


# Comparison.


def _compared(
    content: Content, run: Rerun, answers: JointStates, joints: Sequence[str]
) -> Iterator[Comparison]:
    """Yield the comparison of each topic in a bag.

    `answers` are those of tracking errors.
    """
    for topic, fields in _COMPARED.items():
        messages = content.topics.get(topic)
        own = run.topics.get(topic)
        if messages is None:
            if own is not None:
                lacking = 'the bag holds none of its messages'
                yield Comparison(topic.resolved, 0, left_out=lacking, missing=own.size)
            continue
        result = Comparison(messages.name, messages.size * len(joints) * len(fields))
        try:
            if own is not None:
                _compare(topic, messages, own, answers, joints, result, run)
        except BlfDscError as error:  # unreadable, or in an unknown order
            result.left_out = f'{error}'
        yield result


def _compare(
    topic: topics.Topic,
    messages: TopicMessages,
    own: TopicMessages,
    answers: JointStates,
    joints: Sequence[str],
    result: Comparison,
    run: Rerun,
) -> None:
    """Compare the messages of the same stamp or number.

    Those that have other stamps differ.
    """
    fields = _COMPARED[topic]
    shared = _shared_names(messages, own, result)
    result.recorded = messages.size * len(shared) * len(fields)
    recorded = answers
    if topic is not topics.TRACKING_ERROR:
        recorded = messages.joint_states(shared, ())
    recorded, replayed, result.missing = _matched(
        topic, recorded, own.joint_states(shared, ()), answers.size, run.answers
    )
    has_moved = recorded.stamp != replayed.stamp
    names = _labels(topic, shared, joints)
    for begin in range(0, replayed.size, _BLOCK):
        rows = slice(begin, begin + _BLOCK)
        theirs = _table(recorded, rows, fields)
        ours = _table(replayed, rows, fields)
        ours[has_moved[rows]] = np.inf
        result.add(replayed.received[rows], run.first, names, theirs, ours)
    if topic is topics.COMMANDS:
        unreached = (result.recorded - result.values) // len(joints)
        if unreached:
            result.left_out = f'{unreached} torques that the replay does not reach'


def _shared_names(
    messages: TopicMessages, own: TopicMessages, result: Comparison
) -> list[str]:
    """Return the names in both, but for the computation time; note the others as left out."""
    theirs, ours = messages.joint_names(), own.joint_names()
    shared = [name for name in ours if name in theirs and name != topics.COMPUTE_TIME]
    others = [name for name in dict.fromkeys((*ours, *theirs)) if name not in shared]
    result.left_out = ', '.join(others)
    return shared


def _table(states: JointStates, rows: slice, fields: Sequence[int]) -> Floats:
    """Return some rows of fields of messages, beside each other (rows, fields * names)."""
    return np.hstack([states.field(k)[rows] for k in fields])


def _labels(topic: topics.Topic, shared: list[str], joints: Sequence[str]) -> list[str]:
    """Return what the numbers of a message are called, in their order."""
    if topic is topics.MONITOR:
        return shared
    labels = shared if topic is topics.EXTERNAL_TORQUE else joints
    return [
        f'{JOINT_STATE_FIELDS[k]} of {label}'
        for k in _COMPARED[topic]
        for label in labels
    ]


def _matched(
    topic: topics.Topic,
    recorded: JointStates,
    replayed: JointStates,
    answers: int,
    in_order: int,
) -> tuple[JointStates, JointStates, int]:
    """Return the recorded messages and their replays, and how many replays have none.

    They are those of a stamp or number that occurs in both.

    Of the `answers`, only the first `in_order` have a known order.
    """
    if topic in _BY_STAMP:
        recorded = recorded.by_stamp()
        replayed = replayed.by_stamp()
        keys = recorded.stamp
        wanted = replayed.stamp
    else:
        keys = _numbers(topic, recorded, max(answers, replayed.size))
        wanted = replayed.sequence
    index = np.minimum(np.searchsorted(keys, wanted), keys.size - 1)
    is_known = keys[index] == wanted
    if topic is topics.TRACKING_ERROR:
        is_known[in_order:] = False
    known = np.flatnonzero(is_known)
    missing = replayed.size - known.size
    return recorded.select(index[known]), replayed.select(known), missing


def _numbers(topic: topics.Topic, recorded: JointStates, least: int) -> Stamps:
    """Return the numbers of messages among those of their publisher.

    It sent at least so many.  BlfDscError if they are unknown.
    """
    sequence = recorded.sequence
    numbered = topic in (topics.COMMANDS, topics.TRACKING_ERROR) and sequence.any()
    if not numbered:
        if topic is topics.COMMANDS and recorded.size < least:  # of another recorder
            raise BlfDscError(
                'some are missing, and they have neither stamps nor numbers'
            )
        return np.arange(1, recorded.size + 1)
    if (np.diff(sequence) > 0).all():
        return sequence
    if topic is topics.COMMANDS:
        raise BlfDscError('they are of several publishers')
    return np.arange(1, recorded.size + 1)


# Remarks.


def _remarks(
    content: Content, end: str, newer: Sequence[str], changed_law: str
) -> Iterator[str]:
    """Yield what limits the result."""
    if changed_law:
        yield f'{changed_law} is another file than the one recorded: differences may come from it'
    if end:
        yield f'{end}: the replay ends there'
    for topic, what in content.losses.items():
        yield f'the recorder missed messages of {topic}: {what}'
    if content.version != __version__ or newer:
        lacking = f', before the law had {", ".join(newer)},' if newer else ''
        yield (
            f'recorded by version {content.version or "unknown"}{lacking} and replayed by '
            f'{__version__}: differences may come from the software'
        )


def _changed_law(config: ControllerConfig, configure: Event) -> str:
    """Return the file of the law if it has changed since the recording, or nothing."""
    recorded = configure.content.get('law_digest')
    if not recorded or not law_file.is_file(config.law):
        return ''
    is_same = law_file.digest(config.law).startswith(recorded)
    return '' if is_same else config.law.partition('@')[0]


def _incomplete(
    content: Content,
    events: Sequence[Event],
    comparisons: Sequence[Comparison],
    end: str,
    alteration: Alteration | None,
) -> Iterator[str]:
    """Yield what is missing in the recording: messages, its end, texts of this version."""
    for found in comparisons:
        if found.missing:
            yield f'{found.missing} messages of {found.topic}'
    if end:
        yield f'what follows: {end}'
    if alteration is not None and content.version != __version__:
        yield (
            f'{alteration.name} of event {alteration.event.number} '
            f'({alteration.event.type}) as this version words it'
        )
    if not end and events[-1].type is not EventType.RELEASE:
        yield (
            f'the end of the run: {content.topics[topics.JOURNAL].name} has no release, so the '
            'recording ended before the controller, or its last messages are missing'
        )
