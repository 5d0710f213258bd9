# SPDX-License-Identifier: Apache-2.0
"""An arm from MJCF: MuJoCo's compiler reads it, a URDF says what it found.

The compiler resolves includes, defaults, classes, angles and frames, so that a
configuration holds one text that replays without MuJoCo and without the files of the
arm.  Geometry is left out.  What a URDF has no place for stands in the attributes and
elements of `description`: the armature of a joint, gravity at a link, and why a joint
cannot be part of a serial chain.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator
from functools import lru_cache
from math import atan2, hypot, inf
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from blf_dsc_controller.configuration.description import (
    ARMATURE,
    GRAVITY,
    REASON,
    UNSUPPORTED,
)
from blf_dsc_controller.configuration.files import read_text
from blf_dsc_controller.configuration.mjcf_limits import check_size
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.extras import install_command

Floats: TypeAlias = np.ndarray

_INSTALL = f'{install_command("mujoco")} (or pip install mujoco)'
# the first element, after declaration and comments
_ROOT = re.compile(r'\s*(?:<\?.*?\?>\s*|<!--.*?-->\s*)*<([\w:.-]+)', re.DOTALL)


def is_mjcf(text: str) -> bool:
    """Return whether the root element of an XML text is <mujoco>."""
    root = _ROOT.match(text)
    return root is not None and root[1] == 'mujoco'


def urdf_of_file(path: Path) -> str:
    """Return the URDF of an MJCF file.

    Raises BlfDscError, with the file and the element, if MuJoCo is missing or cannot
    compile it.
    """
    check_size(read_text(path), path.parent, str(path))
    return _urdf(_model(path, str(path)))


@lru_cache(maxsize=16)
def urdf_of_text(text: str) -> str:
    """Return the URDF of MJCF text, as `urdf_of_file` does.

    It can include absolute paths only.
    """
    name = 'the MJCF text'
    check_size(text, None, name)
    return _urdf(_model(text, name))


def _model(source: str | Path, name: str) -> Any:
    """Return the compiled model (`mujoco.MjModel`) of a file or a text."""
    try:
        import mujoco
    except ImportError as error:
        raise BlfDscError(f'{name} is MJCF, which MuJoCo reads: {_INSTALL}') from error
    try:
        if isinstance(source, Path):
            spec = mujoco.MjSpec.from_file(str(source))
        else:
            spec = mujoco.MjSpec.from_string(source)
        _remove_shapes(spec)
        return spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        reason = ' '.join(str(error).split())
        raise BlfDscError(
            f'{name}: MuJoCo cannot compile it: {reason}. Correct that element, or check the '
            'file with `python -m mujoco.viewer --mjcf=FILE`'
        ) from error


def _remove_shapes(spec: Any) -> None:
    """Remove shapes that inertias do not depend on: their files need not exist."""
    import mujoco

    from_shapes = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    if spec.compiler.inertiafromgeom == from_shapes or spec.flexes:
        return
    for unused in (*spec.sensors, *spec.pairs, *spec.skins):
        spec.delete(unused)
    for body in spec.bodies:
        if body.explicitinertial or not _is_carried(body):
            for geom in tuple(body.geoms):
                spec.delete(geom)
    left = {geom.meshname for geom in spec.geoms}
    for mesh in tuple(spec.meshes):
        if mesh.name not in left:
            spec.delete(mesh)
    for shown in (*spec.geoms, *spec.sites, *spec.tendons):
        shown.material = ''
    for unused in (*spec.materials, *spec.textures):
        spec.delete(unused)


def _is_carried(body: Any) -> bool:
    """Return whether a joint moves the body."""
    while body is not None:
        if len(body.joints):
            return True
        body = body.parent
    return False


def _urdf(model: Any) -> str:
    """Return the URDF of a compiled model."""
    root = ET.Element('robot', name=model.names[:].split(b'\0')[0].decode() or 'arm')
    root.append(ET.Comment(' written from MJCF: doc/arms.md '))
    _Writer(model, root).write()
    ET.indent(root)
    return ET.tostring(root, encoding='unicode') + '\n'


class _Writer:
    """Bodies become links, in the frame of their last joint.

    A body with several joints becomes as many links.

    Positions are those of MuJoCo's joints (`qpos`), so that 0 is 0 whatever the `ref`
    of a joint.
    """

    def __init__(self, model: Any, root: ET.Element) -> None:
        import mujoco

        self._mujoco = mujoco
        self._model = model
        self._root = root
        self._reasons = dict(_unsupported(model))
        self._gravity = np.array(model.opt.gravity)
        self._names = [model.body(i).name or f'body{i}' for i in range(model.nbody)]
        self._residual: list[Floats] = [np.eye(4)]  # of each body in its link
        self._world: list[Floats] = [np.eye(4)]  # placement of each link, at 0

    def write(self) -> None:
        """Add links and joints of all bodies, then their sites."""
        self._add_link(self._names[0], self._world[0])
        for body in range(1, self._model.nbody):
            self._add_body(body)
        taken = set(self._names)
        for i in range(self._model.nsite):
            name = self._model.site(i).name
            if name and name not in taken:
                taken.add(name)
                self._add_site(i, name)

    def _add_body(self, body: int) -> None:
        model = self._model
        parent = int(model.body_parentid[body])
        link = self._names[parent]
        world = self._world[parent]
        pending = self._residual[parent] @ _placement(
            model.body_pos[body], model.body_quat[body]
        )
        first = int(model.body_jntadr[body])
        count = int(model.body_jntnum[body])
        last = first + count - 1
        for joint in range(first, last + 1) if first >= 0 else ():
            anchor = _shift(model.jnt_pos[joint])
            origin = pending @ anchor @ self._zero(joint)
            child = self._names[body]
            if joint < last:  # massless: `read_chain` refuses it by this name
                child += f': joint {joint - first + 1} of {count} in one body'
            world = world @ origin
            self._add_joint(joint, link, child, origin)
            self._add_link(child, world)
            pending = _shift(-model.jnt_pos[joint])
            link = child
        if first < 0:
            child = self._names[body]
            world = world @ pending
            self._add_fixed(f'{child} on {link}', link, child, pending)
            pending = np.eye(4)
            self._add_link(child, world)
        self._residual.append(pending)
        self._world.append(world)
        self._add_inertial(body)

    def _zero(self, joint: int) -> Floats:
        """Return the motion (4, 4) of a joint from its place in the file to 0."""
        model = self._model
        motion = np.eye(4)
        kind = self._mujoco.mjtJoint(model.jnt_type[joint])
        start = -float(model.qpos0[model.jnt_qposadr[joint]])
        if kind == self._mujoco.mjtJoint.mjJNT_SLIDE:
            motion[:3, 3] = start * model.jnt_axis[joint]
        elif kind == self._mujoco.mjtJoint.mjJNT_HINGE and start:
            quaternion = np.zeros(4)
            self._mujoco.mju_axisAngle2Quat(quaternion, model.jnt_axis[joint], start)
            motion = _placement(np.zeros(3), quaternion)
        return motion

    def _add_link(self, name: str, world: Floats) -> None:
        gravity = _words(world[:3, :3].T @ self._gravity)
        ET.SubElement(self._root, 'link', {'name': name, GRAVITY: gravity})

    def _add_inertial(self, body: int) -> None:
        model = self._model
        if not model.body_mass[body]:
            return
        link = self._root.findall('link')[-1]
        inertial = ET.SubElement(link, 'inertial')
        axes = _placement(model.body_ipos[body], model.body_iquat[body])
        _add_origin(inertial, self._residual[body] @ axes)
        ET.SubElement(inertial, 'mass', value=_words([model.body_mass[body]]))
        moments = [_words([moment]) for moment in model.body_inertia[body]]
        tensor = dict(zip(('ixx', 'iyy', 'izz'), moments, strict=True))
        ET.SubElement(
            inertial, 'inertia', tensor | dict.fromkeys(('ixy', 'ixz', 'iyz'), '0')
        )

    def _add_site(self, site: int, name: str) -> None:
        model = self._model
        body = int(model.site_bodyid[site])
        link = self._names[body]
        origin = self._residual[body] @ _placement(
            model.site_pos[site], model.site_quat[site]
        )
        self._add_fixed(f'{name} on {link}', link, name, origin)
        self._add_link(name, self._world[body] @ origin)

    def _add_fixed(self, name: str, parent: str, child: str, origin: Floats) -> None:
        element = ET.SubElement(self._root, 'joint', name=name, type='fixed')
        _add_origin(element, origin)
        ET.SubElement(element, 'parent', link=parent)
        ET.SubElement(element, 'child', link=child)

    def _add_joint(self, joint: int, parent: str, child: str, origin: Floats) -> None:
        model = self._model
        name = _joint_name(model, joint)
        limited = bool(model.jnt_limited[joint])
        kind = self._kind(joint, limited=limited)
        element = ET.SubElement(self._root, 'joint', name=name, type=kind)
        _add_origin(element, origin)
        ET.SubElement(element, 'parent', link=parent)
        ET.SubElement(element, 'child', link=child)
        if joint in self._reasons:
            ET.SubElement(element, UNSUPPORTED, {REASON: self._reasons[joint]})
        if kind in ('ball', 'free'):
            return
        ET.SubElement(element, 'axis', xyz=_words(model.jnt_axis[joint]))
        limits = {}
        if limited:
            lower, upper = model.jnt_range[joint]
            limits = {'lower': _words([lower]), 'upper': _words([upper])}
        effort = _effort(model, joint)
        if limited or kind == 'continuous':
            known = effort if effort < inf else 0.0
            ET.SubElement(
                element, 'limit', limits | {'effort': _words([known]), 'velocity': '0'}
            )
        damping, armature = _dynamics(model, joint)
        dof = model.jnt_dofadr[joint]
        ET.SubElement(
            element,
            'dynamics',
            {
                'damping': _words([damping]),
                'friction': _words([model.dof_frictionloss[dof]]),
                ARMATURE: _words([armature]),
            },
        )

    def _kind(self, joint: int, *, limited: bool) -> str:
        """Return the type in a URDF, or MuJoCo's word if no serial chain has it."""
        kinds = self._mujoco.mjtJoint
        kind = kinds(self._model.jnt_type[joint])
        if kind == kinds.mjJNT_HINGE:
            return 'revolute' if limited else 'continuous'
        if kind == kinds.mjJNT_SLIDE:
            return 'prismatic'
        return 'ball' if kind == kinds.mjJNT_BALL else 'free'


