# SPDX-License-Identifier: Apache-2.0
"""Topics and service by which a node takes new references."""

from __future__ import annotations

import time
from collections.abc import Callable

from rclpy.node import Node
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from blf_dsc_controller.control.motion_input import MotionInput
from blf_dsc_controller.messages.topics import JOINT_POSITIONS, JOINT_TRAJECTORY
from blf_dsc_controller.nodes.endpoints import create_trigger, qos_profile
from blf_dsc_controller.run import NANOSECOND
from blf_dsc_controller.supervision.guard import Guard
from blf_dsc_controller.supervision.state_watchdog import SAME_CLOCK


def motion_input_of(
    node: Node, joints: int, guard: Callable[[], Guard | None]
) -> MotionInput:
    """Return the input of motions of a node, subscribed for `joints` joints."""
    inputs = MotionInput(joints, guard, _is_live, node.get_logger())
    connect(node, inputs.take_trajectory, inputs.take_positions, inputs.take_stop)
    return inputs


def connect(
    node: Node,
    take_trajectory: Callable[[bytes], None],
    take_positions: Callable[[bytes], None],
    take_stop: Callable[[], str],
) -> None:
    """Subscribe to both topics, and offer `~/stop`.

    That fails if `take_stop` raises BlfDscError.
    """
    for topic, type_, callback in (
        (JOINT_TRAJECTORY, JointTrajectory, take_trajectory),
        (JOINT_POSITIONS, Float64MultiArray, take_positions),
    ):
        quality = qos_profile(topic.requested)
        node.create_subscription(type_, topic.name, callback, quality, raw=True)
    create_trigger(node, '~/stop', take_stop)


def _is_live(guard: Guard) -> bool:
    """Whether the plant does not wait for the controller."""
    behind = (time.time_ns() - guard.reference.last_stamp) * NANOSECOND
    return guard.watchdog.on or abs(behind) < SAME_CLOCK
