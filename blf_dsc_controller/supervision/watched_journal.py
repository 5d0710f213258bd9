# SPDX-License-Identifier: Apache-2.0
"""The journal of a watched controller: its parameters, and when its silence is meant.

A controller that has not commanded yet may be a restarted one, while the watchdog holds the
arm, or a second one beside one in command.  Until it starts, its parameters do not count, and
its end changes nothing.
"""

from __future__ import annotations

from enum import Enum
from typing import Any

from blf_dsc_controller.messages.journal import Event, EventType

Parameters = dict[str, Any]
_BACK_IN_COMMAND = (EventType.ACTIVATE, EventType.RESET)


class Meaning(Enum):
    """What an event means to the watchdog."""

    NOTHING = 'nothing'
    BACK = 'back'  # the controller will command again
    SILENT = 'silent'  # it commands no more, on purpose
    LEFT = 'left'  # likewise, but the arm moves


class WatchedJournal:
    """Follows the events of the controllers of one journal.

    Attributes:
        parameters: those in force; empty before the first configuration.
    """

    def __init__(self) -> None:
        self.parameters: Parameters = {}
        self._next: Parameters | None = None  # of a controller before its start
        self._next_number = 0  # of its next event

    def take(self, event: Event, *, is_engaged: bool) -> Meaning:
        """Take an event; `is_engaged`: the watchdog or a controller commands."""
        if event.type is EventType.CONFIGURE:
            return self._configure(event, is_engaged=is_engaged)
        is_next = event.number == self._next_number and event.commands == 0
        if self._next is not None and is_next:
            return self._take_of_next(event)
        if event.type is EventType.PARAMETERS and self.parameters:
            self.parameters = self.parameters | event.content['parameters']
        if event.type in _BACK_IN_COMMAND:
            return Meaning.BACK
        return _end_of(event)

    def adopt_next(self) -> None:
        """Let the parameters of a controller count that has not started."""
        if self._next is not None:
            self.parameters = self._next
            self._next = None

    def _configure(self, event: Event, *, is_engaged: bool) -> Meaning:
        """Keep the parameters of a new controller; adopt them unless another commands."""
        self._next = event.content['parameters']
        self._next_number = event.number + 1
        if is_engaged:
            return Meaning.NOTHING
        self.adopt_next()
        return Meaning.BACK

    def _take_of_next(self, event: Event) -> Meaning:
        """Take an event of the controller that has not started yet."""
        self._next_number += 1
        if event.type is EventType.START:
            self.adopt_next()
            return Meaning.BACK
        if event.type is EventType.PARAMETERS:
            self._next = (self._next or {}) | event.content['parameters']
        elif event.type is EventType.RELEASE:
            self._next = None
        return Meaning.NOTHING


def _end_of(event: Event) -> Meaning:
    """Return whether a controller that has commanded ends with this event, and how."""
    if event.commands == 0:
        return Meaning.NOTHING
    if event.type is EventType.WITHDRAW:
        return Meaning.SILENT
    if event.type is EventType.RELEASE:
        return Meaning.SILENT if event.content.get('resting', True) else Meaning.LEFT
    return Meaning.NOTHING
