# SPDX-License-Identifier: Apache-2.0
"""`/diagnostics` of a node, and state and journal of the controller.

Names are paths (`left/blf_dsc_controller/loop`), which rqt_robot_monitor shows as a
tree; the hardware is named by its joints.
"""

from __future__ import annotations

from collections.abc import Sequence

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from blf_dsc_controller.control.outputs import Outputs
from blf_dsc_controller.control.status_report import (
    ERROR,
    OK,
    STALE,
    WARN,
    Part,
    StatusReport,
)
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.journal import EventType
from blf_dsc_controller.nodes.endpoints import create_publisher
from blf_dsc_controller.supervision.guard import Guard

__all__ = [
    'ERROR',
    'OK',
    'STALE',
    'WARN',
    'ControllerStatus',
    'DiagnosticsPublisher',
    'Part',
]


class DiagnosticsPublisher:
    """Publishes the statuses of a node."""

    def __init__(self, node: Node, joints: Sequence[str]) -> None:
        self._node = node
        self._name = node.get_fully_qualified_name().removeprefix('/')
        self._hardware = ' '.join(joints)
        self._diagnostics = create_publisher(node, topics.DIAGNOSTICS)

    def publish(self, *parts: Part) -> DiagnosticStatus:
        """Publish the status of each part on /diagnostics; return that of the first."""
        array = DiagnosticArray()
        array.header.stamp = self._node.get_clock().now().to_msg()
        for name, level, message, values in parts:
            status = DiagnosticStatus(
                level=level, message=message, hardware_id=self._hardware
            )
            status.name = f'{self._name}/{name}'
            status.values = [
                KeyValue(key=key, value=f'{value}') for key, value in values.items()
            ]
            array.status.append(status)
        self._diagnostics.publish(array)
        return array.status[0]


class ControllerStatus(StatusReport):
    """Publishes the state of the controller.

    Attributes:
        journal: publisher of `~/journal`.
    """

    def __init__(self, node: Node, joints: Sequence[str], outputs: Outputs) -> None:
        """Create the publishers of a node that controls `joints`.

        Events also go to the outputs.
        """
        super().__init__(node.get_logger())
        self._outputs = outputs
        self.journal = create_publisher(node, topics.JOURNAL)
        self._targets = create_publisher(node, topics.TARGETS)
        self._diagnostics = DiagnosticsPublisher(node, joints)
        self._latched = create_publisher(node, topics.STATE)
        self._published = '', -1  # lifecycle and revision of the state

    def has_news(self, guard: Guard) -> bool:
        """Whether there are events or a state to publish, besides streamed targets."""
        if guard.supervisor.revision != self._published[1]:
            return True
        return any(each.type is not EventType.TARGET for each in guard.journal.pending)

    def report(
        self, lifecycle: str, guard: Guard | None, others: int, missing: str
    ) -> None:
        """Publish diagnostics, new events and, if it has changed, the state.

        Args:
            lifecycle: state of the node.
            guard: None while the node is not configured.
            others: other publishers of torques.
            missing: what is wrong with the node torque_watchdog; empty if nothing is.
        """
        if guard is not None:
            self.publish_events(guard)
        parts = self.parts(lifecycle, guard, others, missing)
        state = self._diagnostics.publish(*parts)
        now = lifecycle, guard.supervisor.revision if guard else -1
        if now != self._published:
            self._latched.publish(state)
            self._published = now

    def publish_events(self, guard: Guard) -> None:
        """Publish the new events."""
        for topic, raw in guard.journal.take():
            publisher = self.journal if topic is topics.JOURNAL else self._targets
            publisher.publish(raw)
            self._outputs.write(max(guard.journal.stamp, 0), topic, raw)
