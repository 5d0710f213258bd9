# SPDX-License-Identifier: Apache-2.0
"""The torques that the node of the plant receives: which are valid, how old, how late.

They are the counterpart of the controller's checks of joint states: a motor that
applies an outdated torque, or one that is not finite, is as dangerous as a law that
commands one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LARGEST = 1e4
"""Largest valid torque [N m] of a command.

A step with 1e6 N m makes the arm diverge.
"""


class TorqueInput:
    """The last valid `torque` (n,) [N m], and counts of rejected commands.

    `problem` describes the last rejected command; `stale_steps` counts the steps for
    which the torque was too old.
    """

    def __init__(self, n: int) -> None:
        self.torque = np.zeros(n)
        self.problem = ''
        self.rejected = 0
        self.stale_steps = 0
        self._taken_at = 0

    def take(self, size: int, torque: NDArray[np.float64], sample: int) -> bool:
        """Store a command of `size` values, `torque` (n,), at a sample of the plant.

        Return whether it is valid; if not, `problem` describes why.
        """
        if size == self.torque.size and (np.abs(torque) <= LARGEST).all():
            self.torque[:] = torque
            self._taken_at = sample
            return True
        self.rejected += 1
        got = f'{torque} N m' if size == self.torque.size else f'{size} values'
        needed = f'{self.torque.size} of at most {LARGEST:g} N m are needed'
        self.problem = f'command rejected: got {got}, but {needed}'
        return False

    def count_stale(self, sample: int, limit: int) -> bool:
        """Count a step whose torque is older than `limit` samples; return whether it is."""
        stale = sample - self._taken_at > limit
        self.stale_steps += stale
        return stale

    def renew(self, sample: int) -> None:
        """Measure the age of the torque from `sample` on."""
        self._taken_at = sample


class Latency:
    """Time from a published state to its torque, and the number of late steps.

    A torque does not identify its state. It is matched with the oldest state that has
    had no torque yet, so that a late torque counts with its full delay. Times are in s;
    `late_steps` counts the steps taken before a torque for their state had arrived.
    """

    def __init__(self) -> None:
        self.late_steps = 0
        self._since: float | None = None
        self._longest = 0.0

    def state_published(self, now: float) -> None:
        """Start waiting, unless an older state has had no torque yet."""
        if self._since is None:
            self._since = now

    def torque_received(self, now: float) -> None:
        """Stop waiting."""
        if self._since is not None:
            self._longest = max(self._longest, now - self._since)
            self._since = None

    def step(self, now: float) -> float:
        """End a sample.

        Return its longest wait, or the wait of the oldest state so far.
        """
        if self._since is not None:
            self.late_steps += 1
            return now - self._since
        longest, self._longest = self._longest, 0.0
        return longest