def _dynamics(model: Any, joint: int) -> tuple[float, float]:
    """Return damping and armature of a joint and, through gears, its actuators."""
    dof = model.jnt_dofadr[joint]
    damping = float(model.dof_damping[dof])
    armature = float(model.dof_armature[dof])
    for i in _actuators(model, joint):
        ratio = float(model.actuator_gear[i, 0]) ** 2
        damping += ratio * float(model.actuator_damping[i])
        armature += ratio * float(model.actuator_armature[i])
    return damping, armature


def _effort(model: Any, joint: int) -> float:
    """Return the torque [N m] or force [N] that joint and actuators allow.

    It is infinite where nothing limits it.
    """
    limit = inf
    if model.jnt_actfrclimited[joint]:
        limit = float(np.abs(model.jnt_actfrcrange[joint]).min()) or inf
    forces = [_force(model, i) for i in _actuators(model, joint)]
    return min(limit, sum(forces) if forces else inf) or inf


def _force(model: Any, actuator: int) -> float:
    """Return the largest force of an actuator at its joint; infinity: any."""
    import mujoco

    gear = abs(float(model.actuator_gear[actuator, 0]))
    if model.actuator_forcelimited[actuator]:
        return gear * float(np.abs(model.actuator_forcerange[actuator]).min())
    control = model.actuator_ctrladr[actuator]
    is_motor = (
        mujoco.mjtGain(model.actuator_gaintype[actuator]) == mujoco.mjtGain.mjGAIN_FIXED
        and mujoco.mjtBias(model.actuator_biastype[actuator])
        == mujoco.mjtBias.mjBIAS_NONE
    )
    if not is_motor or not model.actuator_ctrllimited[control]:
        return inf
    gain = abs(float(model.actuator_gainprm[actuator, 0]))
    return gear * gain * float(np.abs(model.actuator_ctrlrange[control]).min())


