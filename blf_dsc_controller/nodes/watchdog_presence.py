# SPDX-License-Identifier: Apache-2.0
"""Whether the node torque_watchdog is there, of a controller that relies on it."""

from __future__ import annotations

_GRACE = 10  # looks in vain, until one that was promised but never seen is missing


class WatchdogPresence:
    """Follows whether a watchdog is present; once seen, it is expected.

    Attributes:
        is_missing: whether one is expected, but not there.
    """

    def __init__(self, *, expected: bool) -> None:
        """Expect one from the start, if `expected`."""
        self.is_missing = False
        self._expected = expected
        self._seen = False
        self._absences = 0

    @property
    def problem(self) -> str:
        """What is wrong; empty if nothing is."""
        if not self.is_missing:
            return ''
        return (
            'torque_watchdog is missing: if this process dies, its last torque stays: '
            'start it again'
        )

    def look(self, *, there: bool) -> bool:
        """Note whether one is present; return whether it has just disappeared."""
        was_missing = self.is_missing
        self._seen = self._seen or there
        self._absences = 0 if there else self._absences + 1
        is_due = self._seen or self._absences > _GRACE
        self.is_missing = not there and is_due and (self._expected or self._seen)
        return self.is_missing and not was_missing
