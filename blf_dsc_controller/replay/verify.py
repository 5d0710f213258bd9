# SPDX-License-Identifier: Apache-2.0
"""Replay of a bag with its own configuration: the same numbers, or the first difference."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from blf_dsc_controller import __version__
from blf_dsc_controller.bags.content import NO_NAMES, Content, NameMap, read_content
from blf_dsc_controller.bags.topic_messages import JointStates
from blf_dsc_controller.configuration.schema import flatten
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.codecs import MessageError
from blf_dsc_controller.messages.journal import FORMAT, Event, EventType, machine
from blf_dsc_controller.messages.topics import (
    DIAGNOSTICS,
    FOREVER,
    JOINT_STATES,
    JOURNAL,
    STATE,
    TRACKING_ERROR,
)
from blf_dsc_controller.replay.comparison import Comparison, Difference
from blf_dsc_controller.replay.rerun import Rerun

_TRANSITIONS = (EventType.ACTIVATE, EventType.DEACTIVATE, EventType.RESET, EventType.STOP)


class Verification(NamedTuple):
    """Result of a verification."""

    samples: int  #: number of states that the law used
    duration: float  #: s, from the first of them to the last
    passed_over: int  #: number of states that the controller did not answer
    comparisons: tuple[Comparison, ...]  #: one for each topic of the controller with numbers
    not_compared: tuple[str, ...]  #: topics with text
    events: tuple[Event, ...]  #: replayed events
    safe_torques: int  #: number of replayed torques that are not the law's
    remarks: tuple[str, ...]  #: limitations of the result
    difference: Difference | None  #: the earliest, in a topic or in an event

    @property
    def compared(self) -> float:
        """Fraction of the controller's outputs in the bag that could be compared."""
        recorded = sum(found.recorded for found in self.comparisons)
        return sum(found.values for found in self.comparisons) / recorded if recorded else 0.0

    @property
    def transitions(self) -> list[str]:
        """Activations, deactivations, resets and safe stops in order."""
        return [
            f'safe stop ({event.content["reason"]})' if event.type is EventType.STOP else event.type
            for event in self.events
            if event.type in _TRANSITIONS
        ]


def verify(path: Path, namespace: str = '', names: NameMap = NO_NAMES) -> Verification:
    """Replay a bag and compare every number of the controller bit for bit.

    `namespace` is that of the robot, if the bag holds several; `names` maps topics and joints that
    have other names in the bag.

    Raises:
        ConfigurationError: this version of the package cannot run the configuration.
        BlfDscError: the bag holds no journal or nothing to compare, begins after the controller,
            or cannot be read.
    """
    content = read_content(path, namespace, names)
    events, until, end = _events(content)
    config = content.controller_config()
    newer = sorted(flatten(config).keys() - events[0].content['parameters'].keys())
    errors: dict[int, MessageError] = {}
    states = content.topics[JOINT_STATES].joint_states(
        names.joints_of(config.joints), ('position',), errors
    )
    start = next((event.stamp for event in events if event.type is EventType.START), None)
    if start is not None and start not in states.stamp:
        raise BlfDscError(
            f'{path} does not hold the first state that the controller used, with the stamp '
            f'{start} ns, so its outputs cannot be reproduced: start the recorder first'
        )
    answers = _before(content.topics[TRACKING_ERROR].joint_states(config.joints, ()), until)
    run = Rerun(config, _before(states, until), errors, answers)
    run.run(events[1:])
    outputs = run.outputs
    comparisons = tuple(outputs.compare(content, answers))
    if not (run.departure or any(found.values for found in comparisons)):
        raise _nothing_to_compare(content)
    differences = [run.departure, *(found.difference for found in comparisons)]
    return Verification(
        outputs.count,
        outputs.duration,
        run.passed_over,
        comparisons,
        tuple(
            content.topics[topic].name for topic in (STATE, DIAGNOSTICS) if topic in content.topics
        ),
        tuple(run.events),
        outputs.safe_torques,
        (*_remarks(content, run.end or end, newer), *_other_machine(events[0])),
        min((found for found in differences if found), key=lambda found: found.stamp, default=None),
    )


def _events(content: Content) -> tuple[list[Event], int, str]:
    """Return the events of a bag's first controller, when the next begins [ns], and a remark."""
    if not {JOURNAL, TRACKING_ERROR} <= content.topics.keys():
        raise _nothing_to_compare(content)
    begins = [k for k, (_, event) in enumerate(content.events) if event.type is EventType.CONFIGURE]
    events = [event for _, event in content.events]
    if not begins or begins[0] > 0:
        raise BlfDscError(
            f'{content.path} does not hold the beginning of {content.topics[JOURNAL].name}: start '
            'the recorder first'
        )
    if events[0].content.get('format', 1) < FORMAT:
        raise BlfDscError(
            f'{content.path} was recorded by an earlier version, whose controller did not say '
            'which states it used, so that it cannot be replayed; report, plot, export and '
            'replay --config read it'
        )
    if len(begins) > 1:
        return events[: begins[1]], content.events[begins[1]][0], 'another controller was started'
    return events, FOREVER, ''


def _before(states: JointStates, until: int) -> JointStates:
    """Return the messages received before a time [ns]."""
    rows = np.flatnonzero(states.received < until)
    return states if rows.size == states.size else states.select(rows)


def _nothing_to_compare(content: Content) -> BlfDscError:
    listing = ''.join(f'\n  {name} ({count})' for name, count in content.message_counts.items())
    return BlfDscError(
        f'{content.path} lacks the messages of the controller or its journal, so '
        f'there is nothing to compare; it holds:{listing}\nTo see what a configuration would '
        'command, use --config'
    )


def _remarks(content: Content, end: str, newer: Sequence[str]) -> Iterator[str]:
    if end:
        yield f'{end}: the replay ends there'
    for topic, what in content.losses.items():
        yield f'the recorder missed messages of {topic}: {what}'
    if content.version != __version__:
        yield (
            f'recorded by version {content.version or "unknown"} and replayed by {__version__}: '
            'differences may come from the software'
        )
    if newer:
        yield (
            f'recorded before the law had {", ".join(newer)}: replayed with the present law and '
            'its defaults, so differences come from the software'
        )


def _other_machine(configured: Event) -> Iterator[str]:
    """Remark on what may change the last digits of sine, exponential and tanh."""
    recorded, here = configured.content.get('machine', {}), machine()
    for name, value in recorded.items():
        if value != here.get(name, ''):
            yield (
                f'recorded with {name} {value or "unset"} and replayed with '
                f'{here.get(name) or "unset"}: sine, exponential and tanh may differ in the last '
                'digit'
            )
