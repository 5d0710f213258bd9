# SPDX-License-Identifier: Apache-2.0
"""The same arm with the mechanics of MuJoCo, as a node like `sim_plant`, with its parameters.

The arm comes from arm.xml or from a URDF that MuJoCo reads. Encoders, drives and the
schedule of events are those of `sim_plant`, all mechanics are MuJoCo's.
"""

from __future__ import annotations

import sys
from pathlib import Path

import mujoco
import numpy as np

from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.nodes import process
from blf_dsc_controller.nodes.plant_node import PlantNode
from sim_plant.kernels import actuate, apply_rate_limit, compensate
from sim_plant.layout import PlantSettings
from sim_plant.motion import update_loads
from sim_plant.plant import Plant, plant_settings

TIP = 'link2'  # body of arm.xml: a point mass at the tip
PAYLOAD = 'payload of mujoco_plant'  # massless body at the tip of a URDF


def spec_of(config: PlantConfig) -> mujoco.MjSpec:
    """Return the arm as a description to which others may add what surrounds it."""
    if not config.robot.urdf:
        return mujoco.MjSpec.from_file(str(Path(__file__).with_name('arm.xml')))
    chain = config.robot.chain(config.joints)
    spec = mujoco.MjSpec.from_string(config.robot.text)
    spec.compiler.boundmass = spec.compiler.boundinertia = 0.0
    spec.compiler.fusestatic = False
    for unused in (*spec.geoms, *spec.meshes):
        spec.delete(unused)
    for joint in spec.joints:
        if joint.name not in config.joints:  # fingers and the like are fixed
            spec.delete(joint)
    spec.body(chain.tip).add_body(name=PAYLOAD)
    return spec


def model_of(config: PlantConfig) -> mujoco.MjModel:
    """Build the MuJoCo model of the arm."""
    model = spec_of(config).compile()
    if not config.robot.urdf:
        return model
    chain = config.robot.chain(config.joints)
    model.opt.timestep = config.sample_time
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    model.opt.gravity[:] = config.robot.gravity
    model.dof_armature[:] = config.truth.rotor_factor * config.robot.rotors(chain)
    _apply_truth(config, model)
    return model


def _apply_truth(config: PlantConfig, model: mujoco.MjModel) -> None:
    """Scale and shift the masses that each joint moves.

    Shifts are along its body's axes.
    """
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


class MujocoArm(Plant):
    """The arm with its loads and events.

    Arrays are in the order of the parameter `joints`.
    """

    def __init__(self, config: PlantConfig) -> None:
        self._settings = plant_settings(config)
        start = config.initial
        super().__init__(self._settings, start.position, start.velocity, config.seed)
        self.model = model_of(config)
        self.data = mujoco.MjData(self.model)
        self._tip = self.model.body(PAYLOAD if config.robot.urdf else TIP)
        self._mass = self._tip.mass[0]
        self.reset()

    def change(self, settings: PlantSettings) -> None:
        """Take over other loads, events and friction."""
        self._settings = settings
        super().change(settings)

    def reset(self) -> None:
        """Return to sample 0."""
        super().reset()
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self._q
        self.data.qvel[:] = self._dq

    def step(self, torque: np.ndarray) -> None:
        """Take a step with this torque (n,) [N m] and the loads that act at its start."""
        settings = self._settings
        now = self._now
        data = self.data
        friction = settings.disturbance
        acting = now.acting
        drives = now.drives
        if apply_rate_limit(settings, now, torque):
            data.qvel[:] = self._dq[:] = drives.applied[:] = drives.motor[:] = 0.0
            now.sample[0] += 1.0
            return
        actuate(settings, now, drives.command)
        update_loads(settings, now)
        compensate(settings, now)
        self._tip.mass[0] = self._mass + acting.payload[0]
        speed = data.qvel / friction.stribeck_velocity
        self.model.dof_damping[:] = acting.viscous
        self.model.dof_frictionloss[:] = acting.coulomb
        self.model.dof_frictionloss *= 1.0 + friction.stribeck * np.exp(-(speed**2))
        data.xfrc_applied[self._tip.id, :3] = acting.force
        wave = friction.amplitude * np.sin(
            friction.frequency * data.time + friction.phase
        )
        ripple = friction.ripple * np.sin(friction.ripple_frequency * data.qpos)
        data.qfrc_applied[:] = drives.applied + drives.added
        data.qfrc_applied -= acting.constant + wave + ripple
        mujoco.mj_step(self.model, data)
        self._q[:], self._dq[:] = data.qpos, data.qvel
        now.sample[0] += 1.0


class MujocoPlant(PlantNode):
    """The arm as a node."""

    plant_of = MujocoArm


if __name__ == '__main__':
    sys.exit(process.run(MujocoPlant))
