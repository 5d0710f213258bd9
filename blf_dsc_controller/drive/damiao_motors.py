# SPDX-License-Identifier: Apache-2.0
"""Damiao motors on a CAN bus: what they are sent and asked, and what they answer."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from time import monotonic

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.drive import DriveConfig
from blf_dsc_controller.configuration.motor_options import mounting_of
from blf_dsc_controller.drive.can_bus import CanBus
from blf_dsc_controller.drive.driver import DriverError
from blf_dsc_controller.motors import damiao
from blf_dsc_controller.motors.damiao import Register, Status
from blf_dsc_controller.motors.frame import Frame, Ranges

Vector = NDArray[np.float64]
_SECOND = 0.02  # s, in which a second motor with the same identifier answers, too
_TRIES = 3


class DamiaoMotors:
    """The motors of the n joints of an arm.

    Attributes:
        ranges: what frames to them carry, as values of the joints.
        state: q, dq, torque (3, n) [rad, rad/s, N m] of the joints, as they sent it last.
        patience: how long a motor at rest may take to answer [s]; a busy computer may
            take long to hear it.
    """

    patience = 2.0
    ranges: Ranges
    _at_motors: Ranges

    def __init__(
        self, address: str, joints: Sequence[str], config: DriveConfig
    ) -> None:
        """Note which motor is whose.

        Raises:
            BlfDscError: there is not one, a direction and an offset for each joint.
        """
        n = len(joints)
        self._mounting = mounting_of(config, n)
        self._address = address
        self._joints = joints
        self._ids, answers = config.identifiers(n)
        if not len(self._ids) == len(answers) == n:
            raise DriverError(
                f'drive.motor_ids, drive.feedback_ids: got {len(self._ids)} and {len(answers)}, '
                f'but the arm has {n} joints: give one for each'
            )
        self._joint_of = {each: i for i, each in enumerate(answers)}
        self._fd = config.can_fd
        self._open: CanBus | None = None
        self.state = np.zeros((3, n))
        self._codes = np.zeros((3, n), int)
        self._status = np.zeros(n, int)
        self._temperatures = np.zeros((n, 2), int)  # deg C

    @property
    def _bus(self) -> CanBus:
        if self._open is None:
            raise DriverError(f'{self._address}: not connected yet: call connect')
        return self._open

    def connect(self) -> None:
        """Reach the motors, check their modes, and read their ranges.

        Raises:
            DriverError: the bus cannot be opened, or a motor does not answer, is in another
                mode or in error, or is there twice.
        """
        self.close()  # what was lost: some adapters are open once at a time
        self._open = CanBus(self._address, (*self._ids, damiao.TO_ALL), fd=self._fd)
        for joint, mode in enumerate(self.registers(Register.MODE)):
            if mode != damiao.MIT:
                raise DriverError(
                    f'{self.name(joint)} is in mode {mode:.0f}, but frames need mode '
                    f'{damiao.MIT} (MIT): write {damiao.MIT} to its register {Register.MODE:d}'
                )
        limits = (Register.POSITION, Register.VELOCITY, Register.TORQUE)
        table = zip(*map(self.registers, limits), strict=True)
        self._at_motors = damiao.ranges_of([damiao.Limits(*row) for row in table])
        self.ranges = self._mounting.ranges_at_joints(self._at_motors)
        self.refresh()
        for joint, _ in self._answers(_SECOND):
            raise DriverError(
                f'{self.name(joint)} answers twice: two motors on {self._address} have its '
                'identifier, or the arm of another bus is on this one: give each its own'
            )
        self.refuse_errors()

    def close(self) -> None:
        """Leave the bus."""
        if self._open is not None:
            self._open.close()
            self._open = None

    def name(self, joint: int) -> str:
        """Return a motor and its joint in words."""
        return f'motor 0x{self._ids[joint]:02x} of {self._joints[joint]}'

    def clear(self) -> None:
        """Drop answers that wait: they are too late."""
        self._bus.clear()

    def send(self, frame: Frame) -> None:
        """Send each its frame."""
        sent = self._mounting.frame_at_motors(frame)
        commands = damiao.command_data(sent, self._at_motors)
        for each, data in zip(self._ids, commands, strict=True):
            self._bus.send(each, data)

    def enable(self) -> None:
        """Enable the motors that are not.

        Raises:
            DriverError: one does not become enabled.
        """
        self.refresh()
        for _ in range(_TRIES):
            asleep = np.flatnonzero(self._status != Status.ENABLED).tolist()
            if not asleep:
                return
            for joint in asleep:
                self._bus.send(self._ids[joint], damiao.ENABLE)
            self.refresh()
            self.refuse_errors()
        if np.any(self._status != Status.ENABLED):
            names = ', '.join(map(self.name, asleep))
            raise DriverError(
                f'{names}: not enabled after {_TRIES} commands to do so: check the power of the '
                'motors, and whether a button keeps them off'
            )

    def disable(self) -> None:
        """Disable all: an arm without brakes falls."""
        for each in self._ids:
            self._bus.send(each, damiao.DISABLE)

    def clear_errors(self) -> None:
        """Clear what has stopped a motor.

        Raises:
            DriverError: it does not go away.
        """
        for each in self._ids:
            self._bus.send(each, damiao.CLEAR)
        self.refresh()
        self.refuse_errors()

    def refuse_errors(self) -> None:
        """Raise DriverError if a motor is in error, and not just disabled."""
        for joint, status in enumerate(self._status):
            if status not in (Status.ENABLED, Status.DISABLED):
                raise DriverError(self._trouble(joint))

    @property
    def stopped(self) -> str:
        """Which motor has stopped, and why; empty while all are enabled."""
        stopped = np.flatnonzero(self._status != Status.ENABLED)
        return self._trouble(int(stopped[0])) if stopped.size else ''

    def _trouble(self, joint: int) -> str:
        status = int(self._status[joint])
        known = status in {each.value for each in Status}
        why = damiao.REMEDIES.get(Status(status)) if known else None
        board, winding = self._temperatures[joint]
        return (
            f'{self.name(joint)} has stopped: {why or f"error 0x{status:x}"} '
            f'(board {board} deg C, winding {winding} deg C)'
        )

    def ask(self) -> None:
        """Ask all for their states."""
        for each in self._ids:
            data = damiao.request_data(each, damiao.REFRESH)
            self._bus.send(damiao.TO_ALL, data)

    def refresh(self) -> None:
        """Ask all for their states, and wait for them.

        Raises:
            DriverError: one does not answer.
        """
        self._bus.clear()
        self.ask()
        self._insist(self.collect(self.patience))

    def collect(self, timeout: float) -> list[int]:
        """Take a state of each; return the joints of those that sent none in time [s]."""
        missing = set(range(len(self._ids)))
        for joint, data in self._answers(timeout):
            state = damiao.state_of(data)
            self._codes[:, joint] = state.position, state.velocity, state.torque
            self._status[joint] = state.status
            self._temperatures[joint] = state.board, state.winding
            missing.discard(joint)
            if not missing:
                break
        known = [joint for joint in range(len(self._ids)) if joint not in missing]
        ranges = self._at_motors
        fields = ranges.position, ranges.velocity, ranges.torque
        states = [
            field.values(codes)
            for field, codes in zip(fields, self._codes, strict=True)
        ]
        self.state[:, known] = self._mounting.states_at_joints(np.array(states))[
            :, known
        ]
        return sorted(missing)

    def registers(self, register: Register) -> list[float]:
        """Return a register of each.

        Raises:
            DriverError: one does not answer.
        """
        for each in self._ids:
            data = damiao.request_data(each, damiao.READ, register)
            self._bus.send(damiao.TO_ALL, data)
        found: dict[int, float] = {}
        for joint, data in self._answers(self.patience):
            value = damiao.reading_of(data, self._ids[joint], register)
            if value is not None:
                found[joint] = value
            if len(found) == len(self._ids):
                break
        self._insist([i for i in range(len(self._ids)) if i not in found])
        return [found[joint] for joint in sorted(found)]

    def _answers(self, timeout: float) -> Iterator[tuple[int, bytes]]:
        """Yield joints and what their motors send, for so long [s]."""
        end = monotonic() + timeout
        while (answer := self._bus.receive(max(end - monotonic(), 0.0))) is not None:
            identifier, data = answer
            if identifier in self._joint_of and len(data) == damiao.LENGTH:
                yield self._joint_of[identifier], data

    def _insist(self, missing: Sequence[int]) -> None:
        if missing:
            names = ', '.join(map(self.name, missing))
            raise DriverError(
                f'{names}: no answer on {self._address}: check power, cable, bit rate and '
                'identifiers (drive.motor_ids, drive.feedback_ids)'
            )
