# SPDX-License-Identifier: Apache-2.0
"""The arm with the mechanics of MuJoCo (`physics: mujoco`), as a plant like ours.

Encoders, drives and the schedule of events are those of `Plant`, all mechanics are
MuJoCo's: it reads the description of the arm itself, and integrates by RK4 with the
torque held over a sample.  Its Coulomb friction is dry.  Nothing collides.

With springs, or a base that gives way, MuJoCo has base and links (M, C dq + G and the
Jacobian of the tip); springs, motors, friction and the integration are those of
`sim_plant.elastic`.  Joint limits are not enforced then.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from blf_dsc_controller.arms.arm_alone import arm_alone
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.extras import import_extra
from sim_plant.elastic import PREDICT, SWING
from sim_plant.kernels import DRIVE, MOVE
from sim_plant.sampled_plant import Plant
from sim_plant.settings import plant_settings, true_rotors, urdf_of
from sim_plant.springs import CUBE, stiffness_of

PAYLOAD = 'payload of sim_plant'
"""Name of a body at the tip that has no mass but that of the payload."""
_BASE = 'base of sim_plant'
_PREFIX = 'arm/'
_TIP = 'tip'  # of the two links


class MujocoPlant(Plant):
    """A sampled arm in MuJoCo.

    Arrays are in the order of the parameter `joints`.

    Attributes:
        model, data: MuJoCo's.
    """

    def __init__(self, config: PlantConfig) -> None:
        """Build the arm of a configuration.

        Raises:
            BlfDscError: MuJoCo is missing, or cannot read the arm.
        """
        self._mujoco = import_extra('mujoco', 'mujoco', 'physics: mujoco')
        start = config.initial
        super().__init__(
            plant_settings(config), start.position, start.velocity, config.seed
        )
        self.model = model_of(config)
        self.data = self._mujoco.MjData(self.model)
        self._tip = self.model.body(PAYLOAD)
        self._origin, self._to_world = _pose_of_base(config, self.model)
        self._jacobian = np.zeros((3, self.model.nv))
        self._unit_torques = np.eye(self.model.nv)
        self.reset()

    def reset(self) -> None:
        """Return to sample 0 and reseed, so that the run is repeated."""
        super().reset()
        self._mujoco.mj_resetData(self.model, self.data)
        self._show()

    def _show(self) -> None:
        """Copy the motion of base and links to MuJoCo's data."""
        elastic, springs = self._now.elastic, self._settings.springs
        self.data.qpos[:] = elastic.q if springs else self._q
        self.data.qvel[:] = elastic.dq if springs else self._dq

    def step(self, torque: np.ndarray) -> None:
        """Apply the commanded torque (n,) [N m] and the loads at its start."""
        if self._settings.springs:
            self._swing(torque)
            return
        now = self._now
        data = self.data
        friction = self._settings.disturbance
        acting = now.acting
        self._run(*self._arguments(DRIVE, torque))
        if self.is_stopped:
            data.qvel[:] = 0.0
            now.sample[0] += 1.0
            return
        self._tip.mass[0] = acting.payload[0]
        speed = data.qvel / friction.stribeck_velocity
        self.model.dof_damping[:] = acting.viscous
        self.model.dof_frictionloss[:] = acting.coulomb
        torque = now.drives.whole
        driven = friction.load_asymmetry * torque * np.sign(data.qvel)
        self.model.dof_frictionloss += friction.load_share * (abs(torque) + driven)
        self.model.dof_frictionloss *= 1.0 + friction.stribeck * np.exp(-(speed**2))
        data.xfrc_applied[self._tip.id, :3] = self._to_world @ acting.force
        wave = friction.amplitude * np.sin(
            friction.frequency * data.time + friction.phase
        )
        ripple = friction.ripple * np.sin(friction.ripple_frequency * data.qpos)
        data.qfrc_applied[:] = now.drives.whole
        data.qfrc_applied -= acting.constant + wave + ripple
        self._mujoco.mj_step(self.model, data)
        self._q[:], self._dq[:] = data.qpos, data.qvel
        now.sample[0] += 1.0

    def _swing(self, torque: np.ndarray) -> None:
        """Implement `step` with springs."""
        self._run(*self._arguments(DRIVE, torque))
        self._tip.mass[0] = self._now.acting.payload[0]
        if self.is_stopped:
            self._run(*self._arguments(MOVE, torque))
        else:
            for _ in range(self._settings.blocks):
                self._run(*self._arguments(PREDICT, torque))
                self._fill_links()
                self._run(*self._arguments(SWING, torque))
        self._show()

    def _fill_links(self) -> None:
        """Write M^-1, C dq + G and the Jacobian of the tip where the links are predicted."""
        mujoco, model, data = self._mujoco, self.model, self.data
        memory = self._now.elastic_memory
        data.qpos[:], data.qvel[:] = memory.q, memory.dq
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_solveM(model, data, memory.inverse, self._unit_torques)
        memory.bias[:] = data.qfrc_bias
        mujoco.mj_jacBody(model, data, self._jacobian, None, self._tip.id)
        tip = data.xpos[self._tip.id] - self._origin
        self._now.memory.tip[:] = tip @ self._to_world
        self._now.memory.jacobian[:] = self._to_world.T @ self._jacobian


