# SPDX-License-Identifier: Apache-2.0
"""An arm with Damiao motors on a CAN bus (OpenArm, YAM and others), by python-can.

Each period, all motors get a frame and answer with their states, which the next frames
follow: a torque acts a period after its state.  Ranges are read from the motors.

Motors keep the last frame.  At the end, and for the others where one has failed, that is
a frame that holds the arm where it is, with the torque that it had: such arms have no
brakes, and one that is disabled falls.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import inf
from time import monotonic
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.drive import DriveConfig
from blf_dsc_controller.drive.can_bus import CanBus
from blf_dsc_controller.drive.driver import (
    ConnectionLostError,
    Driver,
    DriverError,
    Facts,
    ReflexError,
    RobotState,
)
from blf_dsc_controller.drive.ticks import Ticks
from blf_dsc_controller.motors import damiao
from blf_dsc_controller.motors.damiao import Register, Status
from blf_dsc_controller.motors.frame import Frame, Ranges, torque_alone

Vector = NDArray[np.float64]
_ANSWER = 0.5  # s, for a motor at rest to answer
_SHARE = 0.8  # of a period, for motors to answer a frame
_TRIES = 3
_MOST_LOST = 10  # states of a motor in a row
_HOLD = 10.0  # 1/s, stiffness over damping of what holds the arm: slow, so it swings nowhere


class DamiaoDriver(Driver):
    """An arm whose motors are Damiao's.

    Attributes:
        lost: states that did not arrive in time, of all motors.
    """

    has_feedback: ClassVar[bool] = True

    @classmethod
    def facts_for(cls, controller: ControllerConfig) -> Facts:
        """Return the facts: what the motors bear is known once they have answered."""
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
        self._n = n
        self.latency = controller.sample_time
        self.lost = 0
        self._ids = config.motor_ids or tuple(range(1, n + 1))
        self._feedback = config.feedback_ids or tuple(
            each + damiao.ANSWERS for each in self._ids
        )
        if not len(self._ids) == len(self._feedback) == n:
            raise DriverError(
                f'drive.motor_ids, drive.feedback_ids: got {len(self._ids)} and '
                f'{len(self._feedback)}, but the arm has {n} joints: give one for each'
            )
        self._joint_of = {each: i for i, each in enumerate(self._feedback)}
        self._ticks = self.make_ticks()
        self._open: CanBus | None = None
        self._codes = np.zeros((3, n), int)
        self._state = np.zeros((3, n))  # q, dq, torque
        self._status = np.zeros(n, int)
        self._temperatures = np.zeros((n, 2), int)  # deg C
        self._missed = np.zeros(n, int)  # states in a row
        self._stamp = 0.0
        self._torque = np.zeros(n)

    def make_ticks(self) -> Ticks:
        """Return the clock of the loop."""
        return Ticks(self.controller.sample_time)

    def connect(self) -> Sequence[str]:
        """Reach the motors, check their modes, and read their ranges.

        Raises:
            DriverError: the bus cannot be opened, or a motor does not answer, is in another
                mode, or bears less than `torque.limit`.
        """
        commands = (*self._ids, damiao.TO_ALL)
        self._open = CanBus(self.address, commands, fd=self.config.can_fd)
        self._bus.clear()
        mode = self._registers(Register.MODE)
        for joint, each in enumerate(mode):
            if each != damiao.MIT:
                raise DriverError(
                    f'{self._name(joint)} is in mode {each:.0f}, but frames need mode '
                    f'{damiao.MIT} (MIT): write {damiao.MIT} to its register {Register.MODE:d}'
                )
        limits = (Register.POSITION, Register.VELOCITY, Register.TORQUE)
        table = np.array([self._registers(each) for each in limits]).T
        self._ranges = damiao.ranges_of([damiao.Limits(*row) for row in table])
        for joint, most in enumerate(self.controller.torque.limit):
            if most > table[joint, 2]:
                raise DriverError(
                    f'torque.limit: got {most:g} N m for {self._name(joint)}, whose frames hold '
                    f'{table[joint, 2]:g} N m: stay below'
                )
        self._refresh()
        self._refuse_errors()
        return [f'{self._n} motors answer on {self.address}', *self._remarks()]

    def _remarks(self) -> Iterator[str]:
        """Yield what happens if frames stay away."""
        timeouts = self._registers(Register.TIMEOUT)
        for joint, timeout in enumerate(timeouts):
            if timeout:
                yield (
                    f'note: {self._name(joint)} stops holding {timeout * 0.05:g} ms after the '
                    'last frame (register 9), also after the end'
                )

    @property
    def _bus(self) -> CanBus:
        if self._open is None:
            raise DriverError(f'{self.address}: not connected yet: call connect')
        return self._open

    @property
    def ranges(self) -> Ranges:
        """What a frame to the motors can carry, as they say."""
        return self._ranges

    def positions(self) -> Vector:
        """Return the joint positions (n,) [rad] now."""
        self._refresh()
        return np.array(self._state[0])

    def start(self) -> None:
        """Enable the motors that are not: their torque is zero until the first frame.

        Raises:
            DriverError: one does not become enabled.
        """
        self._refresh()
        for _ in range(_TRIES):
            asleep = np.flatnonzero(self._status != Status.ENABLED).tolist()
            if not asleep:
                break
            for joint in asleep:
                self._bus.send(self._ids[joint], damiao.ENABLE)
            self._refresh()
            self._refuse_errors()
        else:
            names = ', '.join(map(self._name, asleep))
            raise DriverError(
                f'{names}: not enabled after {_TRIES} commands to do so: check the power of the '
                'motors, and whether a button keeps them off'
            )
        self._missed[:] = 0
        self._stamp = self._ticks.begin()

    def read(self) -> RobotState:
        """Return the state with which the motors answered the last frame.

        A motor whose answer is lost is taken to have moved on at its velocity.
        """
        missing = self._collect(self._ticks.left(_SHARE))
        self._check()
        for joint in missing:
            self._state[0, joint] += self._ticks.period * self._state[1, joint]
        self._missed[missing] += 1
        self._missed[[i for i in range(self._n) if i not in missing]] = 0
        self.lost += len(missing)
        if self._missed.max() > _MOST_LOST:
            joint = int(self._missed.argmax())
            self._hold()
            raise ConnectionLostError(
                f'{self._name(joint)} has not answered {self._missed[joint]} frames: check its '
                'power and cable; the others hold the arm'
            )
        return RobotState(self._stamp, *self._state.copy())

    def write(self, torque: Vector | None) -> None:
        """Command torques (n,) [N m]; None: let the motors go on as they are."""
        if torque is not None:
            self.write_frame(torque_alone(torque))
            return
        self._stamp = self._ticks.wait()
        self._request_states()

    def write_frame(self, frame: Frame) -> None:
        """Send a frame to each motor, at the next tick."""
        self._torque = frame.torque_at(*self._state[:2])
        self._stamp = self._ticks.wait()
        self._bus.clear()  # answers that came too late
        self._send(frame)

    def _send(self, frame: Frame) -> None:
        commands = damiao.command_data(frame, self._ranges)
        for each, data in zip(self._ids, commands, strict=True):
            self._bus.send(each, data)

    def finish(self) -> None:
        """Let the motors hold the arm where it is, or disable them: `drive.at_end`."""
        if self.config.at_end == 'hold':
            self._hold()
            return
        for each in self._ids:
            self._bus.send(each, damiao.DISABLE)

    def _hold(self) -> None:
        """Send frames that hold the arm where it is, with the torque that it had."""
        damping = np.array(self.controller.safety.damping)
        q, zeros = self._state[0], np.zeros(self._n)
        self._send(Frame(q, zeros, _HOLD * damping, damping, self._torque))

    def recover(self) -> None:
        """Clear the errors of the motors.

        Raises:
            DriverError: one does not go away.
        """
        for each in self._ids:
            self._bus.send(each, damiao.CLEAR)
        self._refresh()
        self._refuse_errors()

    def close(self) -> None:
        """Leave the bus."""
        if self._open is not None:
            self._open.close()

    def _check(self) -> None:
        """Let the others hold the arm if a motor has stopped, and raise ReflexError."""
        for joint, status in enumerate(self._status):
            if status != Status.ENABLED:
                self._hold()
                raise ReflexError(f'{self._trouble(joint)}; the others hold the arm')

    def _refuse_errors(self) -> None:
        """Raise DriverError if a motor is in error."""
        for joint, status in enumerate(self._status):
            if status not in (Status.ENABLED, Status.DISABLED):
                raise DriverError(self._trouble(joint))

    def _trouble(self, joint: int) -> str:
        status = int(self._status[joint])
        known = status in {each.value for each in Status}
        why = damiao.REMEDIES.get(Status(status)) if known else None
        board, winding = self._temperatures[joint]
        return (
            f'{self._name(joint)} has stopped: {why or f"error 0x{status:x}"} '
            f'(board {board} deg C, winding {winding} deg C)'
        )

    def _name(self, joint: int) -> str:
        return f'motor 0x{self._ids[joint]:02x} of {self.controller.joints[joint]}'

    def _refresh(self) -> None:
        """Ask all motors for their states, and wait for them."""
        self._bus.clear()
        self._request_states()
        self._insist(self._collect(_ANSWER))

    def _request_states(self) -> None:
        for each in self._ids:
            data = damiao.request_data(each, damiao.REFRESH)
            self._bus.send(damiao.TO_ALL, data)

    def _insist(self, missing: Sequence[int]) -> None:
        """Raise DriverError if motors do not answer."""
        if missing:
            names = ', '.join(self._name(joint) for joint in missing)
            raise DriverError(
                f'{names}: no answer on {self.address}: check power, cable, bit rate and '
                'identifiers (drive.motor_ids, drive.feedback_ids)'
            )

    def _answers(self, timeout: float) -> Iterator[tuple[int, bytes]]:
        """Yield joints and what their motors send, for so long [s]."""
        end = monotonic() + timeout
        while (answer := self._bus.receive(max(end - monotonic(), 0.0))) is not None:
            identifier, data = answer
            if identifier in self._joint_of and len(data) == damiao.LENGTH:
                yield self._joint_of[identifier], data

    def _collect(self, timeout: float) -> list[int]:
        """Take a state of each motor; return the joints of those that sent none in time."""
        missing = set(range(self._n))
        for joint, data in self._answers(timeout):
            state = damiao.state_of(data)
            self._codes[:, joint] = state.position, state.velocity, state.torque
            self._status[joint] = state.status
            self._temperatures[joint] = state.board, state.winding
            missing.discard(joint)
            if not missing:
                break
        ranges = self._ranges
        fields = ranges.position, ranges.velocity, ranges.torque
        for k, field in enumerate(fields):
            fresh = field.values(self._codes[k])
            for joint in set(range(self._n)) - missing:
                self._state[k, joint] = fresh[joint]
        return sorted(missing)

    def _registers(self, register: Register) -> list[float]:
        """Return a register of each motor."""
        found: dict[int, float] = {}
        for each in self._ids:
            data = damiao.request_data(each, damiao.READ, register)
            self._bus.send(damiao.TO_ALL, data)
        for joint, data in self._answers(_ANSWER):
            value = damiao.reading_of(data, self._ids[joint], register)
            if value is not None:
                found[joint] = value
            if len(found) == self._n:
                break
        self._insist([i for i in range(self._n) if i not in found])
        return [found[joint] for joint in range(self._n)]
