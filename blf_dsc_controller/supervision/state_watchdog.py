# SPDX-License-Identifier: Apache-2.0
"""The watchdog for missing joint states."""

from __future__ import annotations

from collections.abc import Callable

from blf_dsc_controller.run import NANOSECOND

PERIOD = 0.008
"""Time [s] between two checks of the steady clock."""

SAME_CLOCK = 60.0
"""Time [s] that a live stamp may differ from this computer's clock."""

LONG_SILENCE = 2.0
"""Silence of the joint states [s] after which nobody expects a torque any more."""

_IN_TRANSIT = 0.001  # s past the limit, for a state on its way


class Watchdog:
    """Measures the silence since the last joint state.

    A check that is itself late proves nothing, since states may be waiting in the
    queue; the next check decides.

    Attributes:
        on: whether a silence leads to a stop.
        why_off: why it is off although safety.watchdog is `auto`; else empty.
        torques: number commanded in the current silence.
    """

    def __init__(self, steady: Callable[[], int], wall: Callable[[], int]) -> None:
        """`steady` and `wall` are the clocks [ns]."""
        self.on = False
        self.why_off = ''
        self.torques = 0
        self._steady, self._wall = steady, wall
        self._last_state = -1
        self._last_check = -1

    def switch(self, mode: str, stamp: int) -> None:
        """Switch on or off; `auto`: by whether the stamps [ns] are wall-clock time."""
        self.why_off = ''
        behind = (self._wall() - stamp) * NANOSECOND
        if mode == 'auto' and abs(behind) >= SAME_CLOCK:
            where = f'{abs(behind):.4g} s {"behind" if behind > 0.0 else "ahead of"}'
            self.why_off = (
                f"the stamps of the joint states are {where} this computer's clock: a silence is "
                'not detected; set safety.watchdog to on for an arm, or to off for a simulation'
            )
        self.on = mode != 'off' and not self.why_off

    def restart(self) -> None:
        """Measure the silence from now on."""
        self._last_state = self._steady()

    def wait(self) -> None:
        """Measure the silence from the next state on."""
        self._last_state = -1

    def measure_silence(self, limit: float) -> float:
        """Return the length of a silence [s] if it exceeds `limit` [s], else 0."""
        now = self._steady()
        is_late = (now - self._last_check) * NANOSECOND > 2.0 * PERIOD
        self._last_check = now
        silent = (now - self._last_state) * NANOSECOND if self._last_state >= 0 else 0.0
        return silent if silent > limit + _IN_TRANSIT and not is_late else 0.0
