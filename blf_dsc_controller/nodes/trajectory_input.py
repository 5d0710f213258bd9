# SPDX-License-Identifier: Apache-2.0
"""`~/joint_trajectory`: new references while the controller runs, with reasons for rejections."""

from __future__ import annotations

import sys
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

from rclpy.node import Node
from trajectory_msgs.msg import JointTrajectory

from blf_dsc_controller.messages.codecs import joint_trajectory
from blf_dsc_controller.messages.topics import JOINT_TRAJECTORY
from blf_dsc_controller.nodes.endpoints import qos_profile
from blf_dsc_controller.reference.trajectory import (
    MOST_POINTS,
    Trajectory,
    TrajectoryError,
    TrajectoryPoint,
)
from blf_dsc_controller.supervision.guard import Guard, LatePlanError, Plan

_NANO = 1e-9
_POINT_SIZE = 32  # bytes per joint of a point with all its fields, each with a header of 8 bytes
_LEAD = 0.02  # s from now to the time for which a trajectory is planned, at first
_LONGEST_LEAD = 2.0
_SWITCH_INTERVAL = 1e-4  # s after which the planning thread yields to the loop


class _Job(NamedTuple):
    """A trajectory that is being planned."""

    raw: bytes
    lead: float  # s
    plan: Future[Plan]


class TrajectoryInput:
    """Passes trajectories to the guard, between two samples.

    In lock-step the plant waits while a trajectory is planned. Otherwise it is planned in a thread,
    for a time slightly ahead, and further ahead if planning takes longer.

    Attributes:
        accepted: number of trajectories that are or were followed.
        rejected: number of trajectories that are not.
        reason: why the last one was rejected.
        job: the trajectory that is being planned, if any.
    """

    def __init__(self, node: Node, joints: int, guard: Callable[[], Guard | None]) -> None:
        """Subscribe for `joints` joints; `guard` returns None while the node is not configured."""
        self.accepted = 0
        self.rejected = 0
        self.reason = ''
        self._log = node.get_logger()
        self._largest = MOST_POINTS * _POINT_SIZE * (joints + 2)
        self._guard = guard
        self._thread = ThreadPoolExecutor(1, 'trajectories')
        self.job: _Job | None = None
        sys.setswitchinterval(_SWITCH_INTERVAL)
        name, quality = JOINT_TRAJECTORY.name, qos_profile(JOINT_TRAJECTORY.requested)
        node.create_subscription(JointTrajectory, name, self._on_trajectory, quality, raw=True)

    @property
    def values(self) -> dict[str, str]:
        """Values for the diagnostics."""
        return {
            'trajectories followed': f'{self.accepted}',
            'trajectories rejected': f'{self.rejected}',
            'last rejection': self.reason or 'none',
        }

    def poll(self, guard: Guard) -> None:
        """Follow the trajectory whose plan is ready, if there is one."""
        job = self.job
        if job is None or not job.plan.done():
            return
        self.job = None
        try:
            self._adopt(guard, job.plan.result())
        except LatePlanError as error:
            if job.lead > _LONGEST_LEAD:
                self._reject(error)
            else:
                self._submit(guard, job.raw, 2.0 * job.lead)
        except Exception as error:  # noqa: BLE001 - the current reference continues
            self._reject(error)

    def _on_trajectory(self, raw: bytes) -> None:
        guard = self._guard()
        if guard is None:
            self._reject(TrajectoryError(['the controller is not configured']))
        elif len(raw) > self._largest:
            problem = f'it has {len(raw)} bytes, more than {MOST_POINTS} points can have'
            self._reject(TrajectoryError([f'{problem}: send it in pieces']))
        elif guard.watchdog.on:
            if self.job is not None:
                self._reject(TrajectoryError(['a newer one arrived while it was being planned']))
            self._submit(guard, raw, _LEAD)
        else:
            try:
                self._adopt(guard, guard.plan(_trajectory(raw, guard.start_stamp)))
            except Exception as error:  # noqa: BLE001 - the current reference continues
                self._reject(error)

    def _submit(self, guard: Guard, raw: bytes, lead: float) -> None:
        start, at = guard.start_stamp, guard.time + lead

        def plan() -> Plan:
            return guard.plan(_trajectory(raw, start), at)

        self.job = _Job(raw, lead, self._thread.submit(plan))

    def _adopt(self, guard: Guard, plan: Plan) -> None:
        guard.adopt(plan)
        self.accepted += 1
        self._log.info(f'following a trajectory of {len(plan.trajectory.points)} points')

    def _reject(self, error: Exception) -> None:
        self.rejected += 1
        self.reason = f'{error}'
        if not isinstance(error, TrajectoryError):
            self.reason = f'trajectory rejected: {type(error).__name__}: {error}'
        self._log.warning(self.reason)


def _trajectory(raw: bytes, start_stamp: int) -> Trajectory:
    """Return a message's trajectory in times since the controller's start; stamp 0 means now."""
    stamp, names, points = joint_trajectory(raw)
    begin = (stamp - start_stamp) * _NANO if stamp else None
    own = (TrajectoryPoint(time * _NANO, *arrays) for time, arrays in points)
    return Trajectory(names, tuple(own), begin)
