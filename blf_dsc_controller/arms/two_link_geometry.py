# SPDX-License-Identifier: Apache-2.0
"""The two-link arm in space, in the vertical x-z plane: positions of its links, and its URDF.

URDF turns joints counterclockwise about their axis, and q1 counts from the horizontal upwards: from
x to z, which is about -y.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, sin, sqrt
from xml.sax.saxutils import quoteattr

Point = tuple[float, float, float]

# The inertia of a point mass: most readers reject zero.
_LINK = """\
  <link name="link{number}">
    <inertial>
      <origin xyz="{length:g} 0 0" />
      <mass value="{mass:.17g}" />
      <inertia ixx="1e-9" iyy="1e-9" izz="1e-9" ixy="0" ixz="0" iyz="0" />
    </inertial>
    <visual>
      <origin xyz="{half:g} 0 0" rpy="0 1.5707963267948966 0" />
      <geometry>
        <cylinder radius="0.02" length="{length:g}" />
      </geometry>
      <material name="link{number}_colour">
        <color rgba="{colour}" />
      </material>
    </visual>
  </link>
"""
_JOINT = """\
  <joint name={name} type="continuous">
    <parent link="{parent}" />
    <child link="link{number}" />
    <origin xyz="{x:.17g} 0 0" />
    <axis xyz="0 -1 0" />
{limit}  </joint>
"""


def points(l1: float, l2: float, q: Sequence[float]) -> tuple[Point, Point, Point]:
    """Base, elbow and tip [m] at the joint positions q [rad]."""
    elbow = (l1 * cos(q[0]), 0.0, l1 * sin(q[0]))
    angle = q[0] + q[1]
    tip = (elbow[0] + l2 * cos(angle), 0.0, elbow[2] + l2 * sin(angle))
    return (0.0, 0.0, 0.0), elbow, tip


def tip_radius(l1: float, l2: float, q2: float, bound: Sequence[float]) -> float:
    """Largest distance [m] of the tip from its reference while both joints keep their bounds.

    To first order: joint 1 swings the tip about the base, joint 2 about the elbow.
    """
    reach = sqrt(l1 * l1 + l2 * l2 + 2.0 * l1 * l2 * cos(q2))
    return reach * bound[0] + l2 * bound[1]


def urdf(
    name: str,
    joints: Sequence[str],
    lengths: Sequence[float],
    masses: Sequence[float],
    effort: Sequence[float],
) -> str:
    """URDF of a robot of this name.

    Lengths [m], masses [kg] at the ends of the links, torque limits [N m] of the joints, 0 for
    none.
    """
    text = f'<robot name={quoteattr(name)}>\n  <link name="base_link" />\n'
    links = zip(lengths, masses, ('0.2 0.4 0.8 1', '0.8 0.4 0.2 1'), strict=True)
    for number, (length, mass, colour) in enumerate(links, 1):
        text += _LINK.format(
            number=number, length=length, half=length / 2, mass=mass, colour=colour
        )
    parents = (('base_link', 0.0), ('link1', lengths[0]))
    for number, (joint, (parent, x), limit) in enumerate(
        zip(joints, parents, effort, strict=True), 1
    ):
        line = f'    <limit effort="{limit:g}" velocity="1000" />\n' if limit > 0.0 else ''
        text += _JOINT.format(name=quoteattr(joint), parent=parent, number=number, x=x, limit=line)
    return text + '</robot>'
