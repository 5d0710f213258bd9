# SPDX-License-Identifier: Apache-2.0
"""The arm with the mechanics of MuJoCo (`physics: mujoco`), as a plant like ours.

Encoders, drives and the schedule of events are those of `Plant`, all mechanics are
MuJoCo's: it reads the description of the arm itself, and integrates by RK4 with the
torque held over a sample.  Its Coulomb friction is dry.  Nothing collides.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.extras import import_extra
from sim_plant.kernels import DRIVE
from sim_plant.plant import Plant, plant_settings, urdf_of

PAYLOAD = 'payload of sim_plant'
"""Name of a body at the tip that has no mass but that of the payload."""
_TIP = 'tip'  # of the two links


class MujocoPlant(Plant):
    """A sampled arm in MuJoCo.

    Arrays are in the order of the parameter `joints`.

    Attributes:
        model, data: MuJoCo's.
    """

    is_compiled = False

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
        self._to_world = _rotation_of_base(config, self.model)
        self.reset()

    def reset(self) -> None:
        """Return to sample 0 and reseed, so that the run is repeated."""
        super().reset()
        self._mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self._q
        self.data.qvel[:] = self._dq

    def step(self, torque: np.ndarray) -> None:
        """Apply the commanded torque (n,) [N m] and the loads at its start."""
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


def spec_of(config: PlantConfig) -> Any:
    """Return the arm as a description (`mujoco.MjSpec`) to which a scene may be added.

    Raises:
        BlfDscError: MuJoCo cannot read the arm.
    """
    mujoco = import_extra('mujoco', 'mujoco', 'physics: mujoco')
    try:
        spec = mujoco.MjSpec.from_string(urdf_of(config))
    except (ValueError, mujoco.FatalError) as error:
        raise _unreadable(error) from error
    spec.compiler.boundmass = spec.compiler.boundinertia = 0.0
    spec.compiler.fusestatic = False
    for unused in (*spec.geoms, *spec.meshes):
        spec.delete(unused)
    for joint in spec.joints:
        if joint.name not in config.joints:  # fingers and the like are fixed
            spec.delete(joint)
    tip = config.robot.chain(config.joints).tip if config.robot.urdf else _TIP
    spec.body(tip).add_body(name=PAYLOAD)
    return spec


def model_of(config: PlantConfig) -> Any:
    """Return the model (`mujoco.MjModel`) of a configured arm.

    Raises:
        BlfDscError: MuJoCo cannot read the arm.
    """
    mujoco = import_extra('mujoco', 'mujoco', 'physics: mujoco')
    try:
        model = spec_of(config).compile()
    except (ValueError, mujoco.FatalError) as error:
        raise _unreadable(error) from error
    model.opt.timestep = config.sample_time
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    robot = config.robot
    if not robot.urdf:
        model.opt.gravity[:] = (0.0, 0.0, -config.arm.gravity)
        return model
    chain = robot.chain(config.joints)
    model.opt.gravity[:] = _rotation_of_base(config, model) @ robot.gravity
    model.dof_armature[:] = config.truth.rotor_factor * robot.rotors(chain)
    _apply_truth(config, model)
    return model


def _unreadable(error: Exception) -> BlfDscError:
    reason = ' '.join(str(error).split())
    return BlfDscError(
        f'physics: MuJoCo cannot read the arm: {reason}; correct its description, or use own'
    )


def _rotation_of_base(config: PlantConfig, model: Any) -> np.ndarray:
    """Return the rotation (3, 3) from the frame of `robot.base` to MuJoCo's world.

    The root of a description is that world.
    """
    mujoco = import_extra('mujoco', 'mujoco', 'physics: mujoco')
    base = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, config.robot.base)
    if not config.robot.base or base < 0:
        return np.eye(3)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return np.array(data.xmat[base]).reshape(3, 3)


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
