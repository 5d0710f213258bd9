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
    """What happens to the arm; it can change while it runs."""

    joints: tuple[str, ...] = parameter(COMMANDED, 'names of the joints', read_only='of the model')
    load: Load = field(default_factory=Load)
    wall: Wall = field(default_factory=Wall)
    events: Events = field(default_factory=Events)


class MujocoArm:
    """The arm and what happens to it; all arrays are in the order of `COMMANDED`."""

    def __init__(self, config: MujocoConfig) -> None:
        self.config = config
        self.model = mujoco.MjModel.from_xml_path(str(Path(__file__).with_name('arm.xml')))
        self.data = mujoco.MjData(self.model)
        self.data.qpos[:] = [START[name] for name in COMMANDED]
        self._mass = self.model.body('link2').mass[0]
        self._torque = np.zeros(2)

    def measure(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Measured angles [rad], velocities [rad/s], torques applied last [N m], (2,) each."""
        return self.data.qpos + self._sum('offset', 2), self.data.qvel.copy(), self._torque

    def step(self, torque: np.ndarray) -> None:
        """Take a step with this torque (2,) [N m] and what else acts at its start."""
        load, data = self.config.load, self.data
        tip = self.model.body('link2')
        tip.mass[0] = self._mass + load.payload + self._sum('payload', 1)[0]
        self.model.dof_damping[:] = np.maximum(self._sum('viscous', 2), 0.0)
        self.model.dof_frictionloss[:] = np.maximum(self._sum('coulomb', 2), 0.0)
        force = load.force + self._sum('force', 3) + self._wall_force(tip.id)
        data.body('link2').xfrc_applied[:3] = force
        disturbance = 0.1 + 0.1 * np.sin(data.time)  # N m, on each joint
        data.qfrc_applied[:] = load.torque + self._sum('torque', 2) - disturbance
        data.ctrl[:] = self._torque = torque
        mujoco.mj_step(self.model, data)

    def _sum(self, name: str, size: int) -> np.ndarray:
        """Sum (size,) of an effect of the events that are on."""
        events = self.config.events
        if not getattr(events, name):
            return np.zeros(size)
        begin, none = np.array(events.begin), (0.0,) * len(events.begin)
        duration, ramp = np.array(events.duration or none), np.array(events.ramp or none)
        since = self.data.time - begin + 1e-9  # s, past the rounding of the time
        after = np.where(duration > 0.0, since - duration, -np.inf)
        ramp = np.maximum(ramp, 1e-12)
        present = np.clip(since / ramp, 0.0, 1.0) - np.clip(after / ramp, 0.0, 1.0)
        return np.asarray(present @ np.reshape(getattr(events, name), (begin.size, size)))

    def _wall_force(self, tip: int) -> np.ndarray:
        """Force (3,) [N] of the wall at the tip, the centre of mass of the last link."""
        wall = self.config.wall
        if wall.stiffness == 0.0:
            return np.zeros(3)
        mujoco.mj_forward(self.model, self.data)
        normal = np.array(wall.normal) / np.linalg.norm(wall.normal)
        velocity = np.zeros(6)  # angular, linear
        mujoco.mj_objectVelocity(self.model, self.data, mujoco.mjtObj.mjOBJ_BODY, tip, velocity, 0)
        depth = normal @ (wall.point - self.data.xipos[tip])
        force = wall.stiffness * depth - wall.damping * (normal @ velocity[3:])
        return np.asarray(max(force, 0.0) * normal if depth > 0.0 else np.zeros(3))


class MujocoPlant(Node):
    """The arm as a node.

    Attributes:
        arm: the simulated arm.
        steps: taken so far.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('mujoco_plant', **options)
        self.arm = MujocoArm(parameters.declare(self, MujocoConfig))
        parameters.on_change(self, MujocoConfig, self._reconfigure)
        self.steps = 0
        self._states = self.create_publisher(JointState, 'joint_states', 1)
        self.create_subscription(
            Float64MultiArray, 'blf_dsc_controller/commands', self._on_command, 1
        )
        self._unanswered = self.create_timer(REPEAT, self._publish)

    def _reconfigure(self, config: MujocoConfig) -> None:
        self.arm.config = config

    def _on_command(self, message: Float64MultiArray) -> None:
        torque = np.array(message.data)
        if torque.shape != (len(COMMANDED),) or not np.isfinite(torque).all():
            self.get_logger().error(f'command rejected: {list(message.data)}')
            return
        self.arm.step(torque)
        self.steps += 1
        self._unanswered.reset()
        self._publish()

    def _publish(self) -> None:
        nanoseconds = round((FIRST_STAMP + self.arm.data.time) * 1e9)
        message = JointState(name=list(NAMES))
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(nanoseconds, 10**9)
        for name, values in zip(
            ('position', 'velocity', 'effort'), self.arm.measure(), strict=True
        ):
            of = dict(zip(COMMANDED, values.tolist(), strict=True))
            setattr(message, name, [of.get(joint, 0.0) for joint in NAMES])
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
