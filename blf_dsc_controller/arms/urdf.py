# SPDX-License-Identifier: Apache-2.0
"""Serial chain between two links of a URDF: placements, axes, limits and inertias.

A body is what one joint moves: its link, with everything that is fixed to it.  The
rules:

- Fixed joints are merged, including those beyond the tip.
- Moving joints beside the chain or beyond its tip, such as a gripper's fingers, are
  held at position 0 and their links merged.
- A link without `<inertial>` has no mass, but each body must have one.
- Continuous joints, and joints without `<limit>`, have infinite limits; an effort or a
  velocity of 0 means no limit, and so does an acceleration.  Position limits are the
  narrower ones of `<limit>` and `<safety_controller>`, whose k_position and k_velocity count,
  too, unless they are 0.

Not supported: `floating`, `planar` and `mimic` joints in the chain, and loops of joints.
"""

from __future__ import annotations

import difflib
import itertools
import re
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import inf, isfinite
from sys import float_info
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.arms.inertia import (
    inertia_of,
    moved,
    pseudo_inertia,
    rotational_inertia,
)
from blf_dsc_controller.arms.xml_text import XmlError, parse_xml
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.numerics.algebra import product
from blf_dsc_controller.numerics.elementary import cos, sin

_MOVING = ('revolute', 'continuous', 'prismatic')
_MAX_KINDS = 5  # that a message names
_MAX_NAMES = 16  # likewise
_GRIPPER = re.compile('gripper|finger|jaw', re.IGNORECASE)
_ACCELERATIONS = ('acceleration', 'deceleration')  # of URDF 1.2
_MAX_ELEMENTS = 500  # of links, and of joints
_LIMITS = ('lower', 'upper', 'velocity', 'effort', *_ACCELERATIONS)
_SHORTEST = 1e-6  # of an axis or a quaternion that has a direction
_ROUNDED = 1e-12  # kg m^2, of moments of inertia
_LARGEST = 1e6  # m, kg, kg m^2 and so on; limits may be larger


class Joint(NamedTuple):
    """A moving joint, with the body that it moves.

    The frame of the joint is that of its link; its placement is in the frame of the
    previous joint, of the first joint in the base.
    """

    name: str
    kind: str
    placement: np.ndarray  # (4, 4) at position 0
    axis: np.ndarray  # (3,) unit vector
    lower: float  # position limits, rad or m
    upper: float
    velocity: float  # limit, rad/s or m/s
    effort: float  # limit, N m or N
    damping: float  # viscous friction from <dynamics>, N m s/rad or N s/m
    friction: float  # Coulomb friction from <dynamics>, N m or N
    link: str  # that it moves
    inertia: np.ndarray  # (10,) of the body, in the order of `INERTIA_NAMES`
    fixed: tuple[str, ...]  # links that are fixed to its link
    held: np.ndarray  # (4, 4) pseudo-inertia of what joints held at position 0 carry
    acceleration: float = inf  # limit, also of deceleration, rad/s^2 or m/s^2
    # k_position, 1/s, and k_velocity, N m s/rad or N s/m, of <safety_controller>
    soft_limits: tuple[float, float] = (inf, inf)

    @property
    def length(self) -> float:
        """Length [m] from the previous joint, pulled out as far as a joint that slides may be."""
        ends = [abs(each) for each in (self.lower, self.upper) if isfinite(each)]
        stroke = max(ends, default=0.0) if self.kind == 'prismatic' else 0.0
        return float(np.linalg.norm(self.placement[:3, 3])) + stroke


@dataclass(frozen=True, eq=False)
class Chain:
    """Joints from `base` to `tip`, and placement of the tip (4, 4) in the last joint's frame."""

    base: str
    tip: str
    joints: tuple[Joint, ...]
    tip_placement: np.ndarray

    @property
    def inertias(self) -> np.ndarray:
        """Ten inertial parameters of each body (n, 10)."""
        return np.array([joint.inertia for joint in self.joints])

    @property
    def reach(self) -> float:
        """Length [m] of the stretched arm, from its first joint to the tip."""
        to_tip = float(np.linalg.norm(self.tip_placement[:3, 3]))
        return sum(joint.length for joint in self.joints[1:]) + to_tip

    @property
    def gripper(self) -> str:
        """Name of a last joint that may be that of a gripper; empty if there is none.

        It slides where all others turn, or is called so.
        """
        *arm, last = self.joints
        if not arm:
            return ''
        slides = [joint.kind == 'prismatic' for joint in self.joints]
        is_one = _GRIPPER.search(last.name) or (slides[-1] and sum(slides) == 1)
        return last.name if is_one else ''


