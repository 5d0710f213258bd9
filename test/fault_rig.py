# SPDX-License-Identifier: Apache-2.0
"""A closed loop for fault injection: arm, messages, guarded law, and clocks that the test sets.

Everything passes through the same decoders, supervisor and torque input as in the nodes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.messages.codecs import (
    Float64MultiArrayDecoder,
    Float64MultiArrayEncoder,
    JointStateDecoder,
    JointStateEncoder,
    MessageError,
)
from blf_dsc_controller.supervision.checks import PERIOD
from blf_dsc_controller.supervision.guard import Guard
from sim_plant.command_input import TorqueInput
from sim_plant.plant import plant_of

JOINTS = ('joint1', 'joint2')
MILLISECOND = 1_000_000  # ns
LOCKSTEP = 1_000_000_000  # ns
TODAY = 1_700_000_000_000_000_000  # ns
PLAIN = JointStateEncoder(JOINTS)


class State(NamedTuple):
    """One measured state, before it becomes a message."""

    stamp: int
    q: np.ndarray
    dq: np.ndarray
    effort: np.ndarray

    def raw(self, encoder=PLAIN, **changes):
        """Return the state, with changes, as a message."""
        changed = self._replace(**changes)
        return encoder.encode(changed.stamp, changed.q, changed.dq, changed.effort)


class Rig:
    """A loop with steps of 1 ms, stamped in lock-step time or, if `live`, in wall time."""

    def __init__(self, given=None, *, live=False, plant=None):
        self.config = build(ControllerConfig, given or {})
        self.live = live
        self.steady = self.next_watch = 5_000_000_000
        self.wall = TODAY
        self.base = TODAY if live else LOCKSTEP
        self.guard = self.controller()
        self.plant = plant_of(build(PlantConfig, plant or {}))
        self.input = TorqueInput(len(JOINTS))
        self.commands = []  # all torques commanded
        self.push = np.zeros(2)
        self.sense = lambda state: [state.raw()]  # messages sent for a state
        self.actuate = lambda raw: [raw]  # commands sent for a torque

    def controller(self):
        """Start a controller process: activated, with nothing learned."""
        self._decoder = JointStateDecoder(JOINTS, required=('position',))
        guard = Guard(self.config, lambda: self.steady, lambda: self.wall)
        guard.activate()
        return guard

    @property
    def supervisor(self):
        return self.guard.supervisor

    def state(self):
        """Return the current true state."""
        q, dq, effort = self.plant.measure().copy().reshape(3, 2)
        return State(self.base + self.plant.elapsed_ns, q, dq, effort)

    def deliver(self, raw):
        """Pass one message to the controller; return the torque it commands, or None."""
        try:
            stamp = self._decoder.decode(raw)
        except MessageError as error:
            torque = self.guard.reject(error)
        else:
            torque = self.guard.update(stamp, self._decoder.values)
        self._command(torque)
        return torque

    def _command(self, torque):
        if torque is None:
            return
        self.commands.append(torque.copy())
        for raw in self.actuate(Float64MultiArrayEncoder(2).encode(torque)):
            decoder = Float64MultiArrayDecoder(2)
            size = decoder.decode(raw)
            self.input.take(size, decoder.values, self.plant.sample)

    def step(self, count=1):
        """Advance by `count` milliseconds: measure, deliver, run the watchdog if due, move."""
        for _ in range(count):
            for raw in self.sense(self.state()):
                self.deliver(raw)
            self.wait()
            self.plant.step(self.input.torque + self.push)

    def wait(self, milliseconds=1):
        """Advance the clocks, and run the watchdog when it is due."""
        for _ in range(milliseconds):
            self.steady += MILLISECOND
            self.wall += MILLISECOND
            if self.steady >= self.next_watch:
                self._command(self.guard.watch())
                self.next_watch = self.steady + PERIOD * 1e9

    def clear_fault(self):
        """Remove the fault, and reset arm and controller as the nodes' services do."""
        self.sense = lambda state: [state.raw()]
        self.actuate = lambda raw: [raw]
        self.push = np.zeros(2)
        self.guard.retune(self.config)
        self.base = self.state().stamp + LOCKSTEP
        self.wall = max(self.wall, self.base) if self.live else self.wall
        self.plant.reset()
        self.input.torque[:] = 0.0
        self.guard.reset()
