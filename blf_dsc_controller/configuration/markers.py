# SPDX-License-Identifier: Apache-2.0
"""What the node that draws the arm's reference, bound and torque can be told."""

from __future__ import annotations

from dataclasses import dataclass

from blf_dsc_controller.configuration.parameter import parameter

_AT_START = 'it is looked at once, when the node starts'


@dataclass(frozen=True)
class Arm:
    """The lengths that it is drawn with."""

    l1: float = parameter(
        1.0, 'length of the first link', unit='m', symbol='l1', above=0.0, read_only=_AT_START
    )
    l2: float = parameter(
        0.8, 'length of the second link', unit='m', symbol='l2', above=0.0, read_only=_AT_START
    )


@dataclass(frozen=True)
class MarkersConfig:
    """Parameters of `arm_markers`."""

    joints: tuple[str, ...] = parameter(
        ('joint1', 'joint2'), 'names of the joints, from the base on', read_only=_AT_START
    )
    frame: str = parameter('base_link', 'frame that the markers are drawn in', read_only=_AT_START)
    period: float = parameter(
        0.1, 'time from one picture to the next', unit='s', above=0.0, read_only=_AT_START
    )
    torque_scale: float = parameter(
        0.05, 'length of the arrow of a torque', unit='m/(N m)', above=0.0, read_only=_AT_START
    )
    arm: Arm = Arm()

    def problems(self) -> list[str]:
        """Return what is wrong beside the ranges of single parameters, in words."""
        if len(self.joints) == 2:
            return []
        return [f'joints: got {len(self.joints)}, but the arm that is drawn has 2']
