# SPDX-License-Identifier: Apache-2.0
"""OpenArm with motors that close a PD of their own, in lock-step."""

from __future__ import annotations

import numpy as np

from blf_dsc_controller import load_loop
from blf_dsc_controller.drive.driver import Driver, Facts, RobotState
from blf_dsc_controller.motors.field import Field
from blf_dsc_controller.motors.frame import Ranges, torque_alone
from sim_plant.motors import MotorPlant

# of DM8009, DM4340 and DM4310, as damiao-motor 1.0.6 has them
VELOCITY = np.array([45.0, 45.0, 10.0, 10.0, 30.0, 30.0, 30.0])
TORQUE = np.array([54.0, 54.0, 28.0, 28.0, 10.0, 10.0, 10.0])
RANGES = Ranges(
    Field(-12.5, 12.5, 16),
    Field(-VELOCITY, VELOCITY, 12),
    Field(0.0, 500.0, 12),
    Field(0.0, 5.0, 12),
    Field(-TORQUE, TORQUE, 12),
)
# feedback through the inertia matrix, which only rigid gears bear
WHOLE = {
    'feedback.inertia': 'whole',
    'feedback.joint_stiffness': None,
    'feedback.joint_damping': None,
    'barrier.bound': [0.01] * 7,
}
RIGID = {'joint.stiffness': None, 'joint.backlash': None, 'sensor.side': 'link'}
# LeRobot's for OpenArm (config_openarm_follower.py, 27de2ca)
LEROBOT = {
    'feedback.joint_stiffness': [240.0, 240.0, 240.0, 240.0, 24.0, 31.0, 25.0],
    'feedback.joint_damping': [5.0, 5.0, 3.0, 5.0, 0.3, 0.3, 0.3],
}
# planetary gears, of which nothing is published: soft enough for 0.2 to 0.7 mrad/(N m)
ELASTIC = {
    'joint.stiffness': [4000.0, 4000.0, 2000.0, 2000.0, 800.0, 800.0, 800.0],
    'joint.backlash': None,
    'sensor.side': 'motor',
}


def loop_of(period, law=None, plant=None):
    """Configurations of both at a sample time [s], with 14 bits of the motors' encoders.

    Without others, gears are rigid, and the feedback acts through the inertia matrix.
    """
    given = {'sample_time': period}
    encoders = {'sensor.resolution': 4.3e-5}
    return load_loop(
        'openarm',
        {
            'blf_dsc_controller': given | (law or WHOLE),
            'sim_plant': given | encoders | RIGID | (plant or {}),
        },
    )


class MotorDriver(Driver):
    """A driver on such a plant, which tests give it; it keeps what it was sent."""

    facts = Facts(7, 0.004, 'none', 'whole', (1e3,) * 7, (1e6,) * 7)
    has_feedback = True
    latency = 0.004
    ranges = RANGES
    plant: MotorPlant

    def connect(self):
        self.sent = []
        return ()

    def positions(self):
        return self.plant.measure()[0]

    def start(self):
        pass

    def read(self):
        q, dq, effort = self.plant.measure()
        return RobotState(1.0 + self.plant.frames * 0.004, q, dq, effort)

    def write(self, torque):
        self.write_frame(torque_alone(torque))

    def write_frame(self, frame):
        self.sent.append((frame, *self.plant.measure()[:2]))
        self.plant.step(frame)

    def finish(self):
        pass

    def recover(self):
        pass
