# SPDX-License-Identifier: Apache-2.0
"""The diagnostics of a node on `/diagnostics`: once a second and immediately after a change.

Names are paths (`left/blf_dsc_controller/loop`), which rqt_robot_monitor shows as a tree; the
hardware is named by its joints.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from blf_dsc_controller.messages import topics
from blf_dsc_controller.nodes.endpoints import create_publisher, qos_profile

OK = DiagnosticStatus.OK
WARN = DiagnosticStatus.WARN
ERROR = DiagnosticStatus.ERROR
STALE = DiagnosticStatus.STALE


class DiagnosticsPublisher:
    """Publishes the statuses of a node and, given a topic for it, its latched state."""

    def __init__(
        self, node: Node, joints: Sequence[str], state: topics.Topic | None = None
    ) -> None:
        self._node = node
        self._name = node.get_fully_qualified_name().removeprefix('/')
        self._hardware = ' '.join(joints)
        self._diagnostics = node.create_publisher(
            DiagnosticArray, topics.DIAGNOSTICS.name, qos_profile(topics.DIAGNOSTICS.offered)
        )
        self._state = create_publisher(node, state) if state else None

    def status(
        self, part: str, level: bytes, message: str, values: Mapping[str, Any]
    ) -> DiagnosticStatus:
        """Return the status of a part of the node."""
        return DiagnosticStatus(
            level=level,
            name=f'{self._name}/{part}',
            message=message,
            hardware_id=self._hardware,
            values=[KeyValue(key=key, value=f'{value}') for key, value in values.items()],
        )

    def publish(self, statuses: Sequence[DiagnosticStatus]) -> None:
        """Publish statuses on /diagnostics."""
        array = DiagnosticArray(status=list(statuses))
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._diagnostics.publish(array)

    def publish_state(self, status: DiagnosticStatus) -> None:
        """Publish the latched state, which late subscribers also receive."""
        if self._state is not None:
            self._state.publish(status)
