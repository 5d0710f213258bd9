# SPDX-License-Identifier: Apache-2.0
"""`/diagnostics` of a node, and state and journal of the controller.

Names are paths (`left/blf_dsc_controller/loop`), which rqt_robot_monitor shows as a
tree; the hardware is named by its joints.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from blf_dsc_controller.control.status_report import Part, StatusReport
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.journal import EventType
from blf_dsc_controller.messages.topics import Topic
from blf_dsc_controller.nodes.endpoints import create_publisher
from blf_dsc_controller.supervision.guard import Guard


class DiagnosticsPublisher:
    """Publishes the statuses of a node.

    Attributes:
        key: what the state that was published last is of.
    """

    def __init__(
        self, node: Node, joints: Sequence[str], state: Topic | None = None
    ) -> None:
        """Publish on /diagnostics; the first status on the topic `state`, too, if there is one."""
        self.key: object = None
        self._node = node
        self._name = node.get_fully_qualified_name().removeprefix('/')
        self._hardware = ' '.join(joints)
        self._diagnostics = create_publisher(node, topics.DIAGNOSTICS)
        self._latched = None if state is None else create_publisher(node, state)

    def publish(self, *parts: Part, key: object = None) -> None:
        """Publish the status of each part; the first as the state, if it is of another `key`."""
        array = DiagnosticArray()
        array.header.stamp = self._node.get_clock().now().to_msg()
        for part, level, message, values in parts:
            status = DiagnosticStatus(
                level=level, message=message, hardware_id=self._hardware
            )
            status.name = f'{self._name}/{part}'
            status.values = [
                KeyValue(key=name, value=f'{value}') for name, value in values.items()
            ]
            array.status.append(status)
        self._diagnostics.publish(array)
        if self._latched is not None and key != self.key:
            self.key = key
            self._latched.publish(array.status[0])


class ControllerStatus(StatusReport):
    """Publishes the state of the controller.

    Attributes:
        journal: publisher of `~/journal`.
    """

    def __init__(
        self,
        node: Node,
        joints: Sequence[str],
        write: Callable[[Topic, bytes], None],
    ) -> None:
        """Create the publishers of a node that controls `joints`; `write` gets events, too."""
        super().__init__(node.get_logger())
        self._write = write
        self.journal = create_publisher(node, topics.JOURNAL)
        self._targets = create_publisher(node, topics.TARGETS)
        self._diagnostics = DiagnosticsPublisher(node, joints, topics.STATE)
        self._revision = -1  # of the state that was published last

    def has_news(self, guard: Guard) -> bool:
        """Whether there are events or a state to publish, besides streamed targets."""
        if guard.supervisor.revision != self._revision:
            return True
        return any(each.type is not EventType.TARGET for each in guard.journal.pending)

    def report(
        self, lifecycle: str, guard: Guard | None, others: int, missing: str
    ) -> None:
        """Publish diagnostics, new events and, if it has changed, the state.

        The arguments are those of `parts`.
        """
        self._revision = -1
        if guard is not None:
            self.publish_events(guard)
            self._revision = guard.supervisor.revision
        parts = self.parts(lifecycle, guard, others, missing)
        self._diagnostics.publish(*parts, key=(lifecycle, self._revision))

    def publish_events(self, guard: Guard) -> None:
        """Publish the new events."""
        for topic, raw in guard.journal.take():
            publisher = self.journal if topic is topics.JOURNAL else self._targets
            publisher.publish(raw)
            self._write(topic, raw)
