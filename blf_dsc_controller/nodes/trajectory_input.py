# SPDX-License-Identifier: Apache-2.0
"""`~/joint_trajectory`: another reference while the controller runs, or the reason why not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from trajectory_msgs.msg import JointTrajectory

from blf_dsc_controller.messages.cdr import NANOSECONDS
from blf_dsc_controller.messages.topics import JOINT_TRAJECTORY
from blf_dsc_controller.nodes.endpoints import qos_profile
from blf_dsc_controller.reference.trajectory import (
    Trajectory,
    TrajectoryError,
    TrajectoryPoint,
)
from blf_dsc_controller.supervision.guard import Guard

_NANO = 1e-9


class TrajectoryInput:
    """Hands trajectories to the guard, between two samples.

    Attributes:
        accepted: number of trajectories that are or were followed.
        rejected: number of those that are not.
        reason: of the last rejection.
    """

    def __init__(self, node: Node, guard: Callable[[], Guard | None]) -> None:
        """Subscribe; `guard` returns None while the node is not configured."""
        self.accepted = 0
        self.rejected = 0
        self.reason = ''
        self._log = node.get_logger()
        self._guard = guard
        name, quality = JOINT_TRAJECTORY.name, qos_profile(JOINT_TRAJECTORY.requested)
        node.create_subscription(JointTrajectory, name, self._on_trajectory, quality)

    @property
    def values(self) -> dict[str, str]:
        """Values for the diagnostics."""
        return {
            'trajectories followed': f'{self.accepted}',
            'trajectories rejected': f'{self.rejected}',
            'last rejection': self.reason or 'none',
        }

    def _on_trajectory(self, message: JointTrajectory) -> None:
        guard = self._guard()
        if guard is None:
            self._reject('trajectory rejected: the controller is not configured')
            return
        try:
            guard.follow(_trajectory(message, guard.start_stamp))
        except TrajectoryError as error:
            self._reject(str(error))
            return
        self.accepted += 1
        self._log.info(f'following a trajectory of {len(message.points)} points')

    def _reject(self, reason: str) -> None:
        self.rejected += 1
        self.reason = reason
        self._log.warning(reason)


def _trajectory(message: JointTrajectory, start_stamp: int) -> Trajectory:
    """Trajectory of a message, in times since the controller's start; stamp 0 begins at once."""
    points = tuple(
        TrajectoryPoint(
            _nanoseconds(point.time_from_start) * _NANO,
            tuple(point.positions),
            tuple(point.velocities),
            tuple(point.accelerations),
            tuple(point.effort),
        )
        for point in message.points
    )
    stamp = _nanoseconds(message.header.stamp)
    begin = (stamp - start_stamp) * _NANO if stamp else None
    return Trajectory(tuple(message.joint_names), points, begin)


def _nanoseconds(time: Any) -> int:
    return int(time.sec) * NANOSECONDS + int(time.nanosec)
