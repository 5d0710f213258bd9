# SPDX-License-Identifier: Apache-2.0
"""The motion of the last samples and its torques: what the arm carries besides its model.

The disturbance estimate of the law is an integral.  In motion it also contains friction, the
error of the inertia, and what it has wound up so far: held as a load, it would move light
joints.  The load that follows from the torques of the last samples contains none of these:

    load = mean of tau - H(q, dq, dq, ddq) P^ - friction

They show, too, by how much velocities come after their positions.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.law.sensor import LONG_GAP
from blf_dsc_controller.law.state import Settings
from blf_dsc_controller.supervision.model_torque import needed_torque

Array = NDArray[np.float64]

_GAP_TIME = 0.03  # s, in which an arm that another commands leaves its reference
_ACCELERATION_TIME = 0.1  # s: the noise of a difference of velocities over it is small
_BLOCKS = 10  # of it or some more, each with the mean acceleration in it
_LONGEST_LAG = 0.02  # s, of velocities
# of their square, what a lag may leave: a filter makes them smaller, too
_UNEXPLAINED = 0.25


def shortest_gap(sample_time: float) -> float:
    """Return the time [s] between two states that is too long to compare them."""
    return max(_GAP_TIME, LONG_GAP * sample_time)


def is_gap(elapsed: float, sample_time: float) -> bool:
    """Whether the time [s] since the last state is too long to compare the two."""
    return elapsed >= shortest_gap(sample_time)


class RecentMotion:
    """Positions, velocities and torques of the last 0.1 s of the law."""

    def __init__(self, n: int, sample_time: float) -> None:
        """`sample_time` is T [s]."""
        self._sample_time = sample_time
        samples = max(1, round(_ACCELERATION_TIME / sample_time))
        self._step = max(1, samples // _BLOCKS)  # samples in a block
        self._blocks = samples // self._step
        self.size = self._blocks * self._step + 1
        self._stamps = np.zeros(self.size, dtype=np.int64)
        self._states = np.zeros((self.size, 2 * n))
        self._torques = np.zeros((self.size, n))
        self._count = self._last_stamp = 0

    def restart(self) -> None:
        """Begin with the next sample."""
        self._count = 0

    def take(self, stamp: int, measurement: Array, torque: Array) -> None:
        """Take a state [q, dq, ...] with its stamp [ns], and its torque (n,) [N m]."""
        elapsed = 1e-9 * (stamp - self._last_stamp)
        if elapsed <= 0.0 or is_gap(elapsed, self._sample_time):
            self.restart()
        at = self._count % self.size
        self._stamps[at] = self._last_stamp = stamp
        self._states[at] = measurement[: self._states.shape[1]]
        self._torques[at] = torque
        self._count += 1

    @property
    def _order(self) -> NDArray[np.int64]:
        """Rows of all samples, the last one at the end."""
        return np.arange(self._count - self.size, self._count) % self.size

    @property
    def velocity_lags(self) -> list[float | None]:
        """How long velocities of each joint come after positions [s]; None: no lag shows."""
        n = self._torques.shape[1]
        if self._count < self.size:
            return [None] * n
        states = self._states[self._order]
        steps = 1e-9 * np.diff(self._stamps[self._order])  # s
        changes = np.diff(states[:, :n], axis=0) / steps[:, np.newaxis]
        speeds = 0.5 * (states[1:, n:] + states[:-1, n:])
        return [
            self._lag(change, speed)
            for change, speed in zip(changes.T, speeds.T, strict=True)
        ]

    def _lag(self, change: Array, speed: Array) -> float | None:
        """Return how long a speed (k,) comes after the change (k,) [rad/s] of a position [s]."""
        if not change @ speed > 0.0:  # beyond a quarter wave it may be a wrong sign
            return None
        most = round(_LONGEST_LAG / self._sample_time)
        left = [
            float(np.square(speed[most:] - change[most - k : change.size - k]).mean())
            for k in range(most + 1)
        ]
        best = int(np.argmin(left))
        if left[best] > _UNEXPLAINED * float(np.square(speed[most:]).mean()):
            return None
        return best * self._sample_time

    def load(self, settings: Settings, estimate: Array) -> Array | None:
        """Return the torque (n,) [N m] that the model lacks; None in the first 0.1 s.

        Torques since states repeat, although they say that the arm moves, are left out: the law
        has not seen what they do.
        """
        if self._count < self.size:
            return None
        order = self._order
        states = self._states[order]
        hangs = (states[1:] == states[:-1]).all(axis=1)
        hangs &= states[1:, self._torques.shape[1] :].any(axis=1)
        seen = 1 + int(np.flatnonzero(~hangs).max(initial=-1))
        if seen >= self._step:
            order = order[seen % self._step : seen + 1]
        stamps = self._stamps[order[:: self._step]]
        states = self._states[order[:: self._step]]
        torques = self._torques[order[:-1]]
        torques = torques.reshape(-1, self._step, torques.shape[1])
        steps = 1e-9 * np.diff(stamps)  # s
        means = 0.5 * (states[:-1] + states[1:])
        changes = np.diff(states, axis=0) / steps[:, np.newaxis]
        n = torques.shape[2]
        lacking = [
            torque.mean(axis=0)
            - needed_torque(settings, estimate, mean[:n], mean[n:], change[n:])
            for torque, mean, change in zip(torques, means, changes, strict=True)
        ]
        load = np.asarray(np.mean(lacking, axis=0))
        return load if np.isfinite(load).all() else None
