# SPDX-License-Identifier: Apache-2.0
"""The arm as drawn on the page: the shapes of its URDF, else known meshes, else cylinders."""

from __future__ import annotations

import copy
import io
import logging
import sysconfig
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from blf_dsc_controller.arms.two_link import urdf
from blf_dsc_controller.arms.urdf import Chain, read_chain
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.files import resolve
from blf_dsc_controller.errors import BlfDscError

_THICKNESS = 0.025  # radius of a link relative to the length of all links
_SHORTEST = 1e-3  # m, length below which a link is not drawn
_SAME = 1e-3  # m and of rotation matrices, between two URDFs of the same arm


class ShownArm(NamedTuple):
    """The text of a URDF and the chain of its controlled joints."""

    text: str
    chain: Chain

    @property
    def reach(self) -> float:
        """Total length of all links [m]."""
        offsets = [joint.placement[:3, 3] for joint in self.chain.joints]
        steps = np.array([*offsets, self.chain.tip_placement[:3, 3]])
        return float(np.linalg.norm(steps, axis=1).sum())

    def model(self) -> Any:
        """Return the yourdfpy model with the first shapes found: meshes, others, cylinders."""
        has_meshes = '<mesh' in self.text
        model = _load(self.text if has_meshes else with_known_meshes(self.text, self.chain))
        return model if model.scene.geometry else _load(with_cylinders(self.text, self.reach))


def arm_of(config: ControllerConfig, plant: Mapping[str, Any]) -> ShownArm:
    """Return the arm of a controller; planar links have the lengths of its plant, if known."""
    robot = config.robot
    if config.model == 'urdf':
        return ShownArm(robot.text, robot.chain(config.joints))
    lengths = [plant.get(name, config.arm.l1) for name in ('arm.l1', 'arm.l2')]
    text = with_cylinders(urdf('arm', config.joints, lengths, (1.0, 1.0), (0.0, 0.0)), sum(lengths))
    return ShownArm(text, read_chain(text, '', 'tip', config.joints))


def with_known_meshes(text: str, chain: Chain) -> str:
    """Draw an arm as the wheel `example-robot-data` does, if it has one with these joints."""
    names = tuple(joint.name for joint in chain.joints)
    for path in sorted(_installed('example-robot-data').glob('robots/*/urdf/*.urdf')):
        known = path.read_text(encoding='utf-8')
        if not all(f'"{name}"' in known for name in names):
            continue
        with suppress(BlfDscError):
            joints = read_chain(known, '', chain.joints[-1].link, names).joints
            pairs = zip(joints, chain.joints, strict=True)
            if all(np.allclose(a.placement, b.placement, atol=_SAME) for a, b in pairs):
                return _with_visuals(text, known)
    return text


def _with_visuals(text: str, known: str) -> str:
    robot, source = ET.fromstring(text), ET.fromstring(known)  # noqa: S314 - as trusted as the robot
    visuals = {link.get('name'): link.findall('visual') for link in source.findall('link')}
    for link in robot.findall('link'):
        found = visuals.get(link.get('name'))
        for own in link.findall('visual') if found else ():
            link.remove(own)
        link.extend(copy.deepcopy(found or []))
    return ET.tostring(robot, encoding='unicode')


def _installed(package: str) -> Path:
    """Return the folder of a description that is installed as a wheel."""
    return Path(sysconfig.get_path('purelib'), 'cmeel.prefix', 'share', package)


def with_cylinders(text: str, reach: float) -> str:
    """Replace a URDF's visuals: a cylinder between joints, a ball at each joint that moves."""
    robot = ET.fromstring(text)  # noqa: S314 - as trusted as the robot that it describes
    links = {link.get('name'): link for link in robot.findall('link')}
    for link in links.values():
        for visual in link.findall('visual'):
            link.remove(visual)
    radius = _THICKNESS * reach
    for joint in robot.findall('joint'):
        ends = {role: links[joint.find(role).get('link')] for role in ('parent', 'child')}  # type: ignore[union-attr]
        if joint.get('type') != 'fixed':
            _add(ends['child'], (0.0, 0.0, 0.0), '0 0 0', 'sphere', radius=f'{1.6 * radius}')
        origin = joint.find('origin')
        xyz = [float(x) for x in ('' if origin is None else origin.get('xyz', '')).split()]
        length = float(np.linalg.norm(xyz))
        if length > _SHORTEST:
            x, y, z = xyz
            rpy = f'0 {np.arccos(z / length)} {np.arctan2(y, x)}'
            size = {'radius': f'{radius}', 'length': f'{length}'}
            _add(ends['parent'], (x / 2, y / 2, z / 2), rpy, 'cylinder', **size)
    return ET.tostring(robot, encoding='unicode')


def _add(link: ET.Element, at: Sequence[float], rpy: str, shape: str, **size: str) -> None:
    visual = ET.SubElement(link, 'visual')
    ET.SubElement(visual, 'origin', xyz=' '.join(map(str, at)), rpy=rpy)
    ET.SubElement(ET.SubElement(visual, 'geometry'), shape, size)


def _load(text: str) -> Any:
    import yourdfpy

    logging.getLogger('yourdfpy').setLevel(logging.ERROR)  # it warns about missing meshes
    model = yourdfpy.URDF.load(io.BytesIO(text.encode()), filename_handler=_file)
    for joint in model.robot.joints:
        if joint.axis is not None:  # yourdfpy scales prismatic motion by its length
            joint.axis = joint.axis / np.linalg.norm(joint.axis)
    return model


def _file(fname: str) -> str:  # yourdfpy prescribes the argument's name
    with suppress(BlfDscError, OSError):
        return str(resolve(fname.removeprefix('file://')))
    package, _, rest = fname.removeprefix('package://').partition('/')
    return str(_installed(package) / rest)
