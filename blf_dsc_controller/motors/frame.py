# SPDX-License-Identifier: Apache-2.0
"""What motors with a PD of their own are sent in each cycle, and a torque split for them.

Such a motor computes, at 10 kHz or more and from its own encoder,

    tau = kp (q_f - q) + kd (dq_f - dq) + t                                    [N m]

from the frame (q_f, dq_f, kp, kd, t) that it got last.  Damiao, and others after the MIT
Cheetah, call this MIT mode.

A law's torque tau at a measured state (q, dq) with reference (q_r, dq_r) is split so
that

    kp (q_r - q) + kd (dq_r - dq) + t = tau.

The motor acts on this frame later and for a whole period, while the arm moves on.  So
q_f, dq_f are the reference in the middle of that time: as long as the arm moves as its
reference does, the mean torque is tau, and what the motor adds answers what does not.
(With q_r itself it would brake every motion, by kp T/2 per rad/s.)

t is computed from kp, kd, q_f and dq_f as the frame carries them, rounded.  So the sum
differs from tau by the rounding of t alone, half a step of its field.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.motors.field import Field

Vector = NDArray[np.float64]


class Motion(NamedTuple):
    """Positions and velocities, each (n,)."""

    q: Vector  # rad
    dq: Vector  # rad/s


class Gains(NamedTuple):
    """Gains of each joint's PD, each (n,)."""

    stiffness: Vector  # kp, N m/rad
    damping: Vector  # kd, N m s/rad


class Frame(NamedTuple):
    """What n motors are sent, each (n,)."""

    position: Vector  # q_f, rad
    velocity: Vector  # dq_f, rad/s
    stiffness: Vector  # kp, N m/rad
    damping: Vector  # kd, N m s/rad
    torque: Vector  # t, N m

    def torque_at(self, q: Vector, dq: Vector) -> Vector:
        """Return what the motors make of it (n,) [N m] at q [rad] and dq [rad/s]."""
        pushed = self.stiffness * (self.position - q)
        damped = self.damping * (self.velocity - dq)
        return np.asarray(pushed + damped + self.torque)


def torque_alone(torque: Vector) -> Frame:
    """Return the frame of a torque (n,) [N m], without a PD."""
    nothing = np.zeros_like(torque)
    return Frame(nothing, nothing, nothing, nothing, torque)


class Ranges(NamedTuple):
    """What the fields of a frame can hold."""

    position: Field  # rad
    velocity: Field  # rad/s
    stiffness: Field  # N m/rad
    damping: Field  # N m s/rad
    torque: Field  # N m, also of the sum: the motor cuts it there


def split(
    torque: Vector,
    measured: Motion,
    reference: Motion,
    ahead: Motion,
    gains: Gains,
    ranges: Ranges,
) -> Frame:
    """Return the frame whose sum at the measured state is a law's torque (n,) [N m].

    `reference` is that of the law's sample, `ahead` that in the middle of the time in
    which the frame acts; `gains` are cut to their ranges.  A joint whose remainder is
    beyond its range gets the torque alone.
    """
    position = ranges.position.nearest(ahead.q)
    velocity = ranges.velocity.nearest(ahead.dq)
    stiffness = ranges.stiffness.nearest(gains.stiffness)
    damping = ranges.damping.nearest(gains.damping)
    shift_q, shift_dq = ahead.q - reference.q, ahead.dq - reference.dq
    frame = Frame(position, velocity, stiffness, damping, np.zeros_like(torque))
    expected = frame.torque_at(measured.q + shift_q, measured.dq + shift_dq)
    rest = torque - expected
    fits = ranges.torque.holds(rest)
    alone = ~fits
    stiffness[alone] = damping[alone] = 0.0
    rest[alone] = torque[alone]
    return frame._replace(torque=ranges.torque.nearest(rest))
