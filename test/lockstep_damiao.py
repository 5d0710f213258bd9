# SPDX-License-Identifier: Apache-2.0
"""The driver of Damiao motors on simulated ones, on python-can's virtual bus, in lock-step.

They are those of an OpenArm with rigid gears, or of a YAM as its preset has it.
Time goes on with the frames: a test holds on any machine.  `arrange(motors)`, if set,
gets the motors before they are reached; `at` calls something with them at a state.
"""

from __future__ import annotations

import threading
from contextlib import suppress
from typing import ClassVar

import can
from motor_arm import RIGID

import blf_dsc_controller as blf
from blf_dsc_controller.configuration.drive import DriveConfig
from blf_dsc_controller.configuration.motor_options import limits_of, mounting_of
from blf_dsc_controller.configuration.nodes import load, locate
from blf_dsc_controller.drive.damiao import DamiaoDriver
from blf_dsc_controller.drive.ticks import Ticks
from sim_plant.damiao import DamiaoArm

PATIENCE = 20.0  # s, for an answer of a thread
_CLOSED = 0.05  # s, after which it is seen that the bus is closed
OPENARM = load(locate('openarm'), 'drive', DriveConfig)
LIMITS, MODELS = limits_of(OPENARM, 7), OPENARM.motor_models
YAM = 6  # joints


class LockstepArm(DamiaoArm):
    """Motors whose time goes on once all of them have got a frame."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self._commanded = set()

    def _obey(self, joint, data):
        super()._obey(joint, data)
        self._commanded.add(joint)

    def serve_in_lockstep(self):
        """Serve until the bus is closed."""
        with suppress(can.CanError):
            while True:
                self.serve(_CLOSED)
                if len(self._commanded) == self._n:
                    self._commanded.clear()
                    self._advance(self.arm.per_frame)


class LockstepTicks(Ticks):
    """Ticks that are there as soon as they are waited for."""

    answers = PATIENCE  # s; less where answers are lost on purpose

    def begin(self):
        self._next = 1.0
        return self._next

    def wait(self):
        self._next += self.period
        return self._next

    def left(self, _share):
        return self.answers


class LockstepDriver(DamiaoDriver):
    """A driver that brings its motors, once for each bus."""

    arrange = None
    patience = PATIENCE  # s, for motors at rest; less where answers are lost on purpose
    at: ClassVar = {}  # number of a state: what is done before it
    made = None  # the driver that was made last

    def make_ticks(self):
        return LockstepTicks(self.controller.sample_time)

    def connect(self):
        LockstepDriver.made = self
        self.states = 0
        channel = self.address.partition(':')[2]
        self.bus = can.Bus(interface='virtual', channel=channel)
        period = {'sample_time': self.controller.sample_time}
        n = len(self.controller.joints)
        name, gears = ('yam', {}) if n == YAM else ('openarm', RIGID)
        given = {'blf_dsc_controller': period, 'sim_plant': period | gears}
        plant = blf.load_loop(name, given).plant
        limits = limits_of(self.config, n) if n == YAM else LIMITS
        mounting = mounting_of(self.config, n)
        self.motors = LockstepArm(self.bus, plant, limits, 2000.0, mounting)
        if type(self).arrange is not None:
            type(self).arrange(self.motors)
        self.thread = threading.Thread(
            target=self.motors.serve_in_lockstep, daemon=True
        )
        self.thread.start()
        self._motors.patience = self.patience
        return super().connect()

    def read(self):
        self.states += 1
        if self.states in self.at:
            self.at[self.states](self)
        return super().read()

    def close(self):
        super().close()
        self.bus.shutdown()
        self.thread.join(PATIENCE)


DRIVER = LockstepDriver
