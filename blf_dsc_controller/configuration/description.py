# SPDX-License-Identifier: Apache-2.0
"""What a URDF of this package can say beyond the format; other readers ignore it.

`<dynamics armature="">` is the inertia of the drive at its joint, `<link gravity="">`
is gravity in the frame of a link that no joint moves, and `<joint><unsupported
reason=""/>` a joint that has to be held.  MJCF has all three: `mjcf`.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from functools import lru_cache
from math import isfinite
from typing import NamedTuple

from blf_dsc_controller.arms.urdf import Chain, placement_of
from blf_dsc_controller.arms.xml_text import parse_xml
from blf_dsc_controller.errors import BlfDscError

ARMATURE = 'armature'
GRAVITY = 'gravity'
UNSUPPORTED = 'unsupported'
REASON = 'reason'


class Description(NamedTuple):
    """What the text says, by the names of joints and links."""

    armature: dict[str, float]  # kg m^2 or kg
    gravity: dict[str, tuple[float, ...]]  # m/s^2
    unsupported: dict[str, str]  # reasons


@lru_cache(maxsize=16)
def describe(text: str) -> Description:
    """Return what a URDF says beyond the format; BlfDscError if a number is none."""
    found = Description({}, {}, {})
    if not any(word in text for word in (ARMATURE, GRAVITY, UNSUPPORTED)):
        return found
    root = parse_xml(text)
    for link in root.findall('link'):
        if GRAVITY in link.attrib:
            found.gravity[link.get('name', '')] = _numbers(link, GRAVITY, 3)
    for joint in root.findall('joint'):
        name = joint.get('name', '')
        dynamics = joint.find('dynamics')
        if dynamics is not None and ARMATURE in dynamics.attrib:
            (armature,) = _numbers(dynamics, ARMATURE, 1)
            if armature < 0.0:
                raise BlfDscError(
                    f'joint {name!r} has <dynamics {ARMATURE}="{armature:g}">: an inertia '
                    'cannot be negative'
                )
            found.armature[name] = armature
        unsupported = joint.find(UNSUPPORTED)
        if unsupported is not None:
            found.unsupported[name] = unsupported.get(REASON, 'it is not supported')
    return found


def check_supported(text: str, chain: Chain) -> None:
    """Raise BlfDscError with all joints that cannot be part of a chain, and why."""
    reasons = describe(text).unsupported
    problems = [
        f'joint {joint.name!r} cannot be part of a serial chain: {reasons[joint.name]}'
        for joint in chain.joints
        if joint.name in reasons
    ]
    if problems:
        raise BlfDscError('; '.join(problems))


def rotors_of(text: str, chain: Chain) -> tuple[float, ...]:
    """Return the armatures of the joints.

    Empty if one is missing, or none is above zero.
    """
    armature = describe(text).armature
    found = [armature.get(joint.name) for joint in chain.joints]
    known = tuple(value for value in found if value is not None)
    return known if len(known) == len(found) and any(known) else ()


def gravity_of(
    text: str, chain: Chain, at_root: tuple[float, ...]
) -> tuple[float, ...]:
    """Return gravity (3,) [m/s^2] in the frame of the base, as the text says.

    Where it does not, gravity is `at_root` (3,) in the frame of the root, whose z is up, and fixed
    joints may turn the base.
    """
    said = describe(text).gravity.get(chain.base)
    if said is not None:
        return said
    turn = placement_of(text, chain.base)[:3, :3]
    turned = (turn.T @ at_root).round(12) + 0.0  # no negative zeros
    return tuple(turned.tolist())


def _numbers(element: ET.Element, key: str, count: int) -> tuple[float, ...]:
    text = element.get(key, '')
    try:
        numbers = tuple(float(word) for word in text.split())
    except ValueError:
        numbers = ()
    if len(numbers) != count or not all(map(isfinite, numbers)):
        raise BlfDscError(
            f'<{element.tag} {key}="{text}">: expected {count} finite number(s)'
        )
    return numbers
