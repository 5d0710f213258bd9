# SPDX-License-Identifier: Apache-2.0
"""The process of the action, and messages to and from it without waiting."""

from __future__ import annotations

import os
import socket
import subprocess
from collections.abc import Iterator, Sequence
from importlib.util import find_spec

from rclpy.node import Node

from blf_dsc_controller import child
from blf_dsc_controller.control.goal_messages import (
    Cancel,
    Goal,
    Message,
    decode,
    encode,
)
from blf_dsc_controller.messages.link import Link

ACTION = '~/follow_joint_trajectory'
KIND = 0
"""Of all messages over the link."""

_PATIENCE = 5.0  # s for its end


def can_offer() -> bool:
    """Whether control_msgs is installed, which defines the action."""
    return find_spec('control_msgs') is not None


class ActionProcess:
    """The process of a controller's action, and our end of the link to it."""

    def __init__(self, owner: Node, joints: Sequence[str]) -> None:
        """Start it, in the domain and the namespace of its owner."""
        self._log = owner.get_logger()
        self._has_ended = False
        ours, theirs = socket.socketpair()
        self._link = Link(ours)
        with theirs:
            self._process = subprocess.Popen(
                [
                    *child.running_module('blf_dsc_controller.nodes.action_server'),
                    f'{theirs.fileno()}',
                    f'{owner.context.get_domain_id()}',
                    f'_{owner.get_name()}_action',
                    owner.get_namespace(),
                    owner.resolve_service_name(ACTION),
                    _enclave_of(owner),
                    *joints,
                ],
                pass_fds=[theirs.fileno()],
                env=os.environ | child.places(),
            )

    def send(self, message: Message) -> None:
        """Send a message, as soon as the process takes it."""
        self._link.put(KIND, encode(message))
        self._link.flush()

    def messages(self) -> Iterator[Goal | Cancel]:
        """Send what still waits, and yield the requests of clients."""
        self._link.flush()
        for _, content in self._link.messages():
            message = decode(content)
            if isinstance(message, (Goal, Cancel)):
                yield message
        if self._link.broken and not self._has_ended:
            self._has_ended = True
            self._log.error(
                f'the process of {ACTION} has ended: the topics and ~/stop work on; for the action '
                'start the controller again'
            )

    def close(self) -> None:
        """Send what has not been sent, and end the process."""
        self._link.close(_PATIENCE)
        try:
            self._process.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def _enclave_of(node: Node) -> str:
    """Return the security enclave of a node, which its action's process shares."""
    own = node.get_name(), node.get_namespace()
    known = node.get_node_names_and_namespaces_with_enclaves()
    return next((enclave for *name, enclave in known if tuple(name) == own), '/')
