# SPDX-License-Identifier: Apache-2.0
"""The same arm simulated by MuJoCo, behind the same two topics.

It publishes `joint_states` with the joints in another order than the controller's and a gripper
among them, and takes a step for each torque on `blf_dsc_controller/commands` (lock-step).
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

NAMES = ('joint2', 'gripper', 'joint1')  # of the message; the gripper is not simulated
COMMANDED = ('joint1', 'joint2')  # order of the torques: the controller's parameter `joints`
START = {'joint1': 2.293, 'joint2': 1.696}  # rad
FIRST_STAMP = 1.0  # s
REPEAT = 1.0  # s, for a state that nobody has answered


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
        disturbance = 0.1 + 0.1 * np.sin(self.data.time)  # N m, on each joint
        for name, value in zip(COMMANDED, torque, strict=True):
            self._torque[name] = float(value)
            self.data.actuator(name).ctrl[0] = value
            self.data.joint(name).qfrc_applied[0] = -disturbance
        mujoco.mj_step(self.model, self.data)
        self.steps += 1
        self._unanswered.reset()
        self._publish()

    def _publish(self) -> None:
        nanoseconds = round((FIRST_STAMP + self.data.time) * 1e9)
        message = JointState(name=list(NAMES))
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(nanoseconds, 10**9)
        simulated = [name if name in START else None for name in NAMES]
        message.position = [self.data.joint(n).qpos[0] if n else 0.0 for n in simulated]
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
