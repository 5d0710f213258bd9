# SPDX-License-Identifier: Apache-2.0
"""Watchdogs over many samples: missed states, silence, and whether it can be noticed."""

from __future__ import annotations

PERIOD = 0.008
"""Time [s] between two checks of the steady clock during a silence."""

_SAME_CLOCK = 60.0  # s that a live stamp may differ from this computer's time
_MARGIN = 0.001  # s past the limit, for a state that is on its way
_NANO = 1e-9


def why_unwatched(stamp: int, wall: int) -> str:
    """Why the steady clock is no measure of a silence: the stamp [ns] is of no clock like `wall`.

    Empty if it is.
    """
    behind = (wall - stamp) * _NANO
    if abs(behind) < _SAME_CLOCK:
        return ''
    where = f'{abs(behind):.4g} s {"behind" if behind > 0.0 else "ahead of"}'
    return (
        f"the stamps of the joint states are {where} this computer's clock: a silence is not "
        'noticed; for an arm set safety.watchdog to on, for a simulation to off'
    )


class Overruns:
    """Joint states that the stamps jump over, averaged exponentially.

    Counted in the plant's time: a slow computer in lock-step misses none.

    Attributes:
        fraction: of the states that were missed, from 0 to 1.
        count: states missed since the start.
    """

    def __init__(self) -> None:
        self.fraction = 0.0
        self.count = 0

    def count_sample(self, samples: int, memory: float) -> None:
        """Count a state that is `samples` after the last; `memory` is in samples."""
        keep = 1.0 - min(1.0, 1.0 / memory)
        self.fraction *= keep
        if samples > 1:
            missed = samples - 1
            self.count += missed
            self.fraction = 1.0 - (1.0 - self.fraction) * keep**missed


class Silence:
    """Time on the steady clock since the last joint state.

    A check that is itself late proves nothing, since states may wait in the queue behind it; the
    next one decides. `next_check` is the time [s] from the last check to the next.
    """

    def __init__(self) -> None:
        self.next_check = PERIOD
        self._last_state = -1
        self._last_check = -1

    def restart(self, now: int = -1) -> None:
        """Count from a state at `now` [ns]; without one, from the next state on."""
        self._last_state = now

    def check(self, now: int, limit: float) -> float:
        """Return the length of a silence [s] past `limit` [s], else 0; `now` is in ns."""
        is_late = (now - self._last_check) * _NANO > self.next_check + PERIOD
        self._last_check = now
        silent = (now - self._last_state) * _NANO if self._last_state >= 0 else 0.0
        self.next_check = limit - silent + _MARGIN if silent <= limit else PERIOD
        return silent if silent > limit and not is_late else 0.0
