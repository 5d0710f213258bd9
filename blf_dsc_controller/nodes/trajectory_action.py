# SPDX-License-Identifier: Apache-2.0
"""The action `~/follow_joint_trajectory`, as the controller's loop uses it."""

from __future__ import annotations

from collections.abc import Sequence

from rclpy.node import Node

from blf_dsc_controller.control.goals import Goals
from blf_dsc_controller.control.motion_input import MotionInput
from blf_dsc_controller.nodes.action_process import ACTION, ActionProcess, can_offer
from blf_dsc_controller.supervision.guard import Guard

_WITHOUT = (
    f'{ACTION} is not offered, since control_msgs is not installed: apt install '
    'ros-jazzy-control-msgs; trajectories can be sent as a topic, ~/joint_trajectory'
)


class TrajectoryAction:
    """The action of one controller: its process, and the goals."""

    def __init__(self, node: Node, inputs: MotionInput, joints: Sequence[str]) -> None:
        self._process = ActionProcess(node, joints)
        self._goals = Goals(inputs, joints, self._process.send, node.get_logger())

    def poll(self, guard: Guard | None) -> None:
        """Take the requests of clients, and watch the goal; between two samples."""
        for message in self._process.messages():
            self._goals.take(guard, message)
        self._goals.watch(guard)

    def close(self) -> None:
        """End the goal and the process."""
        self._goals.close()
        self._process.close()


def offered_action(
    node: Node, inputs: MotionInput, joints: Sequence[str]
) -> TrajectoryAction | None:
    """Offer the action; without control_msgs say why not, and return None."""
    if can_offer():
        return TrajectoryAction(node, inputs, joints)
    node.get_logger().info(_WITHOUT)
    return None
