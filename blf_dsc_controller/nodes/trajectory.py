# SPDX-License-Identifier: Apache-2.0
"""`~/joint_trajectory`: another reference while the controller runs, or the reason why not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from trajectory_msgs.msg import JointTrajectory

from blf_dsc_controller.bags.topics import JOINT_TRAJECTORY
from blf_dsc_controller.motion.errors import TrajectoryError
from blf_dsc_controller.motion.trajectory import Point, Request
from blf_dsc_controller.nodes.endpoints import profile
from blf_dsc_controller.safety.guard import Guard

_NANO = 1e-9
_SECOND = 1_000_000_000


def request_of(message: JointTrajectory, start_stamp: int) -> Request:
    """Trajectory of a message, in times since the controller's start_stamp [ns]."""
    stamp = _nanoseconds(message.header.stamp)
    points = tuple(
        Point(
            _nanoseconds(point.time_from_start) * _NANO,
            tuple(point.positions),
            tuple(point.velocities),
            tuple(point.accelerations),
            tuple(point.effort),
        )
        for point in message.points
    )
    begin = (stamp - start_stamp) * _NANO if stamp else None
    return Request(tuple(message.joint_names), points, begin)


class TrajectoryInput:
    """Hands trajectories to the guard, between two samples, and says what came of them.

    Args:
        node: that listens.
        guard: gives the guard; None while there is none.

    Attributes:
        taken: trajectories that are or were followed.
        refused: trajectories that are not.
        reason: why the last of those was refused.
    """

    def __init__(self, node: Node, guard: Callable[[], Guard | None]) -> None:
        self.taken = 0
        self.refused = 0
        self.reason = ''
        self._log = node.get_logger()
        self._guard = guard
        name, quality = JOINT_TRAJECTORY.name, profile(JOINT_TRAJECTORY.requested)
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
        self.taken += 1
        self._log.info(f'following a trajectory of {len(message.points)} points')


def _nanoseconds(time: Any) -> int:
    return int(time.sec) * _SECOND + int(time.nanosec)