@lru_cache(maxsize=16)
def read_chain(text: str, base: str, tip: str, joints: tuple[str, ...]) -> Chain:
    """Return the serial chain of the moving `joints`, in order, between two links of a URDF text.

    An empty base means the root, an empty tip the link of the last joint, no joints all that
    move; without tip and joints, these must form one chain.

    Raises:
        BlfDscError: there is no such chain; the text says what is there and how to correct it.
    """
    tree = Tree.of(text)
    wanted = joints or (() if tip else tree.only_chain())
    for name in wanted:
        if name not in tree.joints:
            listed = _listed(tree.joints)
            raise BlfDscError(f'no joint {name!r} in the URDF: its joints are {listed}')
    base = base or tree.root
    tip = tip or _link(tree.joints[wanted[-1]], 'child')
    path = tree.path(base, tip)
    for element in path:
        _check_kind(element)
    moving = _moving(path)
    _check_moving(moving, wanted, base, tip)
    chain: list[Joint] = []
    frame = np.eye(4)
    for element in path:
        frame = product(frame, _origin(element))
        if element.get('type') != 'fixed':
            chain.append(
                _joint(element, frame, tree.body(_link(element, 'child'), moving))
            )
            frame = np.eye(4)
    _check_masses(chain)
    return Chain(base, tip, tuple(chain), frame)


def placement_of(text: str, link: str) -> np.ndarray:
    """Return the frame (4, 4) of a link in that of the root, with all joints between at zero.

    Raises:
        BlfDscError: the text is no URDF, or has no such link.
    """
    tree = Tree.of(text)
    frame = np.eye(4)
    for element in tree.path(tree.root, link):
        frame = product(frame, _origin(element))
    return frame


def _check_kind(joint: ET.Element) -> None:
    """Raise BlfDscError if a joint cannot be part of a chain."""
    name = joint.get('name', '')
    kind = joint.get('type')
    if kind not in (*_MOVING, 'fixed'):
        raise BlfDscError(
            f'joint {name!r} is {kind}; expected fixed, {_listed(_MOVING)}'
        )
    if joint.find('mimic') is not None:
        raise BlfDscError(
            f'joint {name!r} mimics another: choose a base and a tip without it'
        )


def _check_moving(
    moving: Sequence[str], wanted: Sequence[str], base: str, tip: str
) -> None:
    """Raise BlfDscError if no joint moves between base and tip, or others than wanted."""
    if not moving:
        raise BlfDscError(
            f'the moving joints from the base {base!r} to the tip {tip!r} are none: choose '
            'another base or tip'
        )
    if wanted and wanted != moving:
        raise BlfDscError(
            f'the moving joints from base to tip are {_listed(moving)}, in this order; got '
            f'{_listed(wanted)}: list them like this, or choose another base or tip'
        )


def _check_masses(joints: Sequence[Joint]) -> None:
    """Raise BlfDscError if a joint moves a body without a mass."""
    massless = [
        f'{joint.link} (moved by {joint.name})'
        for joint in joints
        if not joint.inertia[0]
    ]
    if massless:
        raise BlfDscError(
            f'these links have no mass, nor has anything fixed to them: {_listed(massless)}: add '
            'an <inertial> to each, even a rough one'
        )


def frames(chain: Chain, q: np.ndarray) -> list[np.ndarray]:
    """Return the placements (..., 4, 4), in the base frame, of the base, each joint and the tip.

    `q` is (..., n): one posture or an array of postures [rad or m].
    """
    placements = [np.broadcast_to(np.eye(4), (*q.shape[:-1], 4, 4))]
    for i, joint in enumerate(chain.joints):
        axis, position = joint.axis, q[..., i, None]
        motion = placements[0].copy()
        if joint.kind == 'prismatic':
            motion[..., :3, 3] = position * axis
        else:
            along = np.outer(axis, axis)
            c = np.cos(position)[..., None]
            s = np.sin(position)[..., None]
            motion[..., :3, :3] = (
                along + c * (np.eye(3) - along) + s * np.cross(np.eye(3), axis)
            )
        placements.append(placements[-1] @ joint.placement @ motion)
    return [*placements, placements[-1] @ chain.tip_placement]


