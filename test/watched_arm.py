# SPDX-License-Identifier: Apache-2.0
"""A scenario with a watchdog beside the controller, which may hang, or never come back."""

from __future__ import annotations

import numpy as np
from scenario import START, Scenario, State

from blf_dsc_controller.supervision.torque_watchdog import TorqueWatchdog

TIMEOUT = 0.05  # s, of the watchdog
PERIOD = 0.004  # s, of its checks
HOLDING = {'safety.torque': 'hold_gravity'}


def stamp_of(state):
    """Return the stamp of a state [ns]."""
    return round(1e9 * state.stamp)


class WatchedArm(Scenario):
    """An arm that gets the last torque of its controller or its watchdog, for ever.

    Attributes:
        line: the watchdog; None: there is none.
        taken: torques (n,) [N m] of the watchdog.
    """

    def __init__(self, preset, given=None, *, plant=None, watched=True):
        super().__init__(preset, HOLDING | (given or {}), plant=plant)
        self.line = TorqueWatchdog(self.config, TIMEOUT) if watched else None
        self.taken = []

    @property
    def now(self):
        """Time of the watchdog's clock [s]."""
        return self.plant.sample * self.T

    @property
    def speed(self):
        """True |dq| (n,) [rad/s]."""
        return np.abs(self.plant.truth()[-self.n :])

    def state(self):
        """Return the present state, as it is measured."""
        stamp = START + 1e-9 * self.plant.elapsed_ns
        return State(stamp, *self.plant.measure().copy().reshape(3, -1))

    def answer(self, state):
        """Let the controller answer a state; its torque replaces that of the watchdog."""
        self._applied = self.controller.update(
            state.stamp, state.q, state.dq, state.effort
        )
        if self.line is not None:
            self.line.take_torque(self._applied, self.now)

    def run(self, seconds, *, hangs=False):
        """Return the record; with `hangs`, the controller answers nothing."""
        if hangs:
            return super().run(seconds, spoil=lambda _: (), reach=self._watch)
        return super().run(seconds, reach=self._watch_controller)

    def _watch_controller(self, torque):
        if self.line is not None:
            self.line.take_torque(torque, self.now)
        return self._watch(torque)

    def _watch(self, _):
        """Let the watchdog look at the state; return the torque that acts."""
        if self.line is None:
            return self._applied
        state = self.state()
        values = np.concatenate((state.q, state.dq, state.effort))
        self.line.take_state(stamp_of(state), values, self.now)
        period = self.T if self.line.active else PERIOD
        if self.plant.sample % max(1, round(period / self.T)) == 0:
            torque = self.line.poll(self.now)
            if torque is not None:
                self._applied = torque.copy()
                self.taken.append(self._applied)
        return self._applied

    def hang(self, seconds, *, queued=False):
        """Hang; the state of the middle may still be in the queue, and is answered first."""
        self.run(0.5 * seconds, hangs=True)
        waiting = self.state()
        self.run(0.5 * seconds, hangs=True)
        if queued:
            self.answer(waiting)
