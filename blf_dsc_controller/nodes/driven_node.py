# SPDX-License-Identifier: Apache-2.0
"""The controller's node for controllers in a row, each with its own parameters and bag.

Between two of them the arm is under the safe torque of the one before.  The next one goes on
from this torque, so nothing steps, and an unknown load does not sag.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from rclpy.parameter import Parameter

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import flatten
from blf_dsc_controller.control.arm_controller import ArmController
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages import topics
from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.supervision.guard import Guard

_MEASURED = (
    'an arm is being measured, or is commanded by a program: no parameter can be changed before '
    'the end'
)


class DrivenNode(ControllerNode):
    """The controller's node without a controller of its own: `begin` gives it each.

    Attributes:
        took: is told how long each torque took after its state came [s].
        heard: when the last joint state came, on the steady clock [s]; before the first,
            when the node was made.
    """

    def __init__(self, config: ControllerConfig, **options: Any) -> None:
        """Configure the node; it commands nothing before a controller begins."""
        self._acting: np.ndarray | None = None  # N m, the last torque
        self.took: Callable[[float], None] = lambda _: None
        self.heard = time.monotonic()
        overrides = [
            Parameter(name, value=list(value) if isinstance(value, tuple) else value)
            for name, value in {**flatten(config), 'autostart': True}.items()
            if value != ()
        ]
        super().__init__(parameter_overrides=overrides, **options)
        self.log.warns_of_gains = False  # who has the controller has said so

    def autostart(self) -> None:
        """Configure the node only: it commands nothing before the first run.

        Raises BlfDscError if it cannot.
        """
        self._try_each('configure')

    @property
    def commands(self) -> str:
        """Full name of the topic of the torques."""
        return str(self._outputs[topics.COMMANDS].topic_name)

    @property
    def states(self) -> str:
        """Full name of the topic of the joint states."""
        return str(self.resolve_topic_name(topics.JOINT_STATES.relative))

    def position(self) -> np.ndarray | None:
        """Return the positions (n,) [rad] of the last joint state; None: there was none."""
        guard = self.guard
        if guard is None or not np.isfinite(guard.readings.last.age):
            return None
        return np.array(guard.readings.last.q)

    def begin(self, controller: ArmController) -> None:
        """Answer states by a controller, which is to take command, from the next one on.

        Raises BlfDscError if the node cannot begin, or was silent since the last run.
        """
        before, guard = self.guard, controller.guard
        if before is not None and before.silenced:
            raise BlfDscError(before.supervisor.text)
        acting, self._acting = self._acting, None
        self._loop, self.config, self.guard = controller.loop, controller.config, guard
        self.log.begin()
        self.is_recorded = True
        if acting is None:
            self._try_each('activate')
        elif guard is not before:
            guard.starting.take_over_from(acting)
        self._report()

    def command(self, torque: np.ndarray | None) -> None:
        """Send torques (n,) [N m], and say how long they took; None: none."""
        super().command(torque)
        if torque is not None:
            self._acting = np.array(torque)
            self.took(time.monotonic() - self.heard)

    def _on_joint_state(self, raw: bytes) -> None:
        self.heard = time.monotonic()
        super()._on_joint_state(raw)

    def _report_learning(self, guard: Guard) -> None:
        """Log nothing of a law that learns nothing, or only on its way."""

    def _problems(self, config: ControllerConfig) -> list[str]:
        del config
        return [_MEASURED]