class _Body(NamedTuple):
    """A link with everything that it carries at position 0."""

    J: np.ndarray  # pseudo-inertia (4, 4) of all
    held: np.ndarray  # of what a held joint carries
    fixed: tuple[str, ...]  # links that are fixed to it


class Tree(NamedTuple):
    """Links and joints of a URDF by name, and the joint above each link."""

    links: Mapping[str, ET.Element]
    joints: Mapping[str, ET.Element]
    above: Mapping[str, ET.Element]

    @classmethod
    def of(cls, text: str) -> Tree:
        """Read a URDF, in which each joint has its links, and no link two joints above it.

        Raises:
            BlfDscError: the text is no URDF, or its joints are no tree.
        """
        robot = _robot(text)
        links = _named(robot, 'link')
        joints = _named(robot, 'joint')
        above: dict[str, ET.Element] = {}
        second: dict[str, ET.Element] = {}
        for name, joint in joints.items():
            for role in ('parent', 'child'):
                if (link := _link(joint, role)) not in links:
                    raise BlfDscError(
                        f'joint {name!r} has the {role} {link!r}, but the links are '
                        f'{_listed(links)}: correct its <{role}>'
                    )
            if above.setdefault(link, joint) is not joint:
                second[link] = joint
        _check_tree(above, second)
        return cls(links, joints, above)

    @property
    def root(self) -> str:
        """The link that no joint carries; empty if each hangs below another."""
        return next((link for link in self.links if link not in self.above), '')

    def path(self, base: str, tip: str) -> list[ET.Element]:
        """Return the joints from the link `base` down to the link `tip`.

        Raises:
            BlfDscError: one is no link, or the tip is not below the base.
        """
        for role, link in (('base', base), ('tip', tip)):
            if link not in self.links:
                joint = self.joints.get(link)
                if joint is not None:
                    raise BlfDscError(
                        f'{link!r} is a joint, and the {role} is a link: give '
                        f'{_link(joint, "child" if role == "tip" else "parent")!r}'
                    )
                raise BlfDscError(
                    f'no link {link!r} for the {role}: the links are {_listed(self.links)}'
                    f'{self._meant(link)}'
                )
        path: list[ET.Element] = []
        link = tip
        while link != base:
            if link not in self.above or len(path) > len(self.joints):
                raise BlfDscError(
                    f'the path up from the tip {tip!r} ends at {link!r} without reaching the base '
                    f'{base!r}: choose a tip below the base'
                )
            path.insert(0, self.above[link])
            link = _link(path[0], 'parent')
        return path

    def _meant(self, link: str) -> str:
        """Return what may be meant by a link that is none."""
        if not self.links:
            return (
                ': a file without <link> is no URDF, but perhaps an SRDF; give another'
            )
        folded = {name.casefold(): name for name in self.links}
        close = difflib.get_close_matches(link.casefold(), folded, n=1)
        return f'; did you mean {folded[close[0]]!r}?' if close else ''

    def trunk(self) -> tuple[str, ...]:
        """Return the moving joints from the root to where they branch, as into fingers."""
        ends = [
            link for link, joint in self.above.items() if joint.get('type') in _MOVING
        ]
        paths = [_moving(self.path(self.root, end)) for end in ends]
        inner = {name for path in paths for name in path[:-1]}
        leaves = [path for path in paths if path[-1] not in inner]
        common = set.intersection(*map(set, leaves)) if leaves else set()
        return tuple(name for name in max(paths, key=len, default=()) if name in common)

    def limbs(self) -> tuple[str, ...]:
        """Return where the longest chains that do not branch end, such as the arms of a torso."""
        ends = {
            name: _link(joint, 'child')
            for name, joint in self.joints.items()
            if joint.get('type') in _MOVING
        }
        paths = {name: _moving(self.path(self.root, ends[name])) for name in ends}
        next_ones = Counter(path[-2] for path in paths.values() if len(path) > 1)
        lengths = {}
        for name, path in paths.items():
            if next_ones[name] != 1:
                inner = itertools.takewhile(
                    lambda each: next_ones[each] == 1, path[-2::-1]
                )
                lengths[name] = len([*inner])
        longest = max(lengths.values(), default=0)
        return tuple(ends[name] for name in lengths if lengths[name] == longest)

    def turning(self, joints: Sequence[str]) -> np.ndarray:
        """Return which of some joints turn (n,), the others being prismatic."""
        kinds = [self.joints[name].get('type') for name in joints]
        return np.array([kind != 'prismatic' for kind in kinds])

    def reaches(self, joints: Sequence[str]) -> np.ndarray:
        """Return the largest position (n,) of some joints, to either side [rad or m]."""
        ranges = [_range(self.joints[name]) for name in joints]
        return np.array([max(-lower, upper) for lower, upper in ranges])

    def velocities(self, joints: Sequence[str]) -> np.ndarray:
        """Return the velocity limits (n,) of some joints [rad/s or m/s]; inf: none is given."""
        limits = [self.joints[name].find('limit') for name in joints]
        return np.array([_number(limit, 'velocity') or inf for limit in limits])

    def only_chain(self) -> tuple[str, ...]:
        """Return the moving joints, which must be one chain.

        Raises:
            BlfDscError: no joint moves, or they branch.
        """
        moving = _moving([*self.joints.values()])
        if not moving:
            raise BlfDscError(
                f'no joint moves: {self._kinds()}. The joints of an arm are '
                f'{", ".join(_MOVING)}'
            )
        trunk = self.trunk()
        if len(trunk) < len(moving):
            such = ' or '.join(self.limbs()[:_MAX_KINDS])
            raise BlfDscError(
                'neither a tip nor joints were given, and the moving joints are not one chain: '
                f'{_shortened(moving)}. Set robot.tip to the last link of the arm, such as {such}'
            )
        return trunk

    def _kinds(self) -> str:
        kinds = [
            f'{name!r} is {joint.get("type") or "of no type"}'
            for name, joint in self.joints.items()
        ]
        return ', '.join(kinds[:_MAX_KINDS]) or 'there is none'

    def body(self, link: str, joints: Sequence[str]) -> _Body:
        """Return a link with all that it carries, where no other joint than `joints` moves.

        Raises:
            BlfDscError: it carries something by a floating or planar joint.
        """
        J = _link_inertia(self.links[link])
        held = np.zeros((4, 4))
        fixed: tuple[str, ...] = ()
        for name, joint in self.joints.items():
            if _link(joint, 'parent') != link or name in joints:
                continue
            kind = joint.get('type')
            child = _link(joint, 'child')
            if kind not in (*_MOVING, 'fixed'):
                raise BlfDscError(
                    f'joint {name!r} on {link!r} is {kind}: remove it from the URDF'
                )
            frame = _origin(joint)
            beyond = self.body(child, joints)
            J = J + moved(beyond.J, frame)
            held += moved(beyond.held if kind == 'fixed' else beyond.J, frame)
            fixed += (child, *beyond.fixed) if kind == 'fixed' else ()
        return _Body(J, held, fixed)


