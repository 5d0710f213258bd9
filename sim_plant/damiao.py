# SPDX-License-Identifier: Apache-2.0
"""Simulated Damiao motors on a CAN bus of python-can: an arm for `blf_dsc drive`.

    python -m sim_plant.damiao --config openarm --bus udp_multicast:239.74.163.2

runs the simulated arm of a parameter file in real time, on a bus that reaches other
processes of this computer.  Motors answer each command with their state, and keep the
last frame while none comes.  As long as no motor is enabled, a stand holds the arm.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from contextlib import suppress

import can
import numpy as np

from blf_dsc_controller.configuration.drive import DriveConfig
from blf_dsc_controller.configuration.motor_options import limits_of, mounting_of
from blf_dsc_controller.configuration.nodes import DRIVE, PLANT, load, load_loop, locate
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.motors import damiao
from blf_dsc_controller.motors.damiao import Limits, Register, StateCodes, Status
from blf_dsc_controller.motors.frame import Frame
from blf_dsc_controller.motors.mounting import Mounting
from sim_plant.motors import IN_REAL_TIME, MotorPlant

_AT_ONCE = 0.002  # s, in which no frame is answered
_LATEST = 0.2  # s behind the clock, at most
_COLD = 30  # deg C


class DamiaoArm:
    """The motors of an arm, on a bus.

    Attributes:
        arm: the arm.
        status: what each motor says of itself.
        modes: mode of each motor.
        timeouts: time-out of each motor [50 us], which it tells and does not keep.
        mute: joints whose motors do not answer.
    """

    def __init__(
        self,
        bus: can.BusABC,
        config: PlantConfig,
        limits: Sequence[Limits],
        rate: float = IN_REAL_TIME,
        mounting: Mounting | None = None,
    ) -> None:
        """Put the motors of a configured arm on a bus, disabled, as 1, 2, ..."""
        n = len(limits)
        self._bus = bus
        self._limits = limits
        self._ranges = damiao.ranges_of(limits)
        self._mounting = mounting or Mounting(np.ones(n), np.zeros(n))
        at_joints = self._mounting.ranges_at_joints(self._ranges)
        self.arm = MotorPlant(config, at_joints, rate)
        self._n = n
        self.status = [Status.DISABLED] * n
        self.modes = [damiao.MIT] * n
        self.timeouts = [0] * n
        self.mute: set[int] = set()
        self._codes = np.zeros((5, n), int)
        self.forget()

    def forget(self) -> None:
        """Forget all frames: no gains, no torque."""
        for joint in range(self._n):
            self._forget(joint)

    def _forget(self, joint: int) -> None:
        nothing = [field.codes(np.zeros(self._n)) for field in self._ranges]
        self._codes[:, joint] = np.array(nothing)[:, joint]

    @property
    def frame(self) -> Frame:
        """What the joints have been sent last; motors that are not enabled do nothing."""
        values = [
            field.values(codes)
            for field, codes in zip(self._ranges, self._codes, strict=True)
        ]
        enabled = np.array([each == Status.ENABLED for each in self.status])
        frame = self._mounting.frame_at_joints(Frame(*values))
        return frame._replace(
            stiffness=frame.stiffness * enabled,
            damping=frame.damping * enabled,
            torque=frame.torque * enabled,
        )

    def serve(self, timeout: float) -> bool:
        """Take a frame from the bus, if one comes in time [s], and answer it."""
        message = self._bus.recv(timeout)
        if message is None:
            return False
        data = bytes(message.data)
        if len(data) != damiao.LENGTH:
            return True
        if message.arbitration_id == damiao.TO_ALL:
            self._answer_request(data)
        elif 1 <= message.arbitration_id <= self._n:
            self._take(message.arbitration_id - 1, data)
        return True

    def serve_in_real_time(self) -> None:
        """Serve for ever; time goes on with the clock."""
        period = self.arm.plant.period_ns * 1e-9
        done = time.monotonic()
        while True:
            waited = period
            while self.serve(waited):  # all that is there
                waited = 0.0
            late = time.monotonic() - done
            if late > _LATEST:  # this computer is too slow: time stands still
                done += late - _LATEST
            samples = math.floor(min(late, _AT_ONCE) / period)
            self._advance(samples)
            done += samples * period

    def _advance(self, samples: int) -> None:
        """Move on, unless a stand holds the arm because no motor is enabled."""
        if any(each != Status.DISABLED for each in self.status):
            self.arm.advance(self.frame, samples)

    def _take(self, joint: int, data: bytes) -> None:
        """Obey a command, and answer with the state."""
        fails = self.status[joint] not in (Status.ENABLED, Status.DISABLED)
        if data == damiao.ENABLE and not fails:
            self.status[joint] = Status.ENABLED
        elif data == damiao.DISABLE or (data == damiao.CLEAR and fails):
            self.status[joint] = Status.DISABLED
            self._forget(joint)
        elif data not in (damiao.ENABLE, damiao.CLEAR):
            self._obey(joint, data)
        self._send_state(joint)

    def _obey(self, joint: int, data: bytes) -> None:
        """Take what a frame commands, in the mode for it."""
        if self.modes[joint] == damiao.MIT:
            self._codes[:, joint] = damiao.codes_of_command(data)

    def _answer_request(self, data: bytes) -> None:
        identifier, request = int.from_bytes(data[:2], 'little'), data[2]
        joint = identifier - 1
        if not 0 <= joint < self._n:
            return
        if request == damiao.REFRESH:
            self._send_state(joint)
        elif request == damiao.READ and data[3] in set(Register):
            register = Register(data[3])
            value = {
                Register.TIMEOUT: self.timeouts[joint],
                Register.MODE: self.modes[joint],
                Register.POSITION: self._limits[joint].position,
                Register.VELOCITY: self._limits[joint].velocity,
                Register.TORQUE: self._limits[joint].torque,
            }[register]
            self._send(joint, damiao.reading_data(identifier, register, value))

    def _send_state(self, joint: int) -> None:
        ranges = self._ranges
        fields = ranges.position, ranges.velocity, ranges.torque
        states = self._mounting.states_at_motors(self.arm.measure())
        q, dq, torque = (
            int(field.codes(values)[joint])
            for field, values in zip(fields, states, strict=True)
        )
        state = StateCodes(joint + 1, self.status[joint], q, dq, torque, _COLD, _COLD)
        self._send(joint, damiao.state_data(state))

    def _send(self, joint: int, data: bytes) -> None:
        if joint not in self.mute:
            answer = joint + 1 + damiao.ANSWERS
            self._bus.send(
                can.Message(arbitration_id=answer, data=data, is_extended_id=False)
            )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run motors in real time, until Ctrl-C."""
    parser = argparse.ArgumentParser(prog='sim_plant.damiao', description=__doc__)
    parser.add_argument('--config', default='openarm', help='parameter file or preset')
    parser.add_argument('--bus', default='udp_multicast:239.74.163.2')
    options = parser.parse_args(arguments)
    interface, _, channel = options.bus.partition(':')
    with can.Bus(interface=interface, channel=channel) as bus:
        own = {'sensor.resolution': damiao.ENCODER}
        plant = load_loop(options.config, {PLANT: own}).plant
        config = load(locate(options.config), DRIVE, DriveConfig)
        n = len(plant.joints)
        limits = limits_of(config, n)
        motors = DamiaoArm(bus, plant, limits, mounting=mounting_of(config, n))
        motors.arm.plant.compile()
        text = f'{len(limits)} motors on {options.bus}: Ctrl-C ends'
        print(text, flush=True)  # noqa: T201 - a command
        with suppress(KeyboardInterrupt):
            motors.serve_in_real_time()
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
