# SPDX-License-Identifier: Apache-2.0
"""The events of a loop: those of its controller, of motions, and of a simulated arm."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from math import inf, isnan, nan
from typing import Any

from blf_dsc_controller.messages.journal import MOTIONS, Event, EventType
from blf_dsc_controller.view.newest import LONGEST
from blf_dsc_controller.view.plant_events import plant_events

_LISTED = 12
_PAUSE = 1.0  # s without targets, after which another stream is listed
_DETAILS = ('reason', 'text', 'parameters')  # of an event of the journal


class Events:
    """The last events, and their times since the start of the controller.

    Attributes:
        listed: time [s], kind and text of each.
    """

    def __init__(self) -> None:
        self.listed: deque[tuple[float, str, str]] = deque(maxlen=_LISTED)
        self._start = -1  # ns; -1 before the first stamp
        self._planned: list[tuple[float, str, str]] = []  # of a simulated arm
        self._passed = -1.0  # s, time up to which these are listed
        self._last_target = -inf  # s
        self._latched = nan  # whether an excited window was latched at last

    def begin(self, stamp: int) -> None:
        """Count time from a stamp [ns]; events that are planned are ahead again."""
        self._start = stamp
        self._passed = -1.0

    def take_time(self, stamp: int) -> float:
        """Return the time [s] of a stamp [ns]; the first one counts as the start."""
        if self._start < 0 <= stamp:
            self._start = stamp
        return max(0.0, (stamp - self._start) * 1e-9)

    def plan(self, parameters: Mapping[str, Any], *, anew: bool) -> None:
        """Plan the events of a simulated arm with these parameters; `anew`: none is past."""
        self._planned = plant_events(parameters)
        if anew:
            self._passed = -1.0

    def pass_time(self, time: float) -> None:
        """List the events that were planned until this time [s]."""
        self.listed += [e for e in self._planned if self._passed < e[0] <= time]
        self._passed = time

    def add(self, time: float, kind: str, text: str) -> None:
        """List an event at a time [s]; others may send texts of any length."""
        shown = text if len(text) <= LONGEST else f'{text[:LONGEST]} ...'
        self.listed.append((time, kind[:LONGEST], shown))

    def add_event(self, event: Event) -> None:
        """List an event of the controller's journal."""
        details = [f'{event.content[k]}' for k in _DETAILS if k in event.content]
        self.add(self.take_time(event.stamp), event.type.value, ', '.join(details))

    def add_motion(self, event: Event) -> None:
        """List a trajectory, or a stream of targets when it begins."""
        if event.type not in MOTIONS:
            return
        time = self.take_time(event.stamp)
        if event.type is not EventType.TARGET:
            self.add(time, event.type.value, f'{len(event.content["points"])} points')
            return
        if not 0.0 <= time - self._last_target < _PAUSE:
            self.add(time, 'stream', 'of targets')
        self._last_target = time

    def note_latch(self, time: float, latched: float) -> None:
        """List where learning begins or restarts.

        `latched`: whether an excited window is, 0 or 1; NaN: it is not known.
        """
        before, self._latched = self._latched, latched
        if isnan(before) or isnan(latched) or before == latched:
            return
        text = 'excited window latched' if latched else 'restarts: the arm has changed'
        self.add(time, 'learning', text)

    def forget_latch(self) -> None:
        """Begin with a law of which it is not known whether it has latched a window."""
        self._latched = nan
