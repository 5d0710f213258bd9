# SPDX-License-Identifier: Apache-2.0
"""What was done to the controller between two joint states, and why it stopped, as a bag tells.

The node counts its operations and its stops on `~/state`, and tells there the stamp of the last
joint state that had come by then; a trajectory that it took has that stamp on
`~/accepted_trajectory`, and a change of parameters on `~/bound` (see replay.changes).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from blf_dsc_controller.bags.content import Content, TopicMessages
from blf_dsc_controller.messages.names import (
    LAST_STATE,
    OPERATION,
    OPERATIONS,
    PHASE,
    REASON,
    STOPS,
)
from blf_dsc_controller.messages.topics import ACCEPTED_TRAJECTORY, FOREVER, STATE
from blf_dsc_controller.messages.trajectory import nanoseconds, told_request
from blf_dsc_controller.messages.types import typestore
from blf_dsc_controller.replay.law import Change
from blf_dsc_controller.supervision.guard import Guard
from blf_dsc_controller.supervision.reasons import Operation, Phase, Reason

TRAJECTORY = 'trajectory'
PARAMETERS = 'parameters'
SILENT = frozenset((Reason.STATE_TIMEOUT, Reason.FAILED))
"""Reasons that lie in no joint state."""

UNREADABLE = frozenset(
    (Reason.BAD_MESSAGE, Reason.JOINT_MISSING, Reason.JOINT_DUPLICATED, Reason.FIELD_MISSING)
)
"""Reasons that lie in a message without a stamp."""

OUT_OF_ORDER = frozenset((Reason.STAMP_BACKWARD, Reason.STAMP_MISSING))
"""Reasons that lie in a stamp which says nothing of the order in time."""

_BEFORE = -1  # stamp before the first state
_NONE = str(_BEFORE)
_STARTS = frozenset((Operation.ACTIVATE.value, Operation.RESET.value))
_ACTS: dict[Operation, Callable[[Guard], None]] = {
    Operation.ACTIVATE: Guard.activate,
    Operation.DEACTIVATE: Guard.deactivate,
    Operation.RESET: Guard.reset,
}


@dataclass(frozen=True)
class Order:
    """Something done to the controller.

    Attributes:
        after: stamp of the last joint state that had come by then [ns].
        told: when the recorder heard of it [ns].
        what: an operation, `TRAJECTORY` or `PARAMETERS`.
        act: does it once more.
    """

    after: int
    told: int
    what: str
    act: Callable[[Guard], None]


@dataclass(frozen=True)
class Stop:
    """A safe stop.

    Attributes:
        after: stamp of the last joint state that had come by then, mostly the reason [ns].
        told: when the recorder heard of it [ns].
        reason: of the stop.
    """

    after: int
    told: int
    reason: Reason


Event = Order | Stop


@dataclass(frozen=True)
class History:
    """Orders and stops in turn.

    Attributes:
        events: in their order.
        until: when the recorder heard of something that cannot be replayed [ns].
        end: what that was, in words.
    """

    events: tuple[Event, ...]
    until: int = FOREVER
    end: str = ''

    @property
    def starts(self) -> tuple[int, ...]:
        """Stamps [ns] behind which the controller began, or began again."""
        return tuple(
            one.after for one in self.events if isinstance(one, Order) and one.what in _STARTS
        )

    def including(self, orders: Iterable[Order]) -> History:
        """Put more orders in their places."""
        events = [*self.events, *(one for one in orders if one.told < self.until)]
        reasons = {one.reason for one in events if isinstance(one, Stop)}
        # Stamps tell the order best, unless they are what was wrong.
        events.sort(key=_by_time if reasons & OUT_OF_ORDER else _by_stamp)
        return replace(self, events=tuple(events))


def history_of(content: Content) -> History | None:
    """What `~/state` tells; None if the bag has none, or one of a version that did not tell."""
    events: list[Event] = []
    known: tuple[int, int] | None = None
    seen = False
    for told, values in _states(content.topics.get(STATE)):
        if OPERATIONS not in values:
            if known is not None:
                return History(tuple(events), told, 'the controller was released')
            continue
        now = int(values[OPERATIONS]), int(values[STOPS])
        if known is None:
            events += _begin(told, values, *now)
        elif now[0] < known[0] or now[1] < known[1] or (seen and values[LAST_STATE] == _NONE):
            return History(tuple(events), told, 'another controller was started')
        elif sum(now) - sum(known) > 1:
            return History(tuple(events), told, 'an operation or a stop is not in the bag')
        elif now != known:
            events.append(_event(told, values, is_stop=now[1] > known[1]))
        known, seen = now, values[LAST_STATE] != _NONE
    return None if known is None else History(tuple(events))


def trajectories(content: Content) -> Iterator[Order]:
    """Trajectories that were followed."""
    recorded = content.topics.get(ACCEPTED_TRAJECTORY)
    if recorded is None:
        return
    for told, raw in zip(recorded.received, recorded.raw, strict=True):
        message: Any = typestore().deserialize_cdr(raw, recorded.type)
        after = nanoseconds(message.header.stamp)
        yield Order(after, told, TRAJECTORY, partial(_follow, message))


def retunings(changes: Iterable[Change]) -> Iterator[Order]:
    """Changes of parameters."""
    for one in changes:
        yield Order(one.stamp, one.told, PARAMETERS, partial(_retune, one))


def _states(recorded: TopicMessages | None) -> Iterator[tuple[int, Mapping[str, str]]]:
    if recorded is None:
        return
    for told, raw in zip(recorded.received, recorded.raw, strict=True):
        message: Any = typestore().deserialize_cdr(raw, recorded.type)
        yield told, {pair.key: pair.value for pair in message.values}


def _begin(told: int, values: Mapping[str, str], operations: int, stops: int) -> Iterator[Event]:
    """What the first message tells, which may be about something that was a while ago."""
    if operations:
        is_new = values[PHASE] == Phase.STARTING.value and operations == 1
        after = int(values[LAST_STATE]) if is_new else _BEFORE
        yield Order(after, told, Operation.ACTIVATE.value, Guard.activate)
    if stops and values[PHASE] == Phase.SAFE_STOP.value:
        yield _event(told, values, is_stop=True)


def _event(told: int, values: Mapping[str, str], *, is_stop: bool) -> Event:
    after = int(values[LAST_STATE])
    if is_stop:
        return Stop(after, told, Reason(values[REASON]))
    operation = Operation(values[OPERATION])
    return Order(after, told, operation.value, _ACTS[operation])


def _follow(message: Any, guard: Guard) -> None:
    guard.follow(told_request(message, guard.start_stamp))


def _retune(change: Change, guard: Guard) -> None:
    guard.retune(change.config)


def _by_stamp(event: Event) -> tuple[int, int]:
    return event.after, event.told


def _by_time(event: Event) -> int:
    return event.told