def _actuators(model: Any, joint: int) -> list[int]:
    """Return the actuators at a joint."""
    import mujoco

    at_joint = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    return [
        i
        for i in range(model.nu)
        if mujoco.mjtTrn(model.actuator_trntype[i]) in at_joint
        and model.actuator_trnid[i, 0] == joint
    ]


def _unsupported(model: Any) -> Iterator[tuple[int, str]]:
    """Yield joints with the reason why they cannot be part of a serial chain."""
    for joint in range(model.njnt):
        dof = model.jnt_dofadr[joint]
        if model.jnt_stiffness[joint] or np.any(model.jnt_stiffnesspoly[joint]):
            yield (
                joint,
                (
                    f'it has a spring, stiffness="{model.jnt_stiffness[joint]:g}": no model here '
                    'has springs'
                ),
            )
        if np.any(model.dof_dampingpoly[dof]):
            yield joint, 'its damping is a polynomial: only linear damping is modelled'
    for i in range(model.neq):
        if model.eq_active0[i]:
            what = f'<equality> {_named(model.eq(i).name, i)}'
            for joint in _of_equality(model, i):
                yield joint, f'{what} couples it: closed chains are not supported'
    for i in _acting_tendons(model):
        what = f'<tendon> {_named(model.tendon(i).name, i)}'
        for joint in _of_tendon(model, i):
            yield joint, f'{what} acts on it: tendons are not supported'


