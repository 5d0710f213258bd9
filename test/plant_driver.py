# SPDX-License-Identifier: Apache-2.0
"""A driver on the simulated arm in lock-step: a robot that answers, falls silent or has reflexes.

`address` says what happens: `plant`, or a word such as `silent@300` or `late@300` with
the number of the state at which it does.
"""

from __future__ import annotations

import os
import signal
from math import inf

import numpy as np

import blf_dsc_controller as blf
from blf_dsc_controller.drive.driver import (
    ConnectionLostError,
    Driver,
    DriverError,
    Facts,
    ReflexError,
    RobotState,
)
from sim_plant.plant import plant_of


class PlantDriver(Driver):
    facts = Facts(2, 0.001, 'none', 'unknown', (20.0, 20.0), (inf, inf))
    arm = 'recommended'  # parameter file or preset of the plant
    last = None  # the driver that was made last

    def connect(self):
        PlantDriver.last = self
        what, _, at = self.address.partition('@')
        self.what, self.at = what, int(at or -1)
        if what == 'absent':
            raise DriverError('there is no robot: switch it on')
        self.plant = plant_of(blf.load_loop(self.arm).plant)
        self.calls = ['connect']
        self.count = 0
        self.late = 0
        self.torques = []
        return ['connected to the simulated arm']

    def positions(self):
        return self.plant.measure().reshape(3, -1)[0]

    def start(self):
        self.calls.append('start')

    def read(self):
        self.count += 1
        if self.count == self.at:
            self.happen()
        if self.what == 'lossy' and self.count % 20 == 0:
            self.plant.step(self.torques[-1])
            self.late += 1
        q, dq, effort = self.plant.measure().reshape(3, -1)
        self.velocity = np.abs(dq).max()
        return RobotState(1.0 + 1e-3 * (self.count + self.late), q, dq, effort)

    def happen(self):
        match self.what:
            case 'silent':
                raise ConnectionLostError('no state for 1 s: check the cable')
            case 'reflex' | 'broken':
                raise ReflexError('joint_reflex')
            case 'late':
                self.late = 60
            case 'interrupt' | 'terminate':
                name = {'interrupt': signal.SIGINT, 'terminate': signal.SIGTERM}
                os.kill(os.getpid(), name[self.what])
            case 'impatient':
                os.kill(os.getpid(), signal.SIGINT)
                self.what, self.at = 'interrupt', self.count + 10
            case 'mistaken':
                raise RuntimeError('a mistake of the driver')

    def write(self, torque):
        self.torques.append(torque)
        self.plant.step(np.zeros(2) if torque is None else torque)

    def finish(self):
        self.calls.append('finish')

    def recover(self):
        self.calls.append('recover')
        if self.what == 'broken':
            raise DriverError('it cannot recover by itself: see Desk')


DRIVER = PlantDriver
