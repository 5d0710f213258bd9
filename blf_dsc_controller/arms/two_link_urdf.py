# SPDX-License-Identifier: Apache-2.0
"""URDF of the two-link arm: point masses at the ends of its links, in the vertical x-z plane.

URDF turns joints counterclockwise about their axis, and q1 is counted from the horizontal upwards:
from x to z, which is about -y.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from typing import Protocol

BASE = 'base_link'
_RADIUS = 0.02  # m, of the links as drawn
_INERTIA = '1e-9'  # kg m^2, of a point mass: most readers refuse none at all
_COLOURS = ('0.2 0.4 0.8 1', '0.8 0.4 0.2 1')


class Arm(Protocol):
    """Lengths [m] and masses [kg] of both links."""

    @property
    def l1(self) -> float:
        """Length of the first link [m]."""

    @property
    def l2(self) -> float:
        """Length of the second link [m]."""

    @property
    def m1(self) -> float:
        """Mass at the end of the first link [kg]."""

    @property
    def m2(self) -> float:
        """Mass at the end of the second link [kg]."""


def urdf(name: str, joints: Sequence[str], arm: Arm, effort: Sequence[float]) -> str:
    """URDF of the arm.

    Args:
        name: of the robot.
        joints: names of both joints, from the base on.
        arm: its lengths and masses.
        effort: largest torque of each joint [N m]; 0 for none, which URDF cannot say.
    """
    robot = ET.Element('robot', name=name)
    ET.SubElement(robot, 'link', name=BASE)
    links = [f'link{number}' for number in (1, 2)]
    sizes = ((arm.l1, arm.m1), (arm.l2, arm.m2))
    for link, (length, mass), colour in zip(links, sizes, _COLOURS, strict=True):
        _add_link(robot, link, length, mass, colour)
    parents = ((BASE, 0.0), (links[0], arm.l1))
    for joint, link, (parent, x), limit in zip(joints, links, parents, effort, strict=True):
        _add_joint(robot, joint, link, parent, x, limit)
    ET.indent(robot)
    return ET.tostring(robot, encoding='unicode')


def _add_link(robot: ET.Element, name: str, length: float, mass: float, colour: str) -> None:
    link = ET.SubElement(robot, 'link', name=name)
    inertial = ET.SubElement(link, 'inertial')
    ET.SubElement(inertial, 'origin', xyz=f'{length:g} 0 0')
    ET.SubElement(inertial, 'mass', value=f'{mass:.17g}')
    moments = {'ixx': _INERTIA, 'iyy': _INERTIA, 'izz': _INERTIA}
    ET.SubElement(inertial, 'inertia', moments | dict.fromkeys(('ixy', 'ixz', 'iyz'), '0'))
    visual = ET.SubElement(link, 'visual')
    ET.SubElement(visual, 'origin', xyz=f'{length / 2:g} 0 0', rpy='0 1.5707963267948966 0')
    geometry = ET.SubElement(visual, 'geometry')
    ET.SubElement(geometry, 'cylinder', radius=f'{_RADIUS:g}', length=f'{length:g}')
    material = ET.SubElement(visual, 'material', name=f'{name}_colour')
    ET.SubElement(material, 'color', rgba=colour)


def _add_joint(
    robot: ET.Element, name: str, link: str, parent: str, x: float, limit: float
) -> None:
    joint = ET.SubElement(robot, 'joint', name=name, type='continuous')
    ET.SubElement(joint, 'parent', link=parent)
    ET.SubElement(joint, 'child', link=link)
    ET.SubElement(joint, 'origin', xyz=f'{x:.17g} 0 0')
    ET.SubElement(joint, 'axis', xyz='0 -1 0')
    if limit > 0.0:
        ET.SubElement(joint, 'limit', effort=f'{limit:g}', velocity='1000')
