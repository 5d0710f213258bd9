# SPDX-License-Identifier: Apache-2.0
"""The URDF of an arm alone, for readers that take every joint for one that moves.

What no joint of the arm moves is left out: tables, free bodies, other arms.  What the
arm carries by other joints, such as fingers, is fixed at position 0, as in `urdf`.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence

from blf_dsc_controller.arms.urdf import Tree
from blf_dsc_controller.arms.xml_text import parse_xml


def arm_alone(text: str, joints: Sequence[str], tip: str) -> str:
    """Return the URDF of some joints of a URDF text, from its root to the link `tip`.

    All other joints are fixed; links that no joint of these moves have no inertia.

    Raises:
        BlfDscError: the text is no URDF, or has no such tip.
    """
    tree = Tree.of(text)
    kept = _links(tree, joints, tip)
    robot = parse_xml(text)
    for element in list(robot):
        name = element.get('name', '')
        if element.tag == 'link' and name in kept:
            _strip(element, is_moved=kept[name])
        elif element.tag == 'joint' and _child(element) in kept:
            _fix(element, joints)
        else:
            robot.remove(element)
    return ET.tostring(robot, encoding='unicode')


def _links(tree: Tree, joints: Sequence[str], tip: str) -> dict[str, bool]:
    """Return the links of the arm, and whether a joint moves them."""
    path = [_child(joint) for joint in tree.path(tree.root, tip)]
    moved = {tree.root: False}
    waiting = list(tree.joints.values())
    while waiting:
        unresolved = []
        for joint in waiting:
            child = _child(joint)
            parent = joint.find('parent')
            above = moved.get('' if parent is None else parent.get('link', ''))
            if above is None:
                unresolved.append(joint)
                continue
            is_moved = above or joint.get('name') in joints
            if is_moved or child in path:
                moved[child] = is_moved
        if len(unresolved) == len(waiting):
            break
        waiting = unresolved
    return moved


def _child(joint: ET.Element) -> str:
    child = joint.find('child')
    return '' if child is None else child.get('link', '')


def _strip(link: ET.Element, *, is_moved: bool) -> None:
    """Remove all of a link but an inertia that has an effect; others need not be physical."""
    for part in list(link):
        mass = part.find('mass')
        has_mass = mass is not None and float(mass.get('value', '0')) > 0.0
        if part.tag != 'inertial' or not (is_moved and has_mass):
            link.remove(part)


def _fix(joint: ET.Element, joints: Sequence[str]) -> None:
    """Make a joint fixed that is none of the arm's."""
    for mimic in joint.findall('mimic'):
        joint.remove(mimic)
    if joint.get('name') not in joints:
        joint.set('type', 'fixed')
