# SPDX-License-Identifier: Apache-2.0
"""`~/joint_trajectory`: another reference while the controller runs, or the reason why not.

What is followed is told on `~/accepted_trajectory`, with the sample after which it was taken.
"""

from __future__ import annotations

from collections.abc import Callable

from builtin_interfaces.msg import Time
from rclpy.node import Node
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory

from blf_dsc_controller.messages.cdr import NANOSECONDS
from blf_dsc_controller.messages.topics import ACCEPTED_TRAJECTORY, JOINT_TRAJECTORY
from blf_dsc_controller.messages.trajectory import request_of, told_begin
from blf_dsc_controller.nodes.endpoints import create_publisher, qos_profile
from blf_dsc_controller.reference.trajectory import TrajectoryError
from blf_dsc_controller.supervision.guard import Guard


class TrajectoryInput:
    """Hands trajectories to the guard, between two samples, and says what came of them.

    Args:
        node: that listens.
        guard: gives the guard; None while there is none.
        telemetry: whether to tell what is followed.

    Attributes:
        taken: trajectories that are or were followed.
        refused: trajectories that are not.
        reason: why the last of those was refused.
    """

    def __init__(self, node: Node, guard: Callable[[], Guard | None], *, telemetry: bool) -> None:
        self.taken = 0
        self.refused = 0
        self.reason = ''
        self._log = node.get_logger()
        self._guard = guard
        self._accepted = create_publisher(node, ACCEPTED_TRAJECTORY) if telemetry else None
        name, quality = JOINT_TRAJECTORY.name, qos_profile(JOINT_TRAJECTORY.requested)
        node.create_subscription(JointTrajectory, name, self._take, quality)

    @property
    def told(self) -> dict[str, str]:
        """Values for the diagnostics."""
        return {
            'trajectories followed': f'{self.taken}',
            'trajectories refused': f'{self.refused}',
            'last refusal': self.reason or 'none',
        }

    def _take(self, message: JointTrajectory) -> None:
        try:
            self._follow(self._guard(), message)
        except TrajectoryError as error:
            self.refused += 1
            self.reason = str(error)
            self._log.warning(self.reason)

    def _follow(self, guard: Guard | None, message: JointTrajectory) -> None:
        if guard is None:
            raise TrajectoryError(['the controller is not configured'])
        guard.follow(request_of(message, guard.start_stamp))
        self._tell(message, guard.last_seen)
        self.taken += 1
        self._log.info(f'following a trajectory of {len(message.points)} points')

    def _tell(self, message: JointTrajectory, stamp: int) -> None:
        if self._accepted is None:
            return
        seconds, nanoseconds = divmod(stamp, NANOSECONDS)
        header = Header(stamp=Time(sec=seconds, nanosec=nanoseconds), frame_id=told_begin(message))
        told = JointTrajectory(
            header=header, joint_names=message.joint_names, points=message.points
        )
        self._accepted.publish(told)
