# SPDX-License-Identifier: Apache-2.0
"""What to follow, how to get there, and what a reference may ask of the joints."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

from blf_dsc_controller.configuration.schema import parameter

_PER_JOINT = ('joints',)
_TONES = ('reference.frequency',)
_JUMP = 'the reference would jump: send another on ~/joint_trajectory'
_TURN = 6.283185307179586

REFERENCES = ('sinusoids', 'waypoints', 'hold')


@dataclass(frozen=True)
class Reference:
    """The trajectory to follow, until another one is sent on `~/joint_trajectory`.

    sinusoids  qr_i = offset_i + sum_k amplitude_ik cos(frequency_k t + phase_k)
    waypoints  the motion of least jerk through `points` at `times`, at rest at both ends
    hold       the position at the start

    `amplitude` and `points` hold a row for each joint, one row after the other.
    """

    type: str = parameter(
        'sinusoids',
        "sinusoids (the paper's), waypoints (least jerk through points), or hold (stay there)",
        choices=REFERENCES,
        read_only=_JUMP,
    )
    offset: tuple[float, ...] = parameter(
        (1.9935, 1.3961), 'middle of the motion', unit='rad', length=_PER_JOINT, read_only=_JUMP
    )
    amplitude: tuple[float, ...] = parameter(
        (0.3, 0.3),
        'amplitude of each tone: a row for each joint, one after the other',
        unit='rad',
        length=('joints', 'reference.frequency'),
        read_only=_JUMP,
    )
    frequency: tuple[float, ...] = parameter(
        (1.0,), 'angular frequency of each tone', unit='rad/s', at_least=0.0, read_only=_JUMP
    )
    phase: tuple[float, ...] = parameter(
        (0.0,), 'phase of each tone', unit='rad', length=_TONES, read_only=_JUMP
    )
    times: tuple[float, ...] = parameter(
        (),
        'time of each waypoint since the start',
        unit='s',
        at_least=0.0,
        may_be_empty=True,
        read_only=_JUMP,
    )
    points: tuple[float, ...] = parameter(
        (),
        'position at each waypoint: a row for each joint, one after the other',
        unit='rad',
        length=('joints', 'reference.times'),
        may_be_empty=True,
        read_only=_JUMP,
    )

    def problems(self) -> list[str]:
        """Where times and points make no motion."""
        if self.type == 'waypoints' and not self.times:
            return ['reference.times: got none, but reference.type waypoints needs at least one']
        return [
            f'reference.times: got {after:g} s after {before:g} s, but they must increase'
            for before, after in pairwise(self.times)
            if after <= before
        ]


@dataclass(frozen=True)
class Approach:
    """The way to the reference from a start outside the bound, tracked within it."""

    enabled: bool = parameter(
        True,
        'lead an arm that starts outside the bound to the reference, instead of refusing',
    )
    longest: float = parameter(
        30.0, 'longest time that the way to the reference may take', unit='s', above=0.0
    )


@dataclass(frozen=True)
class MotionLimits:
    """What an approach or a trajectory that is sent may ask of the joints."""

    position_lower: tuple[float, ...] = parameter(
        (-_TURN, -_TURN), 'least position', unit='rad', length=_PER_JOINT
    )
    position_upper: tuple[float, ...] = parameter(
        (_TURN, _TURN), 'largest position', unit='rad', length=_PER_JOINT
    )
    velocity: tuple[float, ...] = parameter(
        (1.5, 1.5), 'largest velocity', unit='rad/s', above=0.0, length=_PER_JOINT
    )
    acceleration: tuple[float, ...] = parameter(
        (2.0, 2.0), 'largest acceleration', unit='rad/s^2', above=0.0, length=_PER_JOINT
    )

    def problems(self, joints: tuple[str, ...]) -> list[str]:
        """Where no position is allowed."""
        return [
            f'limits.position_upper: got {upper:g} rad for {joint}, but it must be above '
            f'limits.position_lower, {lower:g} rad'
            for joint, lower, upper in zip(
                joints, self.position_lower, self.position_upper, strict=True
            )
            if upper <= lower
        ]
