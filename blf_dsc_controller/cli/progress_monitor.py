# SPDX-License-Identifier: Apache-2.0
"""The progress of a loop over ROS, as a bar on the terminal."""

from __future__ import annotations

import time

import rclpy
from rclpy.experimental import EventsExecutor
from sensor_msgs.msg import JointState
from tqdm import tqdm

from blf_dsc_controller.cli.domains import strangers
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.topics import RATIO
from blf_dsc_controller.nodes.endpoints import qos_profile

_BAR = '{desc} |{bar}| {n:.1f}/{total:g} s [{elapsed}<{remaining}]{postfix}'
_DISCOVERY = 0.5  # s, until the nodes of a domain have answered


class ProgressMonitor:
    """Progress bar over simulated time of the loop, with max |xi1| / k_c."""

    def __init__(self, duration: float) -> None:
        """Wait for a loop of this simulated duration [s]."""
        self._duration = duration
        # Disabled (None) in a log, where a bar would be one long line.
        self._bar = tqdm(
            total=duration, desc='closed loop', bar_format=_BAR, disable=None
        )
        self.start: float | None = None  # s, stamp of the first message
        self._received: list[JointState] = []
        self._context = rclpy.Context()
        rclpy.init(
            context=self._context, signal_handler_options=rclpy.SignalHandlerOptions.NO
        )
        self._node = rclpy.create_node(
            'closed_loop', context=self._context, enable_rosout=False
        )
        self._executor = EventsExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._node.create_subscription(
            JointState,
            topics.MONITOR.relative,
            self._received.append,
            qos_profile(topics.MONITOR.offered),
        )

    def others(self, domain: int) -> list[str]:
        """Return who else is in this domain: discovered nodes, and bound ports."""
        time.sleep(_DISCOVERY)
        nodes = self._node.get_node_names_and_namespaces()
        names = [f'{space.rstrip("/")}/{name}' for name, space in nodes]
        names.remove(self._node.get_fully_qualified_name())
        return names + [f'UDP port {port}' for port in strangers(domain)]

    def wait(self, seconds: float) -> None:
        """Wait for a message and show it."""
        self._executor.spin_once(timeout_sec=seconds)
        if not self._received:
            return
        message = self._received[-1]
        self._received.clear()
        values = zip(message.name, message.position, strict=True)
        ratio = max(value for name, value in values if name.startswith(RATIO))
        self._bar.set_postfix_str(f'max|xi1|/bound {ratio:.2f}', refresh=False)
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        self.start = stamp if self.start is None else self.start
        self.show(stamp - self.start)

    def show(self, elapsed: float) -> None:
        """Show the simulated time [s]."""
        self._bar.update(min(elapsed, self._duration) - self._bar.n)

    def close(self) -> None:
        """Leave the ROS domain."""
        self._bar.close()
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)
