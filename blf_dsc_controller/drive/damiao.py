# SPDX-License-Identifier: Apache-2.0
"""An arm with Damiao motors on a CAN bus (OpenArm and others), by python-can.

Each period, all motors get a frame and answer with their states, which the next frames
follow: a torque acts a period after its state.  Ranges are read from the motors.

Motors keep the last frame.  Such arms have no brakes, and fall if they are disabled.  So the
last frame, at the end or after another motor has failed, holds the arm where it is, with the
torque that it had.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from math import inf
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.drive import DriveConfig
from blf_dsc_controller.drive.damiao_motors import DamiaoMotors
from blf_dsc_controller.drive.driver import (
    ConnectionLostError,
    Driver,
    DriverError,
    Facts,
    ReflexError,
    RobotState,
)
from blf_dsc_controller.drive.ticks import Ticks
from blf_dsc_controller.motors.damiao import Register
from blf_dsc_controller.motors.frame import Frame, Ranges, torque_alone

Vector = NDArray[np.float64]
_SHARE = 0.8  # of a period, for motors to answer a frame
_MOST_LOST = 10  # answers of a motor in a row
_HOLD = 10.0  # 1/s, stiffness over damping of what holds the arm: slow, so it swings nowhere
_UNIT = 0.05  # ms, of time-outs


class DamiaoDriver(Driver):
    """An arm whose motors are Damiao's."""

    has_feedback: ClassVar[bool] = True

    @classmethod
    def facts_for(cls, controller: ControllerConfig) -> Facts:
        """Return the facts; the limits of the motors are known once they have answered."""
        n = len(controller.joints)
        return Facts(
            joints=n,
            period=controller.sample_time,
            drive_compensates='none',
            effort='whole',
            torque_limit=(inf,) * n,
            torque_rate=(inf,) * n,
        )

    def __init__(
        self, address: str, controller: ControllerConfig, config: DriveConfig
    ) -> None:
        super().__init__(address, controller, config)
        n = len(controller.joints)
        self.latency = controller.sample_time
        self._motors = DamiaoMotors(address, controller.joints, config)
        self._ticks = self.make_ticks()
        self._missed = np.zeros(n, int)  # answers in a row
        self._stamp = 0.0
        self._torque = np.zeros(n)

    def make_ticks(self) -> Ticks:
        """Return the clock of the loop."""
        return Ticks(self.controller.sample_time)

    def connect(self) -> Sequence[str]:
        """Reach the motors, and read their ranges.

        Raises:
            DriverError: one does not answer, is in another mode or in error, or its frames
                hold less than `torque.limit`.
        """
        motors = self._motors
        motors.connect()
        held = np.asarray(motors.ranges.torque.most, np.float64)
        for joint, most in enumerate(self.controller.torque.limit):
            holds = float(held[joint])
            if most > holds:
                raise DriverError(
                    f'torque.limit: got {most:g} N m for {motors.name(joint)}, whose frames hold '
                    f'{holds:g} N m: stay below'
                )
        n = len(self.controller.joints)
        return [f'{n} motors answer on {self.address}', *self._remarks()]

    def _remarks(self) -> Iterator[str]:
        """Yield what happens if frames stay away."""
        for joint, timeout in enumerate(self._motors.registers(Register.TIMEOUT)):
            if timeout:
                yield (
                    f'note: {self._motors.name(joint)} stops holding {timeout * _UNIT:g} ms after '
                    'the last frame (register 9), also after the end'
                )

    @property
    def ranges(self) -> Ranges:
        """What a frame to the motors can carry, as they say."""
        return self._motors.ranges

    def positions(self) -> Vector:
        """Return the joint positions (n,) [rad] now."""
        self._motors.refresh()
        return np.array(self._motors.state[0])

    def start(self) -> None:
        """Enable the motors that are not: their torque is zero until the first frame.

        Raises:
            DriverError: one does not become enabled.
        """
        self._motors.enable()
        self._missed[:] = 0
        self._stamp = self._ticks.begin()
        self._motors.ask()

    def read(self) -> RobotState:
        """Return the state with which the motors answered the last frame, or `start`.

        A motor whose answer is lost is taken to have moved on at its velocity.
        """
        motors = self._motors
        with self._holding_if_lost():
            missing = motors.collect(self._ticks.left(_SHARE))
        if stopped := motors.stopped:
            self._hold()
            raise ReflexError(f'{stopped}; the others hold the arm')
        motors.state[0, missing] += self._ticks.period * motors.state[1, missing]
        is_missing = np.isin(np.arange(self._missed.size), missing)
        self._missed = np.where(is_missing, self._missed + 1, 0)
        if self._missed.max() > _MOST_LOST:
            joint = int(self._missed.argmax())
            self._hold()
            raise ConnectionLostError(
                f'{motors.name(joint)} has not answered {self._missed[joint]} frames: check its '
                'power and cable; the others hold the arm'
            )
        return RobotState(self._stamp, *motors.state.copy())

    def write(self, torque: Vector | None) -> None:
        """Command torques (n,) [N m]; None: let the motors go on as they are."""
        if torque is not None:
            self.write_frame(torque_alone(torque))
            return
        self._await_tick()
        self._motors.ask()

    def write_frame(self, frame: Frame) -> None:
        """Send a frame to each motor, at the next tick."""
        self._torque = frame.torque_at(*self._motors.state[:2])
        self._await_tick()
        self._motors.send(frame)

    def _await_tick(self) -> None:
        """Wait for the next tick; answers that have not been taken by then are too late."""
        self._stamp = self._ticks.wait()
        with self._holding_if_lost():
            self._motors.clear()

    def finish(self) -> None:
        """Let the motors hold the arm where it is, or disable them: `drive.at_end`."""
        if self.config.at_end == 'hold':
            self._hold()
        else:
            self._motors.disable()

    @contextmanager
    def _holding_if_lost(self) -> Iterator[None]:
        """Hold the arm by the motors that can still be reached, if the bus reports an error."""
        try:
            yield
        except ConnectionLostError:
            with suppress(ConnectionLostError):
                self._hold()
            raise

    def _hold(self) -> None:
        """Send frames that hold the arm where it is, with the torque that it had."""
        q, dq, _ = self._motors.state
        damping = np.array(self.controller.safety.damping)
        self._motors.send(Frame(q, 0.0 * dq, _HOLD * damping, damping, self._torque))

    def recover(self) -> None:
        """Clear the errors of the motors.

        Raises:
            DriverError: one does not go away.
        """
        self._motors.clear_errors()

    def close(self) -> None:
        """Leave the bus."""
        self._motors.close()
