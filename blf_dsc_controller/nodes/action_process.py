# SPDX-License-Identifier: Apache-2.0
"""The process of the action, and messages to and from it without waiting.

The threads only pass messages on: they cost a sample some microseconds.
"""

from __future__ import annotations

import os
import socket
import subprocess
import threading
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from importlib.util import find_spec
from multiprocessing import Pipe
from queue import SimpleQueue

from rclpy.node import Node

from blf_dsc_controller import child
from blf_dsc_controller.control.goal_messages import (
    Cancel,
    Goal,
    Message,
    decode,
    encode,
)

ACTION = '~/follow_joint_trajectory'
_PATIENCE = 5.0  # s for its end


def can_offer() -> bool:
    """Whether control_msgs is installed, which defines the action."""
    return find_spec('control_msgs') is not None


class ActionProcess:
    """The process of a controller's action.

    Attributes:
        inbox: messages that have arrived.
    """

    def __init__(self, owner: Node, joints: Sequence[str]) -> None:
        """Start it, in the domain and the namespace of its owner."""
        self.inbox: deque[Goal | Cancel] = deque()
        self._log = owner.get_logger()
        self._outbox: SimpleQueue[Message | None] = SimpleQueue()
        self._connection, theirs = Pipe()
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
        theirs.close()
        self._is_ending = False
        self._threads = [
            threading.Thread(target=work, name='action', daemon=True)
            for work in (self._receive, self._transmit)
        ]
        for thread in self._threads:
            thread.start()

    def send(self, message: Message) -> None:
        """Send a message, some time."""
        self._outbox.put(message)

    def close(self) -> None:
        """Send what has not been sent, and end the process."""
        self._is_ending = True
        self._outbox.put(None)
        self._threads[1].join(_PATIENCE)
        try:
            self._process.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._threads[0].join(_PATIENCE)

    def _receive(self) -> None:
        while True:
            try:
                message = decode(self._connection.recv_bytes())
            except (EOFError, OSError):
                break
            if isinstance(message, (Goal, Cancel)):
                self.inbox.append(message)
        if not self._is_ending:
            self._log.error(
                f'the process of {ACTION} has ended: the topics and ~/stop work on; for the action '
                'start the controller again'
            )

    def _transmit(self) -> None:
        """Send what is in the outbox, until None; then the process ends."""
        with suppress(OSError):  # it has ended, which `_receive` says
            while (message := self._outbox.get()) is not None:
                self._connection.send_bytes(encode(message))
        self._shut()

    def _shut(self) -> None:
        """End the connection in both directions, even while a thread reads from it."""
        twin = socket.socket(fileno=os.dup(self._connection.fileno()))
        with twin, suppress(OSError):
            twin.shutdown(socket.SHUT_RDWR)


def _enclave_of(node: Node) -> str:
    """Return the security enclave of a node, which its action's process shares."""
    own = node.get_name(), node.get_namespace()
    known = node.get_node_names_and_namespaces_with_enclaves()
    return next((enclave for *name, enclave in known if tuple(name) == own), '/')
