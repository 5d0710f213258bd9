# SPDX-License-Identifier: Apache-2.0
"""Groups of the controller's parameters: the motions of the arm, and their limits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np

from blf_dsc_controller.configuration.schema import PerJoint, parameter, positive
from blf_dsc_controller.run import JointUnits

_of_reference = partial(
    parameter,
    read_only='the reference would jump: send a trajectory on ~/joint_trajectory',
)
_RISE = 0.05  # s to the largest acceleration
_ROUNDING = 1.0 + 1e-9

PAST_LIMITS = 0.1
"""Distance [rad or m] by which an arm may be past its position limits."""


@dataclass(frozen=True)
class Reference:
    """The reference to track, until a trajectory arrives on `~/joint_trajectory`.

    Sinusoids are qr_i = offset_i + sum_k amplitude_ik cos(frequency_k t + phase_k);
    waypoints are passed with minimum jerk, at rest at both ends.
    """

    type: Literal['sinusoids', 'waypoints', 'hold'] = _of_reference(
        'sinusoids',
        'sinusoids (paper), waypoints (minimum jerk), or hold (the initial position)',
    )
    offset: PerJoint = _of_reference((1.9935, 1.3961), 'centre of the motion', 'rad')
    amplitude: Annotated[tuple[float, ...], 'joints', 'reference.frequency'] = (
        _of_reference((0.3, 0.3), 'amplitude of each tone, one row per joint', 'rad')
    )
    frequency: tuple[float, ...] = _of_reference(
        (1.0,), 'angular frequency of each tone', 'rad/s', at_least=0.0
    )
    phase: Annotated[tuple[float, ...], 'reference.frequency'] = _of_reference(
        (0.0,), 'phase of each tone', 'rad'
    )
    times: tuple[float, ...] = _of_reference(
        (), 'time of each waypoint from the start', 's', at_least=0.0, omittable=True
    )
    waypoints: Annotated[tuple[float, ...], 'reference.times', 'joints'] = (
        _of_reference((), 'positions of all joints, one row per waypoint', 'rad')
    )

    def rows(self, joints: int) -> np.ndarray:
        """Return the waypoints (k, n) [rad] of so many joints."""
        return np.reshape(self.waypoints, (-1, joints))

    def problems(self) -> list[str]:
        """Check that waypoints are given if used, and that their times increase."""
        if self.type == 'waypoints' and not self.times:
            return [
                'reference.times: got none, but reference.type waypoints needs at least one'
            ]
        return [
            f'reference.times: got {after:g} s after {before:g} s, but they must increase'
            for before, after in pairwise(self.times)
            if after <= before
        ]


@dataclass(frozen=True)
class MotionLimits:
    """Limits of each joint for an approach or a received trajectory."""

    position_lower: PerJoint = parameter(
        (-2.0 * math.pi,) * 2, 'lowest position', 'rad'
    )
    position_upper: PerJoint = parameter(
        (2.0 * math.pi,) * 2, 'highest position', 'rad'
    )
    velocity: PerJoint = positive((1.5, 1.5), 'largest velocity', 'rad/s')
    acceleration: PerJoint = positive((2.0, 2.0), 'largest acceleration', 'rad/s^2')
    scale: float = positive(
        1.0,
        'share of the largest velocity and acceleration that motions which are sent '
        'may use; starts from rest and stops have all of it',
        at_most=1.0,
    )

    @property
    def jerk(self) -> tuple[float, ...]:
        """The jerk (n,) [rad/s^3] that reaches the acceleration in `_RISE`."""
        return tuple(each / _RISE for each in self.acceleration)

    def scaled(self, state: np.ndarray) -> MotionLimits:
        """Return the limits of a motion that is sent while the reference has this state (3, n).

        They are `scale` of these. A joint that is faster already may keep its speed, and has all
        of its acceleration and jerk to slow down.
        """
        _, dq, ddq = np.abs(state)
        speed, change, jerk = np.array((self.velocity, self.acceleration, self.jerk))
        # the speed goes on to change while the acceleration falls to zero
        reached = np.abs(state[1] + 0.5 * state[2] * ddq / (self.scale * jerk))
        reached = _ROUNDING * np.maximum(dq, reached)
        is_faster = (reached > self.scale * speed) | (ddq > self.scale * change)
        share = np.where(is_faster, 1.0, self.scale)
        speed = np.clip(reached, self.scale * speed, speed)
        return replace(
            self,
            velocity=tuple(speed.tolist()),
            acceleration=tuple((share * change).tolist()),
        )

    def problems(
        self, joints: tuple[str, ...], units: Sequence[JointUnits]
    ) -> list[str]:
        """Check that the position limits leave a range."""
        limits = zip(
            joints, units, self.position_lower, self.position_upper, strict=True
        )
        return [
            f'limits.position_upper: got {upper:g} {unit} for {joint}, but it must be above '
            f'limits.position_lower, {lower:g} {unit}'
            for joint, (unit, _, _), lower, upper in limits
            if upper <= lower
        ]