def _of_equality(model: Any, equality: int) -> Iterable[int]:
    """Return the joints that an equality couples: of a loop, all along it."""
    import mujoco

    kind = mujoco.mjtEq(model.eq_type[equality])
    ends = [int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])]
    kinds = mujoco.mjtEq
    if kind == kinds.mjEQ_JOINT:
        return [end for end in ends if end >= 0]
    if kind == kinds.mjEQ_TENDON:
        return [joint for end in ends if end >= 0 for joint in _of_tendon(model, end)]
    if kind in (kinds.mjEQ_CONNECT, kinds.mjEQ_WELD):
        if mujoco.mjtObj(model.eq_objtype[equality]) == mujoco.mjtObj.mjOBJ_SITE:
            ends = [int(model.site_bodyid[end]) for end in ends]
        return _between(model, *ends)
    return ()


def _acting_tendons(model: Any) -> Iterator[int]:
    """Yield the tendons that exert forces; others only measure."""
    import mujoco

    actuated = {
        int(model.actuator_trnid[i, 0])
        for i in range(model.nu)
        if mujoco.mjtTrn(model.actuator_trntype[i]) == mujoco.mjtTrn.mjTRN_TENDON
    }
    for i in range(model.ntendon):
        acts = (
            model.tendon_stiffness[i],
            model.tendon_damping[i],
            model.tendon_frictionloss[i],
            model.tendon_armature[i],
            model.tendon_limited[i],
        )
        if i in actuated or any(acts):
            yield i


def _of_tendon(model: Any, tendon: int) -> set[int]:
    """Return the joints along a tendon."""
    import mujoco

    kinds = mujoco.mjtWrap
    found: set[int] = set()
    bodies: list[int] = []
    first = int(model.tendon_adr[tendon])
    for i in range(first, first + int(model.tendon_num[tendon])):
        at = int(model.wrap_objid[i])
        kind = kinds(model.wrap_type[i])
        if kind == kinds.mjWRAP_JOINT:
            found.add(at)
        elif kind == kinds.mjWRAP_SITE:
            bodies.append(int(model.site_bodyid[at]))
        elif kind in (kinds.mjWRAP_SPHERE, kinds.mjWRAP_CYLINDER):
            bodies.append(int(model.geom_bodyid[at]))
    for body in bodies[1:]:
        found |= _between(model, bodies[0], body)
    return found


def _between(model: Any, body: int, other: int) -> set[int]:
    """Return the joints on the way from a body to another."""
    return _above(model, body) ^ _above(model, other)


def _above(model: Any, body: int) -> set[int]:
    """Return the joints from the world to a body."""
    found: set[int] = set()
    while body:
        first = int(model.body_jntadr[body])
        found |= set(range(first, first + int(model.body_jntnum[body])))
        body = int(model.body_parentid[body])
    return found


def _joint_name(model: Any, joint: int) -> str:
    name = model.joint(joint).name
    return name or f'joint of {model.body(model.jnt_bodyid[joint]).name}'


def _named(name: str, index: int) -> str:
    return repr(name) if name else f'number {index + 1}'


def _placement(position: Floats, quaternion: Floats) -> Floats:
    """Return the placement (4, 4) of a position [m] and a quaternion (w, x, y, z)."""
    import mujoco

    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, quaternion)
    placement = _shift(position)
    placement[:3, :3] = rotation.reshape(3, 3)
    return placement


def _shift(position: Floats) -> Floats:
    placement = np.eye(4)
    placement[:3, 3] = position
    return placement


def _add_origin(element: ET.Element, placement: Floats) -> None:
    """Add an <origin>: roll, pitch and yaw about fixed axes.

    A pitch of 90 degrees is exact as well.
    """
    R = placement[:3, :3]
    yaw = atan2(R[1, 0], R[0, 0])
    across = np.array([-np.sin(yaw), np.cos(yaw), 0.0])  # y after the yaw
    roll = atan2(-across @ R[:, 2], across @ R[:, 1])
    pitch = atan2(-R[2, 0], hypot(R[0, 0], R[1, 0]))
    rpy = _words([roll, pitch, yaw])
    ET.SubElement(element, 'origin', xyz=_words(placement[:3, 3]), rpy=rpy)


def _words(numbers: Iterable[float]) -> str:
    return ' '.join(repr(float(number) + 0.0) for number in numbers)
