# SPDX-License-Identifier: Apache-2.0
"""The process of the action `~/follow_joint_trajectory`: what its clients see.

rclpy holds Python's lock while it converts a goal, for 4 ms with 200 points: the
controller would lose as many samples. So the action has a process of its own, which the
controller starts. It only translates: what happens to a goal is decided by `goals`.

No coroutine waits for the end of a goal, since rclpy's executors poll those that wait.
"""

from __future__ import annotations

import sys
import threading
from typing import Any

import rclpy
from builtin_interfaces.msg import Time
from control_msgs.action import FollowJointTrajectory
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import serialize_message
from rclpy.task import Future
from trajectory_msgs.msg import JointTrajectoryPoint

from blf_dsc_controller.control.goal_messages import (
    KIND,
    Answer,
    Cancel,
    End,
    Feedback,
    Goal,
    JointTolerance,
    Outcome,
    decode,
    encode,
)
from blf_dsc_controller.messages.codecs import NANOSECONDS
from blf_dsc_controller.messages.link import Link, link_of
from blf_dsc_controller.nodes.process import yield_to_loop
from blf_dsc_controller.run import NANOSECOND

_LARGEST = 1 << 30  # bytes of goals that wait
_PATIENCE = 10.0  # s, until a controller takes a goal
Result = FollowJointTrajectory.Result


class _Server(ActionServer):
    """An action server whose goals are executed elsewhere, and ended by `finish`."""

    def notify_execute(
        self, goal_handle: ServerGoalHandle, execute_callback: Any
    ) -> None:
        """Start nothing: the controller has."""

    def finish(self, handle: ServerGoalHandle, result: Any) -> None:
        """Send the result of a goal in a final state."""
        super().notify_execute(handle, lambda _: result)


class TrajectoryActionServer:
    """Passes goals to the controller, and tells clients what became of them."""

    def __init__(self, node: Node, name: str, joints: list[str], link: Link) -> None:
        """Offer the action `name` for the controller at the other end."""
        self._log = node.get_logger()
        self._joints = joints
        self._link = link
        self._count = 0
        self._answers: dict[int, Future] = {}
        self._numbers: dict[int, int] = {}  # of goals, by the id of their requests
        self._handles: dict[int, ServerGoalHandle] = {}
        self._ended: dict[int, End] = {}  # before there was a handle
        self._server = _Server(
            node,
            FollowJointTrajectory,
            name,
            execute_callback=_executed_elsewhere,
            goal_callback=self._on_goal,
            handle_accepted_callback=self._on_accepted,
            cancel_callback=self._on_cancel,
            # a goal that is being planned must not delay a cancel
            callback_group=ReentrantCallbackGroup(),
        )

    async def _on_goal(self, request: Any) -> GoalResponse:
        """Ask the controller, which follows the goal from now on if it accepts it."""
        problem = _unsupported(request)
        if problem:
            self._log.warning(f'goal rejected: {problem}')
            return GoalResponse.REJECT
        self._count += 1
        number = self._count
        answer: Future = Future()
        self._answers[number] = answer
        goal = Goal(
            number,
            bytes(serialize_message(request.trajectory)),
            _tolerances(request.path_tolerance),
            _tolerances(request.goal_tolerance),
            Duration.from_msg(request.goal_time_tolerance).nanoseconds * NANOSECOND,
        )
        self._send(goal)
        accepted = await answer
        if not accepted:
            return GoalResponse.REJECT
        self._numbers[id(request)] = number
        return GoalResponse.ACCEPT

    def _send(self, message: Goal | Cancel) -> None:
        self._link.put(KIND, encode(message))
        self._link.drain(_PATIENCE)

    def _on_accepted(self, handle: ServerGoalHandle) -> None:
        number = self._numbers.pop(id(handle.request))
        self._handles[number] = handle
        handle.execute()
        if number in self._ended:
            self._on_end(self._ended.pop(number))

    def _on_cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        for number, each in self._handles.items():
            if each == handle:
                self._send(Cancel(number))
                return CancelResponse.ACCEPT
        return CancelResponse.REJECT

    def on_message(self, message: Answer | Feedback | End) -> None:
        """Pass on what the controller tells."""
        if isinstance(message, Answer):
            self._answers.pop(message.number).set_result(message.accepted)
        elif isinstance(message, Feedback):
            self._on_feedback(message)
        elif message.number in self._handles:
            self._on_end(message)
        else:
            self._ended[message.number] = message

    def _on_feedback(self, message: Feedback) -> None:
        handle = self._handles.get(message.number)
        if handle is None:
            return
        feedback = FollowJointTrajectory.Feedback()
        seconds, nanoseconds = divmod(message.stamp, NANOSECONDS)
        feedback.header.stamp = Time(sec=seconds, nanosec=nanoseconds)
        feedback.joint_names = self._joints
        feedback.desired = _point(message.time, message.desired)
        feedback.actual = _point(message.time, message.actual)
        error = [
            [wanted - found for wanted, found in zip(*each, strict=True)]
            for each in zip(message.desired, message.actual, strict=False)
        ]
        feedback.error = _point(message.time, error)
        handle.publish_feedback(feedback)

    def _on_end(self, message: End) -> None:
        handle = self._handles.pop(message.number)
        if message.outcome == Outcome.SUCCEEDED:
            handle.succeed()
        elif message.outcome == Outcome.CANCELLED:
            handle.canceled()
        else:
            handle.abort()
        code = getattr(Result, message.code)
        self._server.finish(handle, Result(error_code=code, error_string=message.text))


