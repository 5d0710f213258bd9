# SPDX-License-Identifier: Apache-2.0
"""An identified arm as MJCF: bodies, joints, rotors and friction; no geometry.

MJCF has a place for what a URDF lacks: the rotors are `armature`.  What is held at its
joint, such as a gripper's fingers, is part of the body that carries it.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence

import numpy as np

from blf_dsc_controller.arms.inertia import pseudo_inertia, rotational_inertia
from blf_dsc_controller.arms.urdf import Joint
from blf_dsc_controller.identification.identified import Identified
from blf_dsc_controller.identification.values import ROTOR_INERTIA
from blf_dsc_controller.run import Floats


def mjcf(found: Identified, gravity: Sequence[float], note: str) -> str:
    """Return the arm as MJCF, with gravity (3,) [m/s^2] and a comment."""
    root = ET.Element('mujoco', model=found.chain.tip)
    root.append(ET.Comment(f'\n{note.replace("--", "- -")}\n'))
    ET.SubElement(root, 'compiler', angle='radian')
    ET.SubElement(root, 'option', gravity=_words(gravity))
    body = ET.SubElement(root, 'worldbody')
    rotors = found.parts.terms[ROTOR_INERTIA]
    for i, joint in enumerate(found.chain.joints):
        pose = _pose(joint.placement)
        body = ET.SubElement(body, 'body', {'name': joint.link, **pose})
        _add_inertial(body, found.parts.bodies[i])
        damping, friction = found.dynamics[:, i]
        _add_joint(
            body,
            joint,
            armature=rotors[i],
            damping=damping,
            frictionloss=friction,
        )
    pose = _pose(found.chain.tip_placement)
    ET.SubElement(body, 'site', {'name': 'tip', **pose})
    ET.indent(root)
    return ET.tostring(root, encoding='unicode') + '\n'


def _add_inertial(body: ET.Element, inertia: Floats) -> None:
    """Add the ten of a body, about its centre of mass."""
    J = pseudo_inertia(inertia)
    mass = J[3, 3]
    T = np.eye(4)
    T[:3, 3] = -J[:3, 3] / mass
    I = rotational_inertia(T @ J @ T.T)
    tensor = (I[0, 0], I[1, 1], I[2, 2], I[0, 1], I[0, 2], I[1, 2])
    ET.SubElement(
        body,
        'inertial',
        pos=_words(J[:3, 3] / mass),
        mass=_words([mass]),
        fullinertia=_words(tensor),
    )


def _add_joint(body: ET.Element, joint: Joint, **dynamics: float) -> None:
    """Add a joint with its limits, inertia of its rotor and friction."""
    kind = 'slide' if joint.kind == 'prismatic' else 'hinge'
    attributes = {name: _words([value]) for name, value in dynamics.items()}
    if math.isfinite(joint.lower) and math.isfinite(joint.upper):
        attributes['range'] = _words((joint.lower, joint.upper))
        attributes['limited'] = 'true'
    if math.isfinite(joint.effort):
        attributes['actuatorfrcrange'] = _words((-joint.effort, joint.effort))
        attributes['actuatorfrclimited'] = 'true'
    given = {'name': joint.name, 'type': kind, 'axis': _words(joint.axis)}
    ET.SubElement(body, 'joint', given | attributes)


def _pose(placement: Floats) -> dict[str, str]:
    """Return the position and the first two axes of a placement (4, 4)."""
    axes = np.concatenate((placement[:3, 0], placement[:3, 1]))
    return {'pos': _words(placement[:3, 3]), 'xyaxes': _words(axes)}


def _words(numbers: Iterable[float]) -> str:
    return ' '.join(f'{float(number):.12g}' for number in numbers)
