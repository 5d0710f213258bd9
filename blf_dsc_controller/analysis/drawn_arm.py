# SPDX-License-Identifier: Apache-2.0
"""An arm as lines from joint to joint in 3D, to be animated on the page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from blf_dsc_controller.arms.urdf import Chain


class DrawnJoint(NamedTuple):
    """A joint at position 0, in the frame of the joint before."""

    rotation: list[list[float]]  # (3, 3)
    offset: list[float]  # (3,) m
    axis: list[float]  # (3,) in its own frame
    slides: bool


class DrawnArm(NamedTuple):
    """Joints from the base on, and the tip [m] in the frame of the last."""

    joints: list[DrawnJoint]
    tip: list[float]


def planar_arm(lengths: Sequence[float]) -> DrawnArm:
    """Return an arm in the x-z plane whose links of these lengths [m] lie along x at 0 rad."""
    unit = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    before = (0.0, *lengths[:-1])
    joints = [DrawnJoint(unit, [x, 0.0, 0.0], [0.0, -1.0, 0.0], slides=False) for x in before]
    return DrawnArm(joints, [lengths[-1], 0.0, 0.0])


def arm_of_chain(chain: Chain) -> DrawnArm:
    """Return the arm of a URDF."""
    joints = [
        DrawnJoint(
            joint.placement[:3, :3].round(6).tolist(),
            joint.placement[:3, 3].tolist(),
            joint.axis.tolist(),
            joint.kind == 'prismatic',
        )
        for joint in chain.joints
    ]
    return DrawnArm(joints, chain.tip_placement[:3, 3].tolist())