def _check_tree(
    above: Mapping[str, ET.Element], second: Mapping[str, ET.Element]
) -> None:
    """Raise BlfDscError if a link has a `second` joint above it, or is above itself."""
    only = 'only trees are read, such as serial arms: remove a joint without a motor'
    for link, joint in second.items():
        paths = [_ancestors(each, above) for each in (above[link], joint)]
        shared = [each for each in paths[0] if each in paths[1]]
        meet = shared or _link(paths[0][-1], 'parent') == _link(paths[1][-1], 'parent')
        loop = [each for path in paths for each in path[::-1] if each not in shared]
        problem = f'link {link!r} is the child of two joints'
        if meet:
            raise BlfDscError(f'{problem}, in a loop of {_edges(loop)}: {only}')
        raise BlfDscError(f'{problem}, {_edges([above[link], joint])}: {only}')
    for link, joint in above.items():
        loop = _ancestors(joint, above)
        if _link(loop[-1], 'parent') == link:
            raise BlfDscError(f'joints form a loop, {_edges(loop[::-1])}: {only}')


def _ancestors(joint: ET.Element, above: Mapping[str, ET.Element]) -> list[ET.Element]:
    """Return a joint and those above it, up to the root, or once around a loop."""
    path = [joint]
    while (parent := above.get(_link(path[-1], 'parent'))) is not None:
        if parent in path:
            break
        path.append(parent)
    return path


def _edges(joints: Sequence[ET.Element]) -> str:
    """Return joints with their links in words."""
    ends = [(_link(each, 'parent'), _link(each, 'child')) for each in joints]
    names = [each.get('name', '') for each in joints]
    return _shortened(
        [f'{name!r} ({a!r} to {b!r})' for name, (a, b) in zip(names, ends, strict=True)]
    )


