# SPDX-License-Identifier: Apache-2.0
"""The controller's node for runs in a row, each with its own parameters and bag.

Between two runs the arm is under the safe torque of the one before.  The next one goes on
from this torque, so nothing steps, and an unknown load does not sag.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.control.guarded_loop import GuardedLoop
from blf_dsc_controller.control.outputs import Output
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages import topics
from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.supervision.guard import Guard

_MEASURED = 'an arm is being measured: no parameter can be changed before the end'


class RunByRunNode(ControllerNode):
    """The controller's node without a reference of its own: `begin` starts each run.

    Attributes:
        heard: when the last joint state came, on the steady clock [s]; before the first,
            when the node was made.
    """

    def __init__(self, **options: Any) -> None:
        self._acting: np.ndarray | None = None  # N m, the last torque
        self.heard = time.monotonic()
        super().__init__(**options)
        self.log.warns_of_gains = False  # they are about to be measured

    def autostart(self) -> None:
        """Configure the node only: it commands nothing before the first run.

        Raises BlfDscError if it cannot.
        """
        self._try_each('configure')

    def start(self) -> None:
        """Start timers and services, and configure the node."""
        super().start()
        if not self.config.autostart:
            self.autostart()

    @property
    def commands(self) -> str:
        """Full name of the topic of the torques."""
        return str(self._outputs[topics.COMMANDS].topic_name)

    @property
    def states(self) -> str:
        """Full name of the topic of the joint states."""
        return str(self.resolve_topic_name(topics.JOINT_STATES.relative))

    @property
    def is_heard(self) -> bool:
        """Whether somebody takes the torques."""
        return self._is_observed()

    def position(self) -> np.ndarray | None:
        """Return the positions (n,) [rad] of the last joint state; None: there was none."""
        guard = self.guard
        if guard is None or not np.isfinite(guard.readings.last.age):
            return None
        return np.array(guard.readings.last.q)

    def warn(self, text: str) -> None:
        """Log a warning."""
        self.get_logger().warning(text)

    def begin(self, config: ControllerConfig, outputs: tuple[Output, ...]) -> Guard:
        """Begin a run with the next joint state; its messages also go to the outputs.

        Return its guard.

        Raises BlfDscError if the node cannot begin, or was silent since the last run.
        """
        if self.guard is not None and self.guard.silenced:
            raise BlfDscError(self.guard.supervisor.text)
        acting, self._acting = self._acting, None
        self._loop = GuardedLoop(config, self._steady, self._wall)
        self.config, self.guard = config, self._loop.guard
        self.log.begin()
        for output in outputs:
            self.outputs.add(output)
        if acting is None:
            self._try_each('activate')
        else:
            self.guard.starting.activate()
            self.guard.starting.take_over_from(acting)
        self._report()
        return self.guard

    def end(self, output: Output, close: Callable[[], None] = lambda: None) -> None:
        """Give an output no more messages, and close it: `outputs.problem`."""
        self.outputs.end(output, close)

    def _command(self, torque: np.ndarray | None) -> None:
        super()._command(torque)
        if torque is not None:
            self._acting = np.array(torque)

    def _on_joint_state(self, raw: bytes) -> None:
        self.heard = time.monotonic()
        super()._on_joint_state(raw)

    def _report_learning(self, guard: Guard) -> None:
        """Say nothing of a law that learns nothing, or only on its way."""

    def _problems(self, config: ControllerConfig) -> list[str]:
        del config
        return [_MEASURED]
