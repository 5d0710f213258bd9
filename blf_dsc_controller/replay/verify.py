# SPDX-License-Identifier: Apache-2.0
"""Replay of a bag with its own configuration: equal, or the first difference."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from blf_dsc_controller import __version__
from blf_dsc_controller.bags.content import NO_NAMES, Content, NameMap, read_content
from blf_dsc_controller.bags.topic_messages import (
    JointStates,
    UnreadableMessageError,
)
from blf_dsc_controller.configuration import law_file
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import CONTROLLER
from blf_dsc_controller.configuration.schema import flatten
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.event_content import FORMAT
from blf_dsc_controller.messages.journal import Event, EventType
from blf_dsc_controller.replay.comparison import Comparison, compared
from blf_dsc_controller.replay.rerun import Difference, Rerun

_OTHERS = (topics.STATE, topics.DIAGNOSTICS, topics.EXTERNAL_WRENCH)
_TRANSITIONS = (
    EventType.ACTIVATE,
    EventType.DEACTIVATE,
    EventType.RESET,
    EventType.STOP,
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
    if law:  # before a large bag is read
        law_file.check_pinned(law)
    content = read_content(path, namespace, names)
    events, until, other = _events(content)
    _check_format(path, events[0])
    config = content.exact_config(law)
    run, answers = _rerun(content, config, events, until)
    comparisons = tuple(compared(content, run, answers, config.joints))
    if run.departure is None and not any(found.values for found in comparisons):
        raise _nothing_to_compare(content)
    end = run.end or other
    newer = sorted(flatten(config).keys() - content.configurations[CONTROLLER].keys())
    changed_law = _changed_law(config, events[0])
    return Verification(
        samples=run.samples,
        duration=(run.last - run.first) * 1e-9,
        skipped=run.skipped,
        comparisons=comparisons,
        not_compared=tuple(
            content.topics[topic].name for topic in _OTHERS if topic in content.topics
        ),
        events=tuple(run.events),
        motions=run.motions,
        remarks=tuple(_remarks(content, end, newer, changed_law)),
        incomplete=tuple(
            _incomplete(content, events, comparisons, end, run.alteration)
        ),
        difference=_first_difference(content, run, comparisons),
    )


def _rerun(
    content: Content,
    config: ControllerConfig,
    events: Sequence[Event],
    until: int,
) -> tuple[Rerun, JointStates]:
    """Run what was received before `until` [ns] again; return it with the recorded answers.

    Raises:
        BlfDscError: the first state is missing, or an event cannot be repeated.
    """
    states, errors = content.topics[topics.JOINT_STATES].readable_states(
        content.joints_of(config.joints), ('position',)
    )
    _check_first_state(content.path, events, states)
    messages = content.topics[topics.TRACKING_ERROR]
    answers = _before(messages.joint_states(config.joints, ()), until)
    commands = _commands_before(content, until)
    run = Rerun(config, _before(states, until), errors, answers, commands)
    motions = (event for received, event in content.motions if received < until)
    run.run(events[1:], motions)
    return run, answers


def _first_difference(
    content: Content, run: Rerun, comparisons: Sequence[Comparison]
) -> Difference | None:
    """Return the earliest difference; of those with the same stamp, the departure."""
    differences = [found.difference for found in comparisons if found.difference]
    if run.departure is not None:
        differences.insert(0, run.departure)
    if run.alteration is not None and content.version == __version__:
        journal = content.topics[topics.JOURNAL].name
        differences.append(run.alteration._replace(topic=journal))
    return min(differences, key=lambda found: found.stamp, default=None)


def _check_format(path: str | Path, configure: Event) -> None:
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
    """Return the number of torques received before a time [ns]; 0 if it is not known."""
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
    alteration: Difference | None,
) -> Iterator[str]:
    """Yield what is missing in the recording: messages, its end, texts of this version."""
    for found in comparisons:
        if found.missing:
            yield f'{found.missing} messages of {found.topic}'
    if end:
        yield f'what follows: {end}'
    if alteration is not None and content.version != __version__:
        yield f'{alteration.field} as this version words it'
    if not end and events[-1].type is not EventType.RELEASE:
        yield (
            f'the end of the run: {content.topics[topics.JOURNAL].name} has no release, so the '
            'recording ended before the controller, or its last messages are missing'
        )