def _robot(text: str) -> ET.Element:
    """Return the root element of a URDF."""
    expand = (
        'expand it first: `xacro FILE > robot.urdf` (from ROS or `pip install xacro`)'
    )
    try:
        robot = parse_xml(text)
    except XmlError as error:
        hint = ''
        if '<html' in text[:1000].lower():
            hint = '; it is a web page: download the file that it shows'
        elif 'declaration not at start' in str(error):
            hint = ': remove what is above its <?xml'
        elif not text.rstrip().endswith('</robot>'):
            hint = '; it does not end with </robot>: if it was cut off, copy it again'
        elif '<xacro:' in text:
            hint = f'; this looks like xacro, {expand}'
        raise BlfDscError(
            f'not a URDF, as it is not valid XML: {error}{hint}'
        ) from error
    for element in robot.iter():
        if 'xacro' in element.tag or any(
            '${' in value for value in element.attrib.values()
        ):
            raise BlfDscError(f'<{element.tag}> is xacro, not URDF: {expand}')
    if robot.tag != 'robot':
        raise BlfDscError(
            f'the root of a URDF is <robot>, not <{robot.tag}>: give another file'
        )
    return robot


def _moving(path: Sequence[ET.Element]) -> tuple[str, ...]:
    return tuple(
        str(joint.get('name')) for joint in path if joint.get('type') in _MOVING
    )


def _named(robot: ET.Element, tag: str) -> dict[str, ET.Element]:
    """Return the elements with a tag by name."""
    elements = robot.findall(tag)
    if len(elements) > _MAX_ELEMENTS:
        raise BlfDscError(
            f'the URDF has {len(elements)} {tag}s; at most {_MAX_ELEMENTS} can be read'
        )
    named = {element.get('name', ''): element for element in elements}
    if len(named) < len(elements):
        counts = Counter(element.get('name', '') for element in elements)
        name, count = counts.most_common(1)[0]
        raise BlfDscError(
            f'each {tag} needs a unique name; got {name!r} {count} times: rename all but one'
        )
    return named


def _joint(element: ET.Element, placement: np.ndarray, body: _Body) -> Joint:
    name = element.get('name', '')
    kind = element.get('type', '')
    axis = _numbers(element.find('axis'), 'xyz', '1 0 0')
    length = float(np.sqrt((axis**2).sum()))
    if length < _SHORTEST:
        raise BlfDscError(
            f'the axis of joint {name!r} is zero: write a direction such as 0 0 1'
        )
    limit = element.find('limit')
    for key in ('velocity', 'effort', *_ACCELERATIONS):
        if (value := _number(limit, key)) < 0.0:
            raise BlfDscError(
                f'joint {name!r} has <limit {key}="{value:g}">: it is a magnitude, so give '
                f'{-value:g}, or 0 if it is unknown'
            )
    lower, upper = _range(element)
    dynamics = element.find('dynamics')
    return Joint(
        name=name,
        kind=kind,
        placement=placement,
        axis=axis / length,
        lower=lower,
        upper=upper,
        velocity=_number(limit, 'velocity') or inf,
        effort=_number(limit, 'effort') or inf,
        damping=_number(dynamics, 'damping'),
        friction=_number(dynamics, 'friction'),
        link=_link(element, 'child'),
        inertia=inertia_of(body.J),
        fixed=body.fixed,
        held=body.held,
        acceleration=min(_number(limit, key) or inf for key in _ACCELERATIONS),
        soft_limits=_soft_limits(element),
    )


def _range(element: ET.Element) -> tuple[float, float]:
    """Return the position limits of a joint, within those of its <safety_controller>."""
    name = element.get('name', '')
    limit = element.find('limit')
    if element.get('type') == 'continuous' or limit is None:
        return -inf, inf
    lower = _number(limit, 'lower')
    upper = _number(limit, 'upper')
    if lower >= upper:
        raise BlfDscError(
            f'joint {name!r} has an empty range, {lower:g} to {upper:g}: correct its <limit>'
        )
    soft = element.find('safety_controller')
    if soft is None or not {'soft_lower_limit', 'soft_upper_limit'} <= {*soft.attrib}:
        return lower, upper
    soft_lower = max(lower, _number(soft, 'soft_lower_limit'))
    soft_upper = min(upper, _number(soft, 'soft_upper_limit'))
    if soft_lower >= soft_upper:
        raise BlfDscError(
            f'joint {name!r} has an empty range, {soft_lower:g} to {soft_upper:g}: correct its '
            '<safety_controller>'
        )
    return soft_lower, soft_upper


