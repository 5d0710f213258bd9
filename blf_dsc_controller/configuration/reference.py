# SPDX-License-Identifier: Apache-2.0
"""The reference to track, the approach to it, and the limits of any motion."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Annotated, Literal

from blf_dsc_controller.configuration.common import PerJoint
from blf_dsc_controller.configuration.schema import parameter, positive

_fixed = partial(
    parameter, read_only='the reference would jump: send a trajectory on ~/joint_trajectory'
)


@dataclass(frozen=True)
class Reference:
    """The reference to track, until a trajectory arrives on `~/joint_trajectory`.

    sinusoids  qr_i = offset_i + sum_k amplitude_ik cos(frequency_k t + phase_k)
    waypoints  minimum jerk through `points` at `times`, at rest at both ends
    hold       the initial position

    `amplitude` and `points` hold one row per joint, row by row.
    """

    type: Literal['sinusoids', 'waypoints', 'hold'] = _fixed(
        'sinusoids',
        "sinusoids (the paper's), waypoints (minimum jerk), or hold (the initial position)",
    )
    offset: PerJoint = _fixed((1.9935, 1.3961), 'centre of the motion', 'rad')
    amplitude: Annotated[tuple[float, ...], 'joints', 'reference.frequency'] = _fixed(
        (0.3, 0.3), 'amplitude of each tone: one row per joint, row by row', 'rad'
    )
    frequency: tuple[float, ...] = _fixed(
        (1.0,), 'angular frequency of each tone', 'rad/s', at_least=0.0
    )
    phase: Annotated[tuple[float, ...], 'reference.frequency'] = _fixed(
        (0.0,), 'phase of each tone', 'rad'
    )
    times: tuple[float, ...] = _fixed(
        (), 'time of each waypoint from the start', 's', at_least=0.0, may_be_empty=True
    )
    points: Annotated[tuple[float, ...], 'joints', 'reference.times'] = _fixed(
        (), 'position at each waypoint: one row per joint, row by row', 'rad', may_be_empty=True
    )

    def problems(self) -> list[str]:
        """Check that there are waypoints if they are used, and that their times increase."""
        if self.type == 'waypoints' and not self.times:
            return ['reference.times: got none, but reference.type waypoints needs at least one']
        return [
            f'reference.times: got {after:g} s after {before:g} s, but they must increase'
            for before, after in pairwise(self.times)
            if after <= before
        ]


@dataclass(frozen=True)
class Approach:
    """Motion to the reference from a start outside the bound; the bound applies along it."""

    enabled: bool = parameter(
        True, 'guide an arm that starts outside the bound to the reference; false: do not start'
    )
    longest: float = positive(30.0, 'longest duration of the approach', 's')


@dataclass(frozen=True)
class MotionLimits:
    """Limits of each joint for an approach or a received trajectory."""

    position_lower: PerJoint = parameter((-2.0 * math.pi,) * 2, 'lowest position', 'rad')
    position_upper: PerJoint = parameter((2.0 * math.pi,) * 2, 'highest position', 'rad')
    velocity: PerJoint = positive((1.5, 1.5), 'largest velocity', 'rad/s')
    acceleration: PerJoint = positive((2.0, 2.0), 'largest acceleration', 'rad/s^2')

    def problems(self, joints: tuple[str, ...]) -> list[str]:
        """Check that the position limits leave a range."""
        limits = zip(joints, self.position_lower, self.position_upper, strict=True)
        return [
            f'limits.position_upper: got {upper:g} rad for {joint}, but it must be above '
            f'limits.position_lower, {lower:g} rad'
            for joint, lower, upper in limits
            if upper <= lower
        ]
