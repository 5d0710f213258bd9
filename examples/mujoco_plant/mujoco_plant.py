# SPDX-License-Identifier: Apache-2.0
"""The same arm simulated by MuJoCo, behind the same two topics.

It publishes `joint_states` in a different joint order than the controller's and with a gripper
among them, and takes one step per torque on `blf_dsc_controller/commands` (lock-step).
Its parameters are those of `sim_plant`; the arm comes from arm.xml or from a URDF that MuJoCo
reads. Encoders, drives and the schedule of events are those of `sim_plant`, all mechanics are
MuJoCo's.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.nodes import parameters
from sim_plant.drives import actuate
from sim_plant.layout import state_of
from sim_plant.motion import update_loads
from sim_plant.plant import plant_of, plant_settings

FIRST_STAMP = 1.0  # s
REPEAT = 1.0  # s, before an unanswered state is published again
TIP = 'link2'  # body of arm.xml: a point mass at the tip
PAYLOAD = 'payload of mujoco_plant'  # massless body at the tip of a URDF


def model_of(config: PlantConfig) -> mujoco.MjModel:
    """Build the MuJoCo model of the arm."""
    if not config.robot.urdf:
        return mujoco.MjModel.from_xml_path(str(Path(__file__).with_name('arm.xml')))
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
    model = spec.compile()
    model.opt.timestep = config.sample_time
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    model.opt.gravity[:] = config.robot.gravity
    model.dof_armature[:] = config.truth.rotor_factor * config.robot.rotors(chain)
    _apply_truth(config, model)
    return model


def _apply_truth(config: PlantConfig, model: mujoco.MjModel) -> None:
    """Scale and shift the masses that each joint moves; shifts are along its body's axes."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for joint, factor, shift in zip(
        config.joints, *config.truth.changes(len(config.joints)), strict=True
    ):
        moved = model.joint(joint).bodyid[0]
        for body in np.flatnonzero((model.body_weldid == moved) & (model.body_mass > 0.0)):
            own, carrier = (data.xmat[each].reshape(3, 3) for each in (body, moved))
            model.body_mass[body] *= factor
            model.body_inertia[body] *= factor
            model.body_ipos[body] += own.T @ carrier @ shift
    mujoco.mj_setConst(model, data)


class MujocoArm:
    """The arm with its loads and events; arrays are in the order of the parameter `joints`."""

    def __init__(self, config: PlantConfig) -> None:
        self.config = config
        self.n = len(config.joints)
        self.model = model_of(config)
        self.data = mujoco.MjData(self.model)
        self.data.qpos[:] = config.initial.position
        self.data.qvel[:] = config.initial.velocity
        self._tip = self.model.body(PAYLOAD if config.robot.urdf else TIP)
        self._mass = self._tip.mass[0]
        self._settings = plant_settings(config)
        self._plant = plant_of(config)  # for all but its motion
        self._now = state_of(self._plant.state, self._settings)

    def change(self, config: PlantConfig) -> None:
        """Take over other loads, events and friction."""
        self.config, self._settings = config, plant_settings(config)
        self._plant.change(self._settings)

    def measure(self) -> np.ndarray:
        """Return a view (3 n,) of measured angles [rad], velocities [rad/s], torques [N m]."""
        self._now.x[: 2 * self.n] = np.concatenate((self.data.qpos, self.data.qvel))
        return self._plant.measure()

    def step(self, torque: np.ndarray) -> None:
        """Take a step with this torque (n,) [N m] and the loads that act at its start."""
        settings, now, data = self._settings, self._now, self.data
        friction, acting = settings.disturbance, now.acting
        update_loads(settings, now)
        self._tip.mass[0] = self._mass + acting.payload[0]
        speed = data.qvel / friction.stribeck_velocity
        self.model.dof_damping[:] = acting.viscous
        self.model.dof_frictionloss[:] = acting.coulomb
        self.model.dof_frictionloss *= 1.0 + friction.stribeck * np.exp(-(speed**2))
        data.xfrc_applied[self._tip.id, :3] = acting.force
        wave = friction.amplitude * np.sin(friction.frequency * data.time + friction.phase)
        ripple = friction.ripple * np.sin(friction.ripple_frequency * data.qpos)
        actuate(settings, now, torque)
        data.qfrc_applied[:] = now.drives.applied - (acting.constant + wave + ripple)
        mujoco.mj_step(self.model, data)
        now.sample[0] += 1.0


class MujocoPlant(Node):
    """The arm as a node.

    Attributes:
        arm: the simulated arm.
        steps: number of steps taken so far.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('mujoco_plant', **options)
        self.arm = MujocoArm(parameters.declare(self, PlantConfig))
        parameters.on_change(self, PlantConfig, self.arm.change)
        self.steps = 0
        joints = self.arm.config.joints
        self._names = (*joints[:0:-1], 'gripper', joints[0])  # the gripper is not simulated
        self._states = self.create_publisher(JointState, 'joint_states', 1)
        self.create_subscription(
            Float64MultiArray, 'blf_dsc_controller/commands', self._on_command, 1
        )
        self._unanswered = self.create_timer(REPEAT, self._publish)

    def _on_command(self, message: Float64MultiArray) -> None:
        torque = np.array(message.data)
        if torque.shape != (self.arm.n,) or not np.isfinite(torque).all():
            self.get_logger().error(f'command rejected: {list(message.data)}')
            return
        self.arm.step(torque)
        self.steps += 1
        self._unanswered.reset()
        self._publish()

    def _publish(self) -> None:
        nanoseconds = round((FIRST_STAMP + self.arm.data.time) * 1e9)
        message = JointState(name=list(self._names))
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(nanoseconds, 10**9)
        kinds = zip(
            ('position', 'velocity', 'effort'), self.arm.measure().reshape(3, -1), strict=True
        )
        for kind, values in kinds:
            of = dict(zip(self.arm.config.joints, values.tolist(), strict=True))
            setattr(message, kind, [of.get(joint, 0.0) for joint in self._names])
        self._states.publish(message)


def main() -> None:
    """Run the node until it is interrupted."""
    rclpy.init()
    node = MujocoPlant()
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == '__main__':
    main()
