# SPDX-License-Identifier: Apache-2.0
"""Replay of a bag with its own configuration: the same numbers, or the first difference."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from blf_dsc_controller import __version__
from blf_dsc_controller.bags.content import NO_NAMES, Content, NameMap, read_content
from blf_dsc_controller.bags.context import Context, read_context
from blf_dsc_controller.bags.topic_messages import JointStates, UnreadableMessageError
from blf_dsc_controller.configuration.schema import flatten
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.cdr import MessageError
from blf_dsc_controller.messages.journal import Event, EventType, decode
from blf_dsc_controller.messages.topics import JOINT_STATES, JOURNAL
from blf_dsc_controller.replay.comparison import Comparison, Difference, compare
from blf_dsc_controller.replay.rerun import Rerun
from blf_dsc_controller.replay.states import sampled_stamps
from blf_dsc_controller.run import Stamps

_TURNS = (EventType.ACTIVATE, EventType.DEACTIVATE, EventType.RESET, EventType.STOP)


class Verification(NamedTuple):
    """Result of a verification."""

    stamp: Stamps  #: (N,) ns, of the states that the law used
    passed_over: int  #: number of states that it did not use
    comparisons: tuple[Comparison, ...]  #: one for each topic of the controller
    events: tuple[Event, ...]  #: replayed events
    safe_torques: int  #: number of replayed torques that are not the law's
    remarks: tuple[str, ...]  #: limitations of the result
    difference: Difference | None  #: the earliest, in a topic or in an event

    @property
    def compared(self) -> float:
        """Fraction of the controller's outputs in the bag that could be compared."""
        recorded = sum(one.recorded for one in self.comparisons)
        return sum(one.values for one in self.comparisons) / recorded if recorded else 0.0

    @property
    def turns(self) -> list[str]:
        """Activations, deactivations, resets and safe stops in order."""
        return [
            f'safe stop ({one.content["reason"]})' if one.type is EventType.STOP else one.type
            for one in self.events
            if one.type in _TURNS
        ]


def verify(path: Path, namespace: str = '', names: NameMap = NO_NAMES) -> Verification:
    """Replay a bag and compare every message of the controller bit for bit.

    `namespace` is that of the robot, if the bag holds several; `names` maps topics and joints that
    have other names in the bag.

    Raises:
        ConfigurationError: this version of the package cannot run the configuration.
        BlfDscError: the bag holds no journal or nothing to compare, begins after the controller,
            or cannot be read.
    """
    context, content = read_context(path), read_content(path, namespace, names)
    events, content, end = _events(content)
    recorded = events[0].content['parameters']
    config = context.build_config(recorded, JOURNAL.resolved)
    newer = sorted(flatten(config).keys() - recorded.keys())
    states, errors = _states(content, names.joints_of(config.joints))
    start = next((one.stamp for one in events if one.type is EventType.START), None)
    if start is not None and start not in states.stamp:
        reason = (
            f'{path} does not hold the first state that the controller used, with the stamp '
            f'{start} ns, so its outputs cannot be reproduced: start the recorder first'
        )
        raise BlfDscError(reason)
    run = Rerun(config, states, errors, sampled_stamps(content))
    run.run(events[1:], in_step=context.facts.get('clock') == 'lockstep')
    gappy = [topic for topic in content.message_counts if context.missed(topic)]
    comparisons = tuple(compare(content, config, run.outputs, gappy))
    if not (run.departure or any(one.values for one in comparisons)):
        raise _nothing_to_compare(content)
    found = [run.departure, *(one.difference for one in comparisons)]
    return Verification(
        run.outputs.stamp,
        run.passed_over,
        comparisons,
        tuple(run.events),
        int(np.count_nonzero(~run.outputs.commands.of_law)),
        tuple(_remarks(context, run.end or end, newer)),
        min((one for one in found if one), key=lambda one: one.stamp, default=None),
    )


def _events(content: Content) -> tuple[list[Event], Content, str]:
    """Return the events of a bag's first controller, the content up to the next, and a remark."""
    recorded = content.topics.get(JOURNAL)
    if recorded is None:
        raise _nothing_to_compare(content)
    events: list[Event] = []
    for received, raw in zip(recorded.received, recorded.raw, strict=True):
        event = decode(raw)
        if events and event.type is EventType.CONFIGURE:
            return events, content.before(received), 'another controller was started'
        events.append(event)
    if events[0].type is not EventType.CONFIGURE:
        raise BlfDscError(
            f'{content.path} does not hold the beginning of {recorded.name}: start the recorder '
            'first'
        )
    return events, content, ''


def _states(content: Content, joints: Sequence[str]) -> tuple[JointStates, dict[int, MessageError]]:
    """Return all joint states, and the errors of the unreadable ones by number.

    Raises:
        UnreadableMessageError: none of them can be read.
    """
    recorded = content.topics[JOINT_STATES]
    errors: dict[int, MessageError] = {}
    states = recorded.joint_states(joints, ('position',), errors)
    if len(errors) == len(recorded.received):
        raise UnreadableMessageError(recorded.name, 0, errors[0])
    return states, errors


def _nothing_to_compare(content: Content) -> BlfDscError:
    listing = ''.join(f'\n  {name} ({count})' for name, count in content.message_counts.items())
    return BlfDscError(
        f'{content.path} lacks the messages of the controller or its journal, so '
        f'there is nothing to compare; it holds:{listing}\nTo see what a configuration would '
        'command, use --config'
    )


def _remarks(context: Context, end: str, newer: Sequence[str]) -> Iterator[str]:
    if end:
        yield f'{end}: the replay ends there'
    for topic, what in context.losses.items():
        yield f'the recorder missed messages of {topic}: {what}'
    if context.version != __version__:
        yield (
            f'recorded by version {context.version or "unknown"} and replayed by {__version__}: '
            'differences may come from the software'
        )
    if newer:
        yield (
            f'recorded before the law had {", ".join(newer)}: replayed with the present law and '
            'its defaults, so differences come from the software'
        )
