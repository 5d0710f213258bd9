# SPDX-License-Identifier: Apache-2.0
"""URDF of the two-link arm, in the vertical x-z plane.

URDF joints turn counterclockwise about their axis, and q1 counts from the horizontal upwards: from
x to z, which is about -y.
"""

from __future__ import annotations

from collections.abc import Sequence
from xml.sax.saxutils import quoteattr

# A point mass, with a tiny inertia: most parsers reject zero.
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
_TIP = """\
  <link name="tip" />
  <joint name="tip_joint" type="fixed">
    <parent link="link2" />
    <child link="tip" />
    <origin xyz="{x:.17g} 0 0" />
  </joint>
"""


def urdf(
    name: str,
    joints: Sequence[str],
    lengths: Sequence[float],
    masses: Sequence[float],
    effort: Sequence[float],
) -> str:
    """Return the URDF of a robot of this name, whose tip is the link `tip`.

    `lengths` and `masses` are those of the links [m] and at their ends [kg], `effort` the torque
    limits of the joints [N m], 0 for none.
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
    return text + _TIP.format(x=lengths[1]) + '</robot>'
