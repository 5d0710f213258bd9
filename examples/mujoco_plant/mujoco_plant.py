# SPDX-License-Identifier: Apache-2.0
"""The same arm simulated by MuJoCo, behind the same two topics.

It publishes `joint_states` with the joints in another order than the controller's and a gripper
among them, and takes a step for each torque on `blf_dsc_controller/commands` (lock-step).

Payloads, pushes, friction, encoder offsets and the wall are parameters, those of `sim_plant`.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from blf_dsc_controller.configuration.events import Events, Load, Wall
from blf_dsc_controller.configuration.schema import parameter
from blf_dsc_controller.nodes import parameters

NAMES = ('joint2', 'gripper', 'joint1')  # of the message; the gripper is not simulated
COMMANDED = ('joint1', 'joint2')  # order of the torques: the controller's parameter `joints`
START = {'joint1': 2.293, 'joint2': 1.696}  # rad
FIRST_STAMP = 1.0  # s
REPEAT = 1.0  # s, for a state that nobody has answered


@dataclass(frozen=True)
class MujocoConfig:
    """What the arm goes through; it can change while it runs."""

    joints: tuple[str, ...] = parameter(COMMANDED, 'names of the joints', read_only='of the model')
    load: Load = field(default_factory=Load)
    wall: Wall = field(default_factory=Wall)
    events: Events = field(default_factory=Events)


class MujocoPlant(Node):
    """Simulated arm.

    Attributes:
        data: state of the simulation.
        steps: taken so far.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('mujoco_plant', **options)
        self.model = mujoco.MjModel.from_xml_path(str(Path(__file__).with_name('arm.xml')))
        self.data = mujoco.MjData(self.model)
        self.config = parameters.declare(self, MujocoConfig)
        parameters.on_change(self, MujocoConfig, self._reconfigure)
        self._mass = self.model.body('link2').mass[0]
        self.steps = 0
        for name, angle in START.items():
            self.data.joint(name).qpos[0] = angle
        self._torque = dict.fromkeys(COMMANDED, 0.0)
        self._states = self.create_publisher(JointState, 'joint_states', 1)
        self.create_subscription(
            Float64MultiArray, 'blf_dsc_controller/commands', self._on_command, 1
        )
        self._unanswered = self.create_timer(REPEAT, self._publish)

    def _on_command(self, message: Float64MultiArray) -> None:
        torque = np.array(message.data)
        if torque.shape != (len(COMMANDED),) or not np.isfinite(torque).all():
            self.get_logger().error(f'command rejected: {list(message.data)}')
            return
        push = self._load() - 0.1 - 0.1 * np.sin(self.data.time)  # N m, with the disturbance
        for name, value, pushed in zip(COMMANDED, torque, push, strict=True):
            self._torque[name] = float(value)
            self.data.actuator(name).ctrl[0] = value
            self.data.joint(name).qfrc_applied[0] = pushed
        mujoco.mj_step(self.model, self.data)
        self.steps += 1
        self._unanswered.reset()
        self._publish()

    def _reconfigure(self, config: MujocoConfig) -> None:
        self.config = config

    def _sum(self, name: str, *shape: int) -> np.ndarray:
        """Sum over the events that are on of one of their effects, of this shape."""
        events = self.config.events
        given = getattr(events, name)
        if not given:
            return np.zeros(shape)
        begin = np.array(events.begin)
        duration = np.array(events.duration or (0.0,) * begin.size)
        ramp = np.array(events.ramp or (0.0,) * begin.size)
        since = self.data.time - begin + 1e-9  # s, a rounded sample time
        until = np.where(duration > 0.0, since - duration, -np.inf)
        steps = np.maximum(ramp, 1e-12)
        fraction = np.clip(since / steps, 0.0, 1.0) - np.clip(until / steps, 0.0, 1.0)
        return np.tensordot(fraction, np.reshape(given, (begin.size, *shape)), 1)

    def _load(self) -> np.ndarray:
        """Apply what acts in this step and return the torque (2,) [N m] that pushes the joints."""
        load, n = self.config.load, len(COMMANDED)
        tip = self.model.body('link2')
        tip.mass[0] = self._mass + load.payload + float(self._sum('payload'))
        friction = zip(COMMANDED, self._sum('viscous', n), self._sum('coulomb', n), strict=True)
        for name, viscous, coulomb in friction:
            self.model.joint(name).damping[0] = max(viscous, 0.0)
            self.model.joint(name).frictionloss[0] = max(coulomb, 0.0)
        force = np.array(load.force) + self._sum('force', 3)
        if self.config.wall.stiffness > 0.0:
            force += self._wall_force(tip.id)
        self.data.body('link2').xfrc_applied[:3] = force
        return np.asarray(load.torque + self._sum('torque', n))

    def _wall_force(self, tip: int) -> np.ndarray:
        """Force (3,) [N] of the wall at the tip, the centre of mass of the last link."""
        wall = self.config.wall
        mujoco.mj_forward(self.model, self.data)
        normal = np.array(wall.normal) / np.linalg.norm(wall.normal)
        velocity = np.zeros(6)  # angular, linear
        mujoco.mj_objectVelocity(self.model, self.data, mujoco.mjtObj.mjOBJ_BODY, tip, velocity, 0)
        depth = normal @ (np.array(wall.point) - self.data.xipos[tip])
        force = wall.stiffness * depth - wall.damping * (normal @ velocity[3:])
        return np.asarray(max(force, 0.0) * normal if depth > 0.0 else np.zeros(3))

    def _publish(self) -> None:
        nanoseconds = round((FIRST_STAMP + self.data.time) * 1e9)
        message = JointState(name=list(NAMES))
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(nanoseconds, 10**9)
        simulated = [name if name in START else None for name in NAMES]
        offset = dict(zip(COMMANDED, self._sum('offset', len(COMMANDED)), strict=True))
        message.position = [self.data.joint(n).qpos[0] + offset[n] if n else 0.0 for n in simulated]
        message.velocity = [self.data.joint(n).qvel[0] if n else 0.0 for n in simulated]
        message.effort = [self._torque[n] if n else 0.0 for n in simulated]
        self._states.publish(message)


def main() -> int:
    """Run the node until it is stopped."""
    rclpy.init()
    node = MujocoPlant()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == '__main__':
    sys.exit(main())
