# SPDX-License-Identifier: Apache-2.0
"""trajectory_msgs/JointTrajectory as it is sent, and as the controller tells what it took.

A trajectory acts from the sample after which it was taken, so that moment has to be told, and the
stamp of the sent message cannot tell it: that is when the trajectory is to begin, 0 for at once.
The told message has the points as they were sent and

    header.stamp      of the last state answered before the trajectory took effect
    header.frame_id   the stamp that was sent [ns], empty for 0

so that for a trajectory that begins at once its times count from its stamp, as in any other. The
functions take any object with the fields of the message, of rclpy or of a bag.
"""

from __future__ import annotations

from typing import Any

from blf_dsc_controller.reference.trajectory import Trajectory, TrajectoryPoint

_NANO = 1e-9
_SECOND = 1_000_000_000


def request_of(message: Any, start_stamp: int) -> Trajectory:
    """Trajectory of a sent message, in times since the controller's start_stamp [ns]."""
    return _request(message, start_stamp, nanoseconds(message.header.stamp))


def told_request(message: Any, start_stamp: int) -> Trajectory:
    """Trajectory of a told message: the very request that was taken.

    Raises:
        ValueError: its frame_id is not that of a told message.
    """
    return _request(message, start_stamp, int(message.header.frame_id or 0))


def told_begin(message: Any) -> str:
    """frame_id under which a sent message is told."""
    stamp = nanoseconds(message.header.stamp)
    return str(stamp) if stamp else ''


def nanoseconds(time: Any) -> int:
    """Time or duration of a message [ns]."""
    return int(time.sec) * _SECOND + int(time.nanosec)


def _request(message: Any, start_stamp: int, begin_stamp: int) -> Trajectory:
    points = tuple(
        TrajectoryPoint(
            nanoseconds(point.time_from_start) * _NANO,
            tuple(point.positions),
            tuple(point.velocities),
            tuple(point.accelerations),
            tuple(point.effort),
        )
        for point in message.points
    )
    begin = (begin_stamp - start_stamp) * _NANO if begin_stamp else None
    return Trajectory(tuple(message.joint_names), points, begin)
