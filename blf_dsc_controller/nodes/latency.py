# SPDX-License-Identifier: Apache-2.0
"""How long an arm waits for its torques."""

from __future__ import annotations


class Latency:
    """Time from a published state to the torque that follows it, and how often none came in time.

    A torque does not say which state it answers. It is held against the oldest state that has had
    no torque yet, so that a torque that comes late counts with all of its lateness.

    Attributes:
        late_steps: steps that had to be taken before any torque had come for their state.
    """

    def __init__(self) -> None:
        self.late_steps = 0
        self._since: float | None = None
        self._worst = 0.0

    def asked(self, now: float) -> None:
        """Take note that a state has been published at this time [s]."""
        if self._since is None:
            self._since = now

    def answered(self, now: float) -> None:
        """Take note that a torque has come at this time [s]."""
        if self._since is not None:
            self._worst = max(self._worst, now - self._since)
            self._since = None

    def step(self, now: float) -> float:
        """End a sample: the longest wait in it [s], or how long it has waited in vain so far."""
        if self._since is not None:
            self.late_steps += 1
            return now - self._since
        worst, self._worst = self._worst, 0.0
        return worst
