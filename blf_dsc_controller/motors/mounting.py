# SPDX-License-Identifier: Apache-2.0
"""How motors sit at their joints: which way they turn, and where their zeros are.

    q = d (q_m - o)        dq = d dq_m        tau = d tau_m

with the direction d, 1 or -1, and the offset o, the position of the motor at the zero of
its joint.  Gains are the same on both sides.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.motors.field import Field
from blf_dsc_controller.motors.frame import Frame, Ranges

Vector = NDArray[np.float64]


class Mounting(NamedTuple):
    """Directions and offsets of n motors."""

    direction: Vector  # 1 or -1
    offset: Vector  # rad

    def states_at_joints(self, states: Vector) -> Vector:
        """Return q, dq, torque (3, n) of the joints for those of their motors."""
        q, dq, torque = states
        return np.asarray(self.direction * np.array([q - self.offset, dq, torque]))

    def states_at_motors(self, states: Vector) -> Vector:
        """Return q, dq, torque (3, n) of the motors for those of their joints."""
        at_motors = self.direction * states
        at_motors[0] += self.offset
        return np.asarray(at_motors)

    def frame_at_motors(self, frame: Frame) -> Frame:
        """Return what the motors are sent for a frame of their joints."""
        moved = np.array([frame.position, frame.velocity, frame.torque])
        return _with(frame, self.states_at_motors(moved))

    def frame_at_joints(self, frame: Frame) -> Frame:
        """Return the frame of the joints for what their motors are sent."""
        moved = np.array([frame.position, frame.velocity, frame.torque])
        return _with(frame, self.states_at_joints(moved))

    def ranges_at_joints(self, ranges: Ranges) -> Ranges:
        """Return what frames can carry, as values of the joints.

        Their steps are those of the motors: a value that one carries, so does the other.
        """
        return ranges._replace(
            position=self._turned(ranges.position, self.offset),
            velocity=self._turned(ranges.velocity),
            torque=self._turned(ranges.torque),
        )

    def _turned(self, field: Field, offset: Vector | float = 0.0) -> Field:
        ends = self.direction * (np.array(np.broadcast_arrays(*field[:2])) - offset)
        return Field(ends.min(axis=0), ends.max(axis=0), field.bits)


def _with(frame: Frame, moved: Vector) -> Frame:
    position, velocity, torque = moved
    return frame._replace(position=position, velocity=velocity, torque=torque)