def _executed_elsewhere(_handle: ServerGoalHandle) -> Any:
    """Never called: `_Server.notify_execute` starts nothing."""
    return Result()


def _unsupported(request: Any) -> str:
    """Return what a goal asks for that this controller has not; empty if nothing."""
    if request.multi_dof_trajectory.points:
        return (
            'it has a multi_dof_trajectory, but all joints have one degree of freedom'
        )
    if request.component_path_tolerance or request.component_goal_tolerance:
        return 'it has tolerances of components, which belong to multi_dof_trajectory'
    return ''


def _tolerances(sent: Any) -> list[JointTolerance]:
    return [(each.name, each.position, each.velocity) for each in sent]


def _point(time: float, values: list[list[float]]) -> JointTrajectoryPoint:
    """Return a point with positions, and with velocities and accelerations if any."""
    names = ('positions', 'velocities', 'accelerations')
    point = JointTrajectoryPoint(**dict(zip(names, values, strict=False)))
    point.time_from_start = Duration(nanoseconds=round(time / NANOSECOND)).to_msg()
    return point


def main() -> int:
    """Run until the controller ends."""
    argument, domain, node_name, namespace, action, enclave, *joints = sys.argv[1:]
    yield_to_loop()
    link = link_of(argument, _LARGEST)
    rclpy.init(
        args=['--ros-args', '--enclave', enclave],
        domain_id=int(domain),
        signal_handler_options=rclpy.SignalHandlerOptions.NO,
    )
    node = Node(
        node_name,
        namespace=namespace,
        use_global_arguments=False,
        enable_rosout=False,
        start_parameter_services=False,
    )
    server = TrajectoryActionServer(node, action, joints, link)
    try:
        _spin(node, server, link)
    except ExternalShutdownException:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


def _spin(node: Node, server: TrajectoryActionServer, link: Link) -> None:
    """Serve clients, and tell them what the controller sends, until it ends."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    over = Future()

    def listen() -> None:
        for _, content in link.all_messages():
            executor.create_task(server.on_message, decode(content))
        executor.create_task(over.set_result, None)

    threading.Thread(target=listen, daemon=True).start()
    executor.spin_until_future_complete(over)


if __name__ == '__main__':
    sys.exit(main())