def spec_of(config: PlantConfig) -> Any:
    """Return the arm as a description (`mujoco.MjSpec`) to which a scene may be added.

    Raises:
        BlfDscError: MuJoCo cannot read the arm.
    """
    mujoco = import_extra('mujoco', 'mujoco', 'physics: mujoco')
    tip = config.robot.chain(config.joints).tip if config.robot.urdf else _TIP
    text = arm_alone(urdf_of(config), config.joints, tip)
    try:
        spec = mujoco.MjSpec.from_string(text)
    except (ValueError, mujoco.FatalError) as error:
        raise _unreadable(error) from error
    spec.compiler.boundmass = spec.compiler.boundinertia = 0.0
    spec.compiler.fusestatic = False
    for unused in (*spec.geoms, *spec.meshes):
        spec.delete(unused)
    spec.body(tip).add_body(name=PAYLOAD)
    return spec


def model_of(config: PlantConfig) -> Any:
    """Return the model (`mujoco.MjModel`) of a configured arm.

    Raises:
        BlfDscError: MuJoCo cannot read the arm.
    """
    mujoco = import_extra('mujoco', 'mujoco', 'physics: mujoco')
    try:
        spec = spec_of(config)
        model = (_on_base(config, spec) if config.base.mass > 0.0 else spec).compile()
    except (ValueError, mujoco.FatalError) as error:
        raise _unreadable(error) from error
    model.opt.timestep = config.sample_time
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    robot = config.robot
    if not robot.urdf:
        model.opt.gravity[:] = (0.0, 0.0, -config.arm.gravity)
        return model
    model.opt.gravity[:] = _pose_of_base(config, model)[1] @ robot.gravity
    rotors = np.where(stiffness_of(config) > 0.0, 0.0, true_rotors(config))
    model.dof_armature[-rotors.size :] = rotors
    _apply_truth(config, model)
    _apply_base(model)
    return model


def _unreadable(error: Exception) -> BlfDscError:
    reason = ' '.join(str(error).split())
    return BlfDscError(
        f'physics: MuJoCo cannot read the arm: {reason}; correct its description, or use own'
    )


def _pose_of_base(config: PlantConfig, model: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return origin (3,) [m] and rotation (3, 3) of the frame of `robot.base` in MuJoCo's world.

    The root of a description is that world.
    """
    mujoco = import_extra('mujoco', 'mujoco', 'physics: mujoco')
    base = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, config.robot.base)
    if not config.robot.base or base < 0:
        return np.zeros(3), np.eye(3)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return np.array(data.xpos[base]), np.array(data.xmat[base]).reshape(3, 3)


def _on_base(config: PlantConfig, arm: Any) -> Any:
    """Return a description in which an arm stands on a base that gives way, as `on_base` does."""
    mujoco = import_extra('mujoco', 'mujoco', 'physics: mujoco')
    origin, rotation = _pose_of_base(config, arm.copy().compile())
    quaternion, inverted = np.zeros(4), np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, rotation.ravel())
    mujoco.mju_negQuat(inverted, quaternion)
    spec = mujoco.MjSpec()
    spec.compiler.boundmass = spec.compiler.boundinertia = 0.0
    spec.compiler.fusestatic = False
    centre, inertia = CUBE
    base = spec.worldbody.add_body(
        name=_BASE,
        pos=origin,
        quat=quaternion,
        mass=config.base.mass,
        ipos=centre,
        inertia=config.base.mass * inertia,
        explicitinertial=True,
    )
    for kind in (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE):
        for axis in np.eye(3)[:2]:
            base.add_joint(type=kind, axis=axis)
    frame = base.add_frame(pos=-origin @ rotation, quat=inverted)
    spec.attach(arm, frame=frame, prefix=_PREFIX)  # MuJoCo wants one
    for named in (*spec.bodies, *spec.joints):
        named.name = named.name.removeprefix(_PREFIX)
    return spec


def _apply_base(model: Any) -> None:
    """Let the links that stand on the base be part of its mass."""
    mujoco = import_extra('mujoco', 'mujoco', 'physics: mujoco')
    base = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, _BASE)
    if base < 0:
        return
    standing = (model.body_weldid == base) & (np.arange(model.nbody) != base)
    model.body_mass[standing] = model.body_inertia[standing] = 0.0
    mujoco.mj_setConst(model, mujoco.MjData(model))


def _apply_truth(config: PlantConfig, model: Any) -> None:
    """Scale and shift the masses that each joint moves.

    Shifts are along its body's axes.
    """
    mujoco = import_extra('mujoco', 'mujoco', 'physics: mujoco')
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for joint, factor, shift in zip(
        config.joints, *config.truth.changes(len(config.joints)), strict=True
    ):
        moved = model.joint(joint).bodyid[0]
        for body in np.flatnonzero(
            (model.body_weldid == moved) & (model.body_mass > 0.0)
        ):
            own, carrier = (data.xmat[each].reshape(3, 3) for each in (body, moved))
            model.body_mass[body] *= factor
            model.body_inertia[body] *= factor
            model.body_ipos[body] += own.T @ carrier @ shift
    mujoco.mj_setConst(model, data)