def _soft_limits(element: ET.Element) -> tuple[float, float]:
    """Return k_position and k_velocity of the <safety_controller>; infinite: none."""
    soft = element.find('safety_controller')
    k_position, k_velocity = (
        abs(_number(soft, key)) or inf for key in ('k_position', 'k_velocity')
    )
    return k_position, k_velocity


def _link_inertia(link: ET.Element) -> np.ndarray:
    """Return the pseudo-inertia (4, 4) of a link in its own frame."""
    inertial = link.find('inertial')
    if inertial is None:
        return np.zeros((4, 4))
    tensor = inertial.find('inertia')
    entries = [
        _number(tensor, key) for key in ('ixx', 'ixy', 'iyy', 'ixz', 'iyz', 'izz')
    ]
    mass = _number(inertial.find('mass'), 'value')
    J = pseudo_inertia(np.array([mass, 0.0, 0.0, 0.0, *entries]))
    moments = np.linalg.eigvalsh(rotational_inertia(J))
    if mass < 0.0 or moments[0] < -max(1e-9 * moments[-1], _ROUNDED):
        figures = _listed(f'{moment:.3g}' for moment in moments)
        raise BlfDscError(
            f'link {link.get("name")!r} has a mass of {mass:g} kg and principal moments of inertia '
            f'of {figures} kg m^2: none can be negative; correct its <inertial>'
        )
    return moved(J, _origin(inertial))


def _origin(element: ET.Element) -> np.ndarray:
    """Return the placement (4, 4) of an <origin>: roll, pitch, yaw about fixed axes, then xyz.

    URDF 1.1 may have a quaternion `quat_xyzw` instead.
    """
    origin = element.find('origin')
    frame = np.eye(4)
    frame[:3, 3] = _numbers(origin, 'xyz', '0 0 0')
    if origin is not None and 'quat_xyzw' in origin.attrib:
        frame[:3, :3] = _rotation(origin)
        return frame
    for k, angle in enumerate(_numbers(origin, 'rpy', '0 0 0')):
        i, j = (k + 1) % 3, (k + 2) % 3
        turn = np.eye(3)
        turn[i, i] = turn[j, j] = cos(angle)
        turn[i, j], turn[j, i] = -sin(angle), sin(angle)
        frame[:3, :3] = product(turn, frame[:3, :3])
    return frame


def _rotation(origin: ET.Element) -> np.ndarray:
    """Return the rotation (3, 3) of the quaternion of an <origin>."""
    if 'rpy' in origin.attrib:
        raise BlfDscError('an <origin> has both rpy and quat_xyzw: remove one of them')
    quaternion = _numbers(origin, 'quat_xyzw', '0 0 0 1', 4)
    length = float(np.sqrt((quaternion**2).sum()))
    if length < _SHORTEST:
        raise BlfDscError(
            f'<origin quat_xyzw="{origin.get("quat_xyzw")}">: a quaternion of no length has no '
            'direction'
        )
    x, y, z, w = quaternion / length
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
            [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
            [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def _link(joint: ET.Element, role: str) -> str:
    element = joint.find(role)
    return '' if element is None else element.get('link', '')


def _number(element: ET.Element | None, key: str) -> float:
    return float(_numbers(element, key, '0', 1)[0])


def _numbers(
    element: ET.Element | None, key: str, default: str, count: int = 3
) -> np.ndarray:
    if element is None:
        element = ET.Element('')
    text = element.get(key, default)
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    largest = float_info.max if key in _LIMITS else _LARGEST
    if len(numbers) != count or not all(abs(number) <= largest for number in numbers):
        raise BlfDscError(
            f'<{element.tag} {key}="{text}">: expected {count} finite number(s) of at most '
            f'{largest:g} in magnitude{_comma_hint(text)}'
        )
    return np.array(numbers)


def _comma_hint(text: str) -> str:
    """Return what to write instead of numbers with a comma; or empty."""
    is_between = re.search(r'\d,\d', text)
    return ': write decimal points, and spaces between numbers' if is_between else ''


def _listed(names: Iterable[object]) -> str:
    return ', '.join(map(str, names)) or 'none'


def _shortened(names: Sequence[str]) -> str:
    """Return the first of many names, and how many follow."""
    more = len(names) - _MAX_NAMES
    return _listed(names[:_MAX_NAMES]) + (f' and {more} more' if more > 0 else '')
