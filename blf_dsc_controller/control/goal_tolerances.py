# SPDX-License-Identifier: Apache-2.0
"""Tolerances of a goal: errors on the path, and at its end.

As for joint_trajectory_controller: 0 is the default and -1 none. Here the default of a
position is the bound, that of a velocity none. Accelerations are not measured, so that
theirs are not checked.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, nan
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.control.goal_messages import JointTolerance
from blf_dsc_controller.errors import BlfDscError

_NONE = -1.0  # as sent
_ROUNDING = 1e-6


class Tolerances(NamedTuple):
    """Largest errors of all joints; a position's (n,) [rad] of NaN is the bound."""

    position: np.ndarray
    velocity: np.ndarray  # (n,) [rad/s]

    def violation(
        self, config: ControllerConfig, error: np.ndarray, bound: np.ndarray
    ) -> str:
        """Return which joint exceeds what; empty if none.

        Args:
            config: of the joints.
            error: (2, n), of positions [rad] and velocities [rad/s].
            bound: (n,) [rad].
        """
        largest = np.where(np.isnan(self.position), bound, self.position)
        ratio = np.abs(error) / (largest, self.velocity)
        if ratio.max() <= 1.0:
            return ''
        kind, i = divmod(int(ratio.argmax()), len(config.joints))
        unit = config.units[i].of(('rad', 'rad/s')[kind])
        allowed = (largest, self.velocity)[kind][i]
        return (
            f'{config.joints[i]!r} is {error[kind, i]:+.3g} {unit} from its reference, and '
            f'{allowed:.3g} {unit} are allowed'
        )


def tolerances(joints: Sequence[str], given: Sequence[JointTolerance]) -> Tolerances:
    """Return the tolerances of all joints.

    Raises:
        BlfDscError: a joint is unknown, or a value is negative but not -1, or not finite.
    """
    position = np.full(len(joints), nan)
    velocity = np.full(len(joints), inf)
    for joint, of_position, of_velocity in given:
        if joint not in joints:
            raise BlfDscError(
                f'the tolerance of {joint!r}: the joints are {", ".join(joints)}'
            )
        i = joints.index(joint)
        position[i] = _value(joint, of_position, nan)
        velocity[i] = _value(joint, of_velocity, inf)
    return Tolerances(position, velocity)


def _value(joint: str, sent: float, default: float) -> float:
    if abs(sent - _NONE) < _ROUNDING:
        return inf
    if not 0.0 <= sent < inf:
        raise BlfDscError(
            f'the tolerance of {joint!r} is {sent:g}: it must be above 0, 0 for the default, or -1 '
            'for none'
        )
    return sent or default
