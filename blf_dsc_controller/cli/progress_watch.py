# SPDX-License-Identifier: Apache-2.0
"""A look at a running loop from outside, over its slow topic."""

from __future__ import annotations

import time
from types import TracebackType

import rclpy
from rclpy.experimental import EventsExecutor
from sensor_msgs.msg import JointState

from blf_dsc_controller.arms.two_link import PARAMETER_NAMES
from blf_dsc_controller.cli.progress import Progress
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.names import RATIO
from blf_dsc_controller.nodes.endpoints import profile

_LAST = 0.05  # s without a message after which the last one has come
_LINGER = 0.5  # s for all of them: a loop that is being interrupted still runs


class Watch:
    """Shows the progress of the loop that runs in this process's ROS domain.

    Args:
        config: of the plant.
    """

    def __init__(self, config: PlantConfig) -> None:
        self._progress = Progress(config)
        self._start = -1.0
        self._latest: JointState | None = None
        self._context = rclpy.Context()
        rclpy.init(context=self._context, signal_handler_options=rclpy.SignalHandlerOptions.NO)
        self._node = rclpy.create_node('closed_loop', context=self._context, enable_rosout=False)
        self._executor = EventsExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._node.create_subscription(
            JointState, topics.MONITOR.relative, self._take, profile(topics.MONITOR.offered)
        )

    def wait(self, seconds: float) -> bool:
        """Wait for a message and show it; False if none came."""
        self._executor.spin_once(timeout_sec=seconds)
        if self._latest is None:
            return False
        self._show(self._latest)
        self._latest = None
        return True

    def say(self, text: str) -> None:
        """Print a line beside the progress."""
        self._progress.say(text)

    @property
    def has_begun(self) -> bool:
        """Whether the loop has been seen to run."""
        return self._start >= 0.0

    def __enter__(self) -> Watch:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        end = time.monotonic() + _LINGER
        while kind is None and time.monotonic() < end and self.wait(_LAST):
            pass
        self._progress.close()
        self._executor.remove_node(self._node)
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def _take(self, message: JointState) -> None:
        self._latest = message

    def _show(self, message: JointState) -> None:
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        if self._start < 0.0:
            self._start = stamp
        values = dict(zip(message.name, message.position, strict=True))
        ratio = max(value for name, value in values.items() if name.startswith(RATIO))
        estimate = [values[name] for name in PARAMETER_NAMES]
        self._progress.show(stamp - self._start, ratio, estimate)
