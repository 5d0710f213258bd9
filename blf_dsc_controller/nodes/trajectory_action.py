# SPDX-License-Identifier: Apache-2.0
"""The action `~/follow_joint_trajectory`, as the controller's loop uses it.

Its process is `action_server`, with which messages are exchanged without waiting.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec

from rclpy.node import Node

from blf_dsc_controller.control.goal_messages import KIND, Message, decode, encode
from blf_dsc_controller.control.goals import Goals
from blf_dsc_controller.control.motion_input import MotionInput
from blf_dsc_controller.messages.link import LinkedProcess
from blf_dsc_controller.supervision.guard import Guard

_ACTION = '~/follow_joint_trajectory'
_PATIENCE = 5.0  # s for the end of the process
_WITHOUT = (
    f'{_ACTION} is not offered, since control_msgs is not installed: apt install '
    'ros-jazzy-control-msgs; trajectories can be sent as a topic, ~/joint_trajectory'
)


class TrajectoryAction:
    """The action of one controller: its process, and the goals.

    Attributes:
        process: of the action, in the domain and the namespace of its controller.
    """

    def __init__(self, node: Node, inputs: MotionInput, joints: Sequence[str]) -> None:
        self._log = node.get_logger()
        self._has_ended = False
        self._link = LinkedProcess(
            'blf_dsc_controller.nodes.action_server',
            f'{node.context.get_domain_id()}',
            f'_{node.get_name()}_action',
            node.get_namespace(),
            node.resolve_service_name(_ACTION),
            _enclave_of(node),
            *joints,
        )
        self.process = self._link.process
        self._goals = Goals(inputs, joints, self._send, self._log)

    def poll(self, guard: Guard | None) -> None:
        """Take the requests of clients, and watch the goal; between two samples."""
        self._link.flush()
        for _, content in self._link.messages():
            self._goals.take(guard, decode(content))
        if self._link.broken and not self._has_ended:
            self._has_ended = True
            self._log.error(
                f'the process of {_ACTION} has ended: the topics and ~/stop work on; for the '
                'action start the controller again'
            )
        self._goals.watch(guard)

    def close(self) -> None:
        """End the goal and the process."""
        self._goals.close()
        self._link.close(_PATIENCE)
        self._link.await_end(_PATIENCE)

    def _send(self, message: Message) -> None:
        """Send a message, as soon as the process takes it."""
        self._link.put(KIND, encode(message))
        self._link.flush()


def offered_action(
    node: Node, inputs: MotionInput, joints: Sequence[str]
) -> TrajectoryAction | None:
    """Offer the action; without control_msgs say why not, and return None."""
    if find_spec('control_msgs') is not None:
        return TrajectoryAction(node, inputs, joints)
    node.get_logger().info(_WITHOUT)
    return None


def _enclave_of(node: Node) -> str:
    """Return the security enclave of a node, which its action's process shares."""
    own = node.get_name(), node.get_namespace()
    known = node.get_node_names_and_namespaces_with_enclaves()
    return next((enclave for *name, enclave in known if tuple(name) == own), '/')
