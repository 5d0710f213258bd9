# SPDX-License-Identifier: Apache-2.0
"""Frames of Damiao motors on a CAN bus, as eight bytes; nothing here opens a bus.

A motor listens to its own identifier, and answers with its feedback identifier:

    command      q_f 16 bits, dq_f 12, kp 12, kd 12, t 12
    state        status 4 and identifier 4, q 16, dq 12, torque 12, two temperatures [deg C]
    special      seven bytes 0xff and a word: enable, disable, clear an error
    registers    to 0x7ff: identifier 16, read or refresh 8, register 8, value 32

Ranges of position, velocity and torque are registers of each motor, those of kp and kd
the same in all.  Values are those of damiao-motor 1.0.6 (motor.py), with which this
agrees (`test/test_motors_damiao.py`); a value is rounded to the nearest code, where that
package takes the one below.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.motors.field import Field
from blf_dsc_controller.motors.frame import Frame, Ranges

ENABLE, DISABLE, CLEAR = (bytes([0xFF] * 7 + [word]) for word in (0xFC, 0xFD, 0xFB))
"""Special commands."""
TO_ALL = 0x7FF
"""Identifier of requests, which name the motor in their data."""
ANSWERS = 0x10
"""Feedback identifiers are so much above those of the motors, unless set otherwise."""
READ, REFRESH = 0x33, 0xCC
"""Requests: of a register, of the state."""
MIT = 1
"""Mode in which a motor takes frames."""
LENGTH = 8
_STIFFEST, _MOST_DAMPED = 500.0, 5.0  # N m/rad, N m s/rad


class Register(IntEnum):
    """Registers that matter here."""

    TIMEOUT = 9  # 50 us: without a frame for so long, the motor stops; 0: never
    MODE = 10
    POSITION = 21  # rad, largest
    VELOCITY = 22  # rad/s
    TORQUE = 23  # N m


_INTEGERS = (Register.TIMEOUT, Register.MODE)


class Status(IntEnum):
    """What a motor says of itself."""

    DISABLED = 0x0
    ENABLED = 0x1
    OVER_VOLTAGE = 0x8
    UNDER_VOLTAGE = 0x9
    OVER_CURRENT = 0xA
    HOT_BOARD = 0xB
    HOT_ROTOR = 0xC
    LOST_FRAMES = 0xD
    OVERLOAD = 0xE


REMEDIES = {
    Status.DISABLED: 'it is not enabled: another program has disabled it, or its power was off',
    Status.OVER_VOLTAGE: 'its voltage is too high: check the supply, and how it brakes',
    Status.UNDER_VOLTAGE: 'its voltage is too low: check the supply',
    Status.OVER_CURRENT: 'its current is too high: check its wires',
    Status.HOT_BOARD: 'its board is too hot: let it cool',
    Status.HOT_ROTOR: 'its winding is too hot: let it cool, and carry less',
    Status.LOST_FRAMES: 'it got no frames within its time-out (register 9): check the bus',
    Status.OVERLOAD: 'it is overloaded: carry less, and look for what blocks the arm',
}


class Limits(NamedTuple):
    """Largest values of a motor's frames, in both directions."""

    position: float = 12.5  # rad
    velocity: float = 30.0  # rad/s
    torque: float = 10.0  # N m


MODELS = {
    '4310': Limits(velocity=30.0, torque=10.0),
    '4340': Limits(velocity=10.0, torque=28.0),
    '6006': Limits(velocity=45.0, torque=20.0),
    '8006': Limits(velocity=45.0, torque=40.0),
    '8009': Limits(velocity=45.0, torque=54.0),
    '10010': Limits(velocity=20.0, torque=200.0),
}
"""As delivered, by model; the registers of a motor may have others."""
ENCODER = 4.3e-5
"""Resolution [rad] of a motor's own encoder at its joint: 14 bits, over a gear of 9."""


def ranges_of(motors: Sequence[Limits]) -> Ranges:
    """Return what frames to these motors can carry."""
    position, velocity, torque = np.array(motors, dtype=np.float64).reshape(-1, 3).T
    return Ranges(
        Field(-position, position, 16),
        Field(-velocity, velocity, 12),
        Field(0.0, _STIFFEST, 12),
        Field(0.0, _MOST_DAMPED, 12),
        Field(-torque, torque, 12),
    )


def command_data(frame: Frame, ranges: Ranges) -> list[bytes]:
    """Return the eight bytes of the command to each motor."""
    codes = np.stack(
        [field.codes(values) for field, values in zip(ranges, frame, strict=True)]
    )
    return [
        ((q << 48) | (dq << 36) | (kp << 24) | (kd << 12) | t).to_bytes(LENGTH, 'big')
        for q, dq, kp, kd, t in codes.T.tolist()
    ]


def codes_of_command(data: bytes) -> tuple[int, int, int, int, int]:
    """Return the codes of q_f, dq_f, kp, kd and t in a command."""
    word = int.from_bytes(data, 'big')
    twelve = (1 << 12) - 1
    return (
        word >> 48,
        word >> 36 & twelve,
        word >> 24 & twelve,
        word >> 12 & twelve,
        word & twelve,
    )


class StateCodes(NamedTuple):
    """What a motor reports: codes of `Ranges`, and temperatures [deg C]."""

    identifier: int  # its lowest four bits
    status: int
    position: int
    velocity: int
    torque: int
    board: int
    winding: int


def state_data(state: StateCodes) -> bytes:
    """Return the eight bytes of a state."""
    motion = state.position << 24 | state.velocity << 12 | state.torque
    head = state.status << 4 | state.identifier & 0xF
    return bytes([head, *motion.to_bytes(5, 'big'), state.board, state.winding])


def state_of(data: bytes) -> StateCodes:
    """Return the state in eight bytes."""
    motion = int.from_bytes(data[1:6], 'big')
    return StateCodes(
        identifier=data[0] & 0xF,
        status=data[0] >> 4,
        position=motion >> 24,
        velocity=motion >> 12 & 0xFFF,
        torque=motion & 0xFFF,
        board=data[6],
        winding=data[7],
    )


def request_data(identifier: int, request: int, register: int = 0) -> bytes:
    """Return the eight bytes of a request to the motor with this identifier."""
    return struct.pack('<HBBI', identifier, request, register, 0)


def reading_data(identifier: int, register: Register, value: float) -> bytes:
    """Return the eight bytes with which a motor answers a reading."""
    is_integer = register in _INTEGERS
    kind = '<HBBI' if is_integer else '<HBBf'
    return struct.pack(
        kind, identifier, READ, register, int(value) if is_integer else value
    )


def reading_of(data: bytes, identifier: int, register: Register) -> float | None:
    """Return the value of this register in an answer; None: it is something else."""
    if data[:4] != struct.pack('<HBB', identifier, READ, register):
        return None
    kind = '<I' if register in _INTEGERS else '<f'
    (value,) = struct.unpack(kind, data[4:])
    return float(value)
