# SPDX-License-Identifier: Apache-2.0
"""What the controller waits for before its first torque, besides the arm.

Nobody else may command the arm, and an expected watchdog must be ready.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.publisher import Publisher

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.errors import StartError
from blf_dsc_controller.messages.topics import READY, WATCHDOG_STATE
from blf_dsc_controller.nodes.endpoints import qos_profile
from blf_dsc_controller.nodes.other_commander import Finding, OtherCommander
from blf_dsc_controller.nodes.process import PlainNode
from blf_dsc_controller.nodes.watchdog_presence import WatchdogPresence

WAITING_PERIOD = 5.0
"""Time [s] between two warnings that the start is waited for."""


class StartConditions:
    """Looks at both conditions until the start; `steady` is its clock [ns]."""

    def __init__(
        self,
        node: PlainNode,
        watchdog: WatchdogPresence,
        steady: Callable[[], int],
    ) -> None:
        self._node = node
        self._watchdog = watchdog
        self._steady = steady
        self._other: OtherCommander | None = None  # while the node listens
        self._are_met = False
        node.create_subscription(
            DiagnosticStatus,
            WATCHDOG_STATE.relative,
            self._on_watchdog_state,
            qos_profile(WATCHDOG_STATE.requested),
        )

    def begin(self, commands: Publisher, config: ControllerConfig) -> None:
        """Listen from now on whether somebody else publishes like `commands`."""
        self._are_met = False
        if config.safety.other_commands == 'allow':
            return
        if self._other is None:
            topic = commands.topic_name
            joints = len(config.joints)
            self._other = OtherCommander(self._node, topic, joints, self._steady)
        self._other.begin()

    def check(self, *, commanding: bool) -> bool:
        """Return whether the law may start, now or before.

        `commanding`: the node has commanded before.

        Raises:
            StartError: it must not.
        """
        if not self._are_met:
            self._are_met = self._is_alone() and (
                commanding or self._watchdog_lets_start()
            )
        return self._are_met

    def end(self) -> np.ndarray | None:
        """Listen no more; return the torque (n,) [N m] by which the watchdog holds the arm."""
        torque = None if self._other is None else self._other.torque_of_watchdog()
        self.close()
        return torque

    def close(self) -> None:
        """Listen no more."""
        if self._other is not None:
            self._other.close()
            self._other = None

    def _on_watchdog_state(self, message: DiagnosticStatus) -> None:
        values = {pair.key: pair.value for pair in message.values}
        self._watchdog.is_ready = values.get(READY) == 'True'

    def _is_alone(self) -> bool:
        if self._other is None:
            return True
        finding = self._other.find()
        if finding is Finding.SOMEBODY:
            raise StartError(
                f'another node commands torques on {self._other.topic}: stop it first; to start '
                'beside it, set safety.other_commands to allow'
            )
        return finding is Finding.NOBODY

    def _watchdog_lets_start(self) -> bool:
        """Ask the watchdog now; warn while it delays the start.

        Raises:
            StartError: it was not ready in time.
        """
        if not self._watchdog.delay_start(self._steady() * 1e-9):
            return True
        self._node.get_logger().warning(
            'not started, waiting until torque_watchdog is ready',
            throttle_duration_sec=WAITING_PERIOD,
        )
        return False
