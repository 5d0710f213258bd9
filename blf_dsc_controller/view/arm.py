# SPDX-License-Identifier: Apache-2.0
"""The arm as drawn on the page: the shapes of its URDF, else known meshes, else cylinders."""

from __future__ import annotations

import io
import logging
import sysconfig
from collections.abc import Mapping
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
        model = _load(self.text if has_meshes else known_model(self.text, self.chain))
        if not model.scene.geometry:
            _add_cylinders(model, _THICKNESS * self.reach)
        return model


def arm_of(config: ControllerConfig, plant: Mapping[str, Any]) -> ShownArm:
    """Return the arm of a controller; planar links have the lengths of its plant, if known."""
    robot = config.robot
    if config.model == 'urdf':
        return ShownArm(robot.text, robot.chain(config.joints))
    lengths = [plant.get(name, config.arm.l1) for name in ('arm.l1', 'arm.l2')]
    text = urdf('arm', config.joints, lengths, (1.0, 1.0), (0.0, 0.0))
    return ShownArm(text, read_chain(text, '', 'tip', config.joints))


def known_model(text: str, chain: Chain) -> str:
    """Return the URDF with meshes that the wheel `example-robot-data` has of an arm, else its own.

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
    """Draw a cylinder of this radius [m] between joints, a ball at each joint that moves."""
    import trimesh

    def add(shape: Any, joint: str, link: str) -> None:
        name = f'{joint} {link}'
        model.scene.add_geometry(shape, node_name=name, geom_name=name, parent_node_name=link)

    for joint in model.robot.joints:
        end = model.get_transform(joint.child, joint.parent)[:3, 3]
        if np.linalg.norm(end) > _SHORTEST:
            cylinder = trimesh.creation.cylinder(radius, segment=(np.zeros(3), end))
            add(cylinder, joint.name, joint.parent)
        if joint.type != 'fixed':
            add(trimesh.creation.icosphere(radius=1.6 * radius), joint.name, joint.child)


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
