# SPDX-License-Identifier: Apache-2.0
"""The process of the topics of `blf_dsc drive --ros`.

It publishes what the loop sends, and sends the loop what arrives: trajectories,
streamed positions and stops. It ends with the connection.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Sequence
from concurrent import futures
from typing import Any

import rclpy
from rclpy.experimental import EventsExecutor
from rclpy.node import Node

from blf_dsc_controller.configuration.nodes import CONTROLLER
from blf_dsc_controller.control.status_report import Part
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages import topic_link, topics
from blf_dsc_controller.messages.link import Link, link_of
from blf_dsc_controller.messages.topic_link import (
    KINDS,
    LOG,
    OF_LOOP,
    READY,
    STATUS,
    STOP,
)
from blf_dsc_controller.nodes import process
from blf_dsc_controller.nodes.diagnostics import DiagnosticsPublisher
from blf_dsc_controller.nodes.endpoints import create_publisher
from blf_dsc_controller.nodes.trajectory_input import connect

_POLL = 0.1  # s
_PATIENCE = 1.0  # s, for the loop's answer to ~/stop
_NICE = 5  # less urgent than the loop
_SILENT = (
    f'not confirmed: the loop has not answered for {_PATIENCE:g} s. Use the emergency stop. '
    'If the loop goes on, it still brakes'
)


class LoopTopics:
    """The topics of a loop in another process, by its node."""

    def __init__(self, node: Node, link: Link, joints: Sequence[str]) -> None:
        """Create the topics."""
        self._node = node
        self._link = link
        self.publishers = {
            KINDS[topic]: create_publisher(node, topic)
            for topic in (*OF_LOOP, topics.ROBOT_DESCRIPTION)
        }
        self._diagnostics = DiagnosticsPublisher(node, joints, topics.STATE)
        self._stops = 0  # asked for
        self._answers: dict[int, futures.Future[str]] = {}  # to those
        connect(
            node,
            lambda raw: self._pass_on(topics.JOINT_TRAJECTORY, raw),
            lambda raw: self._pass_on(topics.JOINT_POSITIONS, raw),
            self._stop,
        )

    def listen(self) -> None:
        """Take the loop's messages until it ends."""
        for message in self._link.all_messages():
            self._take(*message)

    def _take(self, kind: int, content: bytes) -> None:
        """Do what a message of the loop says."""
        publisher = self.publishers.get(kind)
        if publisher is not None:
            publisher.publish(content)
        elif kind == STATUS:
            self._report(topic_link.decode(content))
        elif kind == STOP:
            number, text = topic_link.decode(content)
            self._answers.pop(number).set_result(text)
        elif kind == LOG:
            self._write_log(**topic_link.decode(content))

    def _write_log(self, level: str, text: str) -> None:
        """Log a text; rclpy refuses a second level from the same place in the code."""
        log = self._node.get_logger()
        if level == 'info':
            log.info(text)
        elif level == 'warning':
            log.warning(text)
        else:
            log.error(text)

    def _report(self, status: dict[str, Any]) -> None:
        parts = (
            Part(name, bytes([level]), message, values)
            for name, level, message, values in status['parts']
        )
        self._diagnostics.publish(*parts, key=status['revision'])

    def _pass_on(self, topic: topics.Topic, raw: bytes) -> None:
        self._link.put(KINDS[topic], bytes(raw))
        self._link.flush()

    def _stop(self) -> str:
        """Let the loop stop, and return what it says.

        Raises BlfDscError if it says nothing; a stop is never taken back.
        """
        self._stops += 1
        self._answers[self._stops] = answer = futures.Future[str]()
        self._link.put(STOP, topic_link.encode(self._stops))
        self._link.flush()
        try:
            return answer.result(_PATIENCE)
        except futures.TimeoutError:  # its own in Python 3.10
            raise BlfDscError(_SILENT) from None


def main() -> int:
    """Run until the loop ends."""
    argument, namespace, *joints = sys.argv[1:]
    process.yield_to_loop()
    os.nice(_NICE)
    link = link_of(argument)
    rclpy.init(args=[], signal_handler_options=rclpy.SignalHandlerOptions.NO)
    node = Node(CONTROLLER, namespace=namespace, start_parameter_services=False)
    loop = LoopTopics(node, link, joints)
    with EventsExecutor() as executor:
        executor.add_node(node)
        listener = threading.Thread(target=loop.listen, daemon=True)
        listener.start()
        link.put(READY, b'null')
        while listener.is_alive():
            link.flush()
            executor.spin_once(timeout_sec=_POLL)
        process.drain(loop.publishers.values())
        executor.remove_node(node)
    node.destroy_node()
    rclpy.try_shutdown()
    return 0


if __name__ == '__main__':
    sys.exit(main())
