# SPDX-License-Identifier: Apache-2.0
"""The arm on the page: the shapes of its URDF, else known meshes, else cylinders."""

from __future__ import annotations

import io
import logging
import sysconfig
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from contextlib import suppress
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from blf_dsc_controller.arms.two_link import urdf
from blf_dsc_controller.arms.urdf import Chain, read_chain
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.files import resolve
from blf_dsc_controller.configuration.two_link import two_link
from blf_dsc_controller.errors import BlfDscError

_THICKNESS = 0.025  # radius of a link relative to the length of all links
_SHORTEST = 1e-3  # m, length below which a link is not drawn
_SAME = 1e-3  # m and of rotation matrices, between two URDFs of the same arm
_MESHES = ('.stl', '.dae', '.obj', '.ply', '.off', '.glb', '.gltf')
_LARGEST_MESH = 1 << 28  # bytes


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
        """Return the yourdfpy model with meshes, else other shapes, else cylinders."""
        has_meshes = '<mesh' in self.text
        model = _load(self.text if has_meshes else known_model(self.text, self.chain))
        if not model.scene.geometry:
            _add_cylinders(model, _THICKNESS * self.reach)
        return model


def arm_of(config: ControllerConfig, plant: Mapping[str, Any]) -> ShownArm:
    """Return the arm of a controller.

    Planar links have the lengths of its plant, if known.
    """
    robot = config.robot
    if config.model == 'urdf':
        return ShownArm(robot.text, robot.chain(config.joints))
    given = [plant.get(name) for name in ('arm.l1', 'arm.l2')]
    lengths = [
        each if isinstance(each, float) and isfinite(each) else two_link(config).l1
        for each in given
    ]
    text = urdf(config.joints, lengths, (1.0, 1.0))
    return ShownArm(text, read_chain(text, '', 'tip', config.joints))


def known_model(text: str, chain: Chain) -> str:
    """Return the URDF with the meshes of `example-robot-data`, else its own.

    The same arm has the same joints, in the same places.
    """
    names = tuple(joint.name for joint in chain.joints)
    for path in sorted(_installed('example-robot-data').glob('robots/*/urdf/*.urdf')):
        known = path.read_text(encoding='utf-8')
        if not all(f'"{name}"' in known for name in names):
            continue
        with suppress(BlfDscError):
            joints = read_chain(known, chain.base, chain.joints[-1].link, names).joints
            pairs = zip(joints, chain.joints, strict=True)
            if all(np.allclose(a.placement, b.placement, atol=_SAME) for a, b in pairs):
                return known
    return text


def _installed(package: str) -> Path:
    """Return the folder of a description that is installed as a wheel."""
    return Path(sysconfig.get_path('purelib'), 'cmeel.prefix', 'share', package)


def _add_cylinders(model: Any, radius: float) -> None:
    """Draw a cylinder of this radius [m] between joints, a ball at each joint."""
    import trimesh

    def add(shape: Any, joint: str, link: str) -> None:
        name = f'{joint} {link}'
        model.scene.add_geometry(
            shape, node_name=name, geom_name=name, parent_node_name=link
        )

    for joint in model.robot.joints:
        end = model.get_transform(joint.child, joint.parent)[:3, 3]
        if np.linalg.norm(end) > _SHORTEST:
            cylinder = trimesh.creation.cylinder(radius, segment=(np.zeros(3), end))
            add(cylinder, joint.name, joint.parent)
        if joint.type != 'fixed':
            add(
                trimesh.creation.icosphere(radius=1.6 * radius), joint.name, joint.child
            )


def _load(text: str) -> Any:
    import yourdfpy

    # it warns about missing meshes
    logging.getLogger('yourdfpy').setLevel(logging.ERROR)
    # As `read_chain` has understood it: of another encoding that the text declares,
    # another parser would make entities of a comment.
    root = ET.fromstring(text)  # noqa: S314 - `read_chain` has accepted it
    try:
        model = yourdfpy.URDF.load(
            io.BytesIO(ET.tostring(root)), filename_handler=_mesh
        )
    except Exception as error:  # its libraries raise nearly anything
        raise BlfDscError(f'the arm cannot be drawn: {error!r}') from error
    for joint in model.robot.joints:
        if joint.axis is not None:  # yourdfpy scales prismatic motion by its length
            joint.axis = joint.axis / np.linalg.norm(joint.axis)
    return model


def _mesh(fname: str) -> str:  # yourdfpy prescribes the argument's name
    """Return the path of a mesh, empty if the file is none: it is a stranger who names it."""
    path = _file(fname)
    with suppress(OSError):
        if path.suffix.lower() in _MESHES and path.stat().st_size <= _LARGEST_MESH:
            return str(path)
    return ''


def _file(name: str) -> Path:
    with suppress(BlfDscError, OSError):
        return resolve(name.removeprefix('file://'))
    package, _, rest = name.removeprefix('package://').partition('/')
    return _installed(package) / rest
