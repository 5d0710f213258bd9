# SPDX-License-Identifier: Apache-2.0
"""Progress of a loop that runs in other processes."""

from __future__ import annotations

import time
from collections.abc import Sequence
from math import inf

import rclpy
from rclpy.experimental import EventsExecutor
from sensor_msgs.msg import JointState

from blf_dsc_controller.cli.progress import LoopProgress
from blf_dsc_controller.configuration.nodes import LoopConfig
from blf_dsc_controller.law.factory import model_of
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.telemetry import DECIMATION
from blf_dsc_controller.messages.topics import RATIO
from blf_dsc_controller.nodes.endpoints import qos_profile

FIRST_SIGN = 5.0  # s, at most, to the first message of a running loop, even on a busy machine
_LAST = 1.0  # s without a message after which none is expected, even on a busy machine
_LINGER = 0.5  # s to wait for messages of an interrupted loop that still runs


class ProgressMonitor:
    """Progress display of the loop that runs in this process's ROS domain."""

    def __init__(self, config: LoopConfig, interrupts: Sequence[int]) -> None:
        plant = config.plant
        self._interrupts = interrupts
        self._parameters = model_of(config.controller).parameter_names
        self.progress = LoopProgress(plant, self._parameters)
        self._start, self._elapsed = -1.0, 0.0
        self._end = plant.duration - DECIMATION * plant.sample_time / 2 if plant.duration else inf
        self._latest: JointState | None = None
        self._context = rclpy.Context()
        rclpy.init(context=self._context, signal_handler_options=rclpy.SignalHandlerOptions.NO)
        self._node = rclpy.create_node('closed_loop', context=self._context, enable_rosout=False)
        self._executor = EventsExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._node.create_subscription(
            JointState, topics.MONITOR.relative, self._receive, qos_profile(topics.MONITOR.offered)
        )

    @property
    def has_begun(self) -> bool:
        """Whether a message of the loop has been received."""
        return self._start >= 0.0

    def wait(self, seconds: float) -> bool:
        """Wait for a message and show it; return False if none arrived."""
        self._executor.spin_once(timeout_sec=seconds)
        message, self._latest = self._latest, None
        if message is None:
            return False
        values = dict(zip(message.name, message.position, strict=True))
        if not values.keys() >= set(self._parameters):
            return False  # of another arm in the same ROS domain
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        if not self.has_begun:
            self._start = stamp
        ratio = max(value for name, value in values.items() if name.startswith(RATIO))
        self._elapsed = stamp - self._start
        self.progress.show_loop(self._elapsed, ratio, [values[name] for name in self._parameters])
        return True

    def __enter__(self) -> ProgressMonitor:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self._receive_last()
        self.progress.close()
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def _receive_last(self) -> None:
        """Show the messages still in transit, up to that of the last sample.

        A short run in lock-step may be over before its controller has been discovered.
        """
        wait = _LAST if self.has_begun else FIRST_SIGN
        wait = _LINGER if self._interrupts else wait
        deadline = time.monotonic() + wait
        while self._elapsed < self._end and time.monotonic() < deadline:
            if self.wait(0.05) and not self._interrupts:
                deadline = time.monotonic() + wait

    def _receive(self, message: JointState) -> None:
        self._latest = message
