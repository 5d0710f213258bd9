# SPDX-License-Identifier: Apache-2.0
"""Whether the node torque_watchdog is there, of a controller that relies on it."""

from __future__ import annotations

from blf_dsc_controller.errors import StartError

_LONGEST_WAIT = 60.0  # s; it may have to compile first
_GRACE = 10  # looks in vain, until one that was promised but never seen is missing


class WatchdogPresence:
    """Follows whether a watchdog is present; once seen, it is expected.

    Attributes:
        is_missing: whether one is expected, but not there.
        is_ready: whether one has said that it can take over.
    """

    def __init__(self, *, expected: bool) -> None:
        """Expect one from the start, if `expected`."""
        self.is_missing = self.is_ready = False
        self._waits_since = -1.0  # s
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

    def delay_start(self, now: float) -> bool:
        """Return whether the start has to wait at the time `now` [s] of a steady clock.

        Raises:
            StartError: it has waited for too long.
        """
        if not self._expected or self.is_ready:
            self._waits_since = -1.0
            return False
        if self._waits_since < 0.0:
            self._waits_since = now
        if now - self._waits_since > _LONGEST_WAIT:
            self._waits_since = -1.0
            raise StartError(
                f'torque_watchdog is expected, and has not become ready within {_LONGEST_WAIT:g} '
                's: start it, see why it is not ready in /diagnostics, or set '
                'safety.expect_watchdog to false'
            )
        return True

    def look(self, *, there: bool) -> bool:
        """Note whether one is present; return whether it has just disappeared."""
        was_missing = self.is_missing
        self._seen = self._seen or there
        self._absences = 0 if there else self._absences + 1
        is_due = self._seen or self._absences > _GRACE
        self.is_missing = not there and is_due and (self._expected or self._seen)
        self.is_ready = self.is_ready and not self.is_missing
        return self.is_missing and not was_missing
