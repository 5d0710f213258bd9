# SPDX-License-Identifier: Apache-2.0
"""Replay of a bag with its own configuration: the same numbers, or the first difference."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from blf_dsc_controller import __version__
from blf_dsc_controller.bags.content import Content, read_content
from blf_dsc_controller.bags.context import Context, read_context
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.law.factory import required_fields
from blf_dsc_controller.messages.journal import Event, EventType, decode
from blf_dsc_controller.messages.topics import FOREVER, JOURNAL
from blf_dsc_controller.replay.comparison import (
    Comparison,
    Difference,
    compare,
    expected,
    first,
)
from blf_dsc_controller.replay.rerun import rerun
from blf_dsc_controller.replay.states import States, arrivals, sampled_stamps

_TURNS = (EventType.ACTIVATE, EventType.DEACTIVATE, EventType.RESET, EventType.STOP)


@dataclass(frozen=True)
class Verification:
    """What a replay found.

    Attributes:
        states: that the law used.
        comparisons: one for each topic of the controller.
        events: that were replayed.
        safe_torques: number of replayed torques that are not the law's.
        remarks: what limits the result.
        difference: earliest difference, in a topic or in an event; None if there is none.
    """

    states: States
    comparisons: tuple[Comparison, ...]
    events: tuple[Event, ...]
    safe_torques: int
    remarks: tuple[str, ...]
    difference: Difference | None

    def count(self, event: EventType) -> int:
        """Number of replayed events of a type."""
        return sum(one.type is event for one in self.events)

    @property
    def turns(self) -> list[str]:
        """Activations, deactivations, resets and safe stops in turn."""
        return [
            f'safe stop ({one.content["reason"]})' if one.type is EventType.STOP else one.type
            for one in self.events
            if one.type in _TURNS
        ]


def verify(path: Path, namespace: str = '') -> Verification:
    """Replay a bag and compare every message of the controller bit for bit.

    Args:
        path: folder of the bag, or one of its storage files.
        namespace: of the robot, if the bag holds several.

    Raises:
        ConfigurationError: this version of the package cannot run the configuration.
        BlfDscError: the bag holds no journal or nothing to compare, it begins after the
            controller, or it cannot be read.
    """
    context, content = read_context(path), read_content(path, namespace)
    events, until, end = _events(path, content)
    config = _config(path, context, events[0])
    came = arrivals(content, config.joints, required_fields(config), until)
    start = next((one.stamp for one in events if one.type is EventType.START), None)
    if start is not None and start not in came.stamp:
        reason = (
            f'{path} does not hold the first state that the controller used, with the stamp '
            f'{start} ns, so its state at any later one is not known: start the recorder first'
        )
        raise BlfDscError(reason)
    in_step = context.facts.get('clock') == 'lockstep'
    run = rerun(config, events[1:], came, sampled_stamps(content), in_step=in_step)
    gappy = [topic for topic in content.message_counts if context.missed(topic)]
    columns = expected(config, run.samples, run.monitored)
    comparisons = tuple(compare(content, run.states, columns, run.commands, config.joints, gappy))
    if not (run.departure or any(one.values for one in comparisons)):
        raise _nothing_to_compare(path, content)
    found = first(comparisons)
    if run.departure and not (found and found.stamp < run.departure.stamp):
        found = run.departure
    return Verification(
        run.states,
        comparisons,
        run.events,
        int(np.count_nonzero(~run.commands.of_law)),
        tuple(_remarks(context, run.end or end)),
        found,
    )


def _events(path: Path, content: Content) -> tuple[list[Event], int, str]:
    """Events of the first controller of a bag, when [ns] another one was started, and that text."""
    recorded = content.topics.get(JOURNAL)
    if recorded is None:
        raise _nothing_to_compare(path, content)
    events: list[Event] = []
    for received, raw in zip(recorded.received, recorded.raw, strict=True):
        event = decode(raw)
        if events and event.type is EventType.CONFIGURE:
            return events, received, 'another controller was started'
        events.append(event)
    if events[0].type is not EventType.CONFIGURE:
        reason = f'{path} does not hold the beginning of {recorded.name}: start the recorder first'
        raise BlfDscError(reason)
    return events, FOREVER, ''


def _config(path: Path, context: Context, event: Event) -> ControllerConfig:
    source = f'{path}, {JOURNAL.resolved}'
    if context.version != __version__:
        source += f' by version {context.version or "unknown"}, not {__version__}'
    return build(ControllerConfig, event.content['parameters'], source)


def _nothing_to_compare(path: Path, content: Content) -> BlfDscError:
    listing = ''.join(f'\n  {name} ({count})' for name, count in content.message_counts.items())
    return BlfDscError(
        f'{path} holds nothing that the controller published, or not its journal, so there is '
        f'nothing to compare; it holds:{listing}\nTo see what a configuration would command, '
        'use --config'
    )


def _remarks(context: Context, end: str) -> Iterator[str]:
    if end:
        yield f'{end}: the replay ends there'
    for topic, what in context.losses.items():
        yield f'the recorder did not get all of {topic}: {what}'
    if context.version != __version__:
        yield (
            f'recorded by version {context.version or "unknown"} and replayed by {__version__}: '
            'differences may come from the software'
        )
