# SPDX-License-Identifier: Apache-2.0
"""A robot behind ROS: joint states on one topic, torques on another.

The node `blf_dsc_controller` answers the states, with all that it looks at before and
meanwhile, and offers what it always does.  It holds the arm between two runs.  What takes
longer than a sample is then computed in another process.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import (
    Executor,
    ProcessPoolExecutor,
)
from contextlib import ExitStack
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import ClassVar

import rclpy
from rclpy.experimental import EventsExecutor
from rclpy.node import Node

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.drive import DriveConfig
from blf_dsc_controller.configuration.nodes import CONTROLLER, read
from blf_dsc_controller.configuration.robot import TOPIC
from blf_dsc_controller.control.arm_controller import ArmController
from blf_dsc_controller.control.motion_input import MotionInput
from blf_dsc_controller.control.realtime import undisturbed_loop
from blf_dsc_controller.drive.driver import (
    ConnectionLostError,
    Driver,
    Facts,
    RobotState,
    Vector,
)
from blf_dsc_controller.nodes import process
from blf_dsc_controller.nodes.driven_node import DrivenNode
from blf_dsc_controller.nodes.parameters import wait_for_description
from blf_dsc_controller.run import NANOSECOND
from blf_dsc_controller.supervision.load_declaration import LoadDeclaration

# s without joint states, or anybody who takes torques: longer than the watchdog of the
# law waits, which is for stamps of the wall clock only
_PATIENCE = 10.0
_FRESH = 0.02  # s, in which a newer state comes
_LOOK = 1.0  # s between looks whether somebody takes the torques
_NAME = 'blf_dsc_drive'  # of the node that asks for a URDF
_URDF = 'robot.urdf'


class RosDriver(Driver):
    """A robot behind the topics of joint states and torques."""

    answers: ClassVar[bool] = True
    facts: ClassVar[Facts] = Facts(0, 0.0, '', '', (), ())  # they are in the states

    @staticmethod
    def received(
        path: Path, given: Mapping[str, object], config: DriveConfig
    ) -> dict[str, object]:
        """Return the URDF of a file if it comes from a topic; `given` takes precedence."""
        name = ''
        for section in read(path):
            name = (
                str(section.entries[_URDF].value) if _URDF in section.entries else name
            )
        name = str(given.get(_URDF, name))
        if not name.startswith(TOPIC):
            return {}
        _begin_ros(config)
        node = Node(_NAME)
        try:
            return {_URDF: wait_for_description(node, name.removeprefix(TOPIC))}
        finally:
            node.destroy_node()
            rclpy.try_shutdown()

    def __init__(
        self, address: str, controller: ControllerConfig, config: DriveConfig
    ) -> None:
        """Keep what `connect` needs."""
        super().__init__(address, controller, config)
        self._ending = ExitStack()
        self._is_begun = False
        self._others = 0  # publishers of torques, beside the node, since the start
        self._looked = 0.0  # s, when there was the last look at who takes the torques
        self._began = 0.0  # s
        self._last = -1  # ns, stamp of the last state that was answered

    def connect(self) -> Sequence[str]:
        """Start the node, and wait until states come, and somebody takes the torques."""
        if not self._is_begun:
            self._begin()
        self._await_arm()
        return []

    def _begin(self) -> None:
        """Start the node."""
        self._is_begun = True
        _begin_ros(self.config)
        self._ending.callback(rclpy.try_shutdown)
        worker = self._ending.enter_context(
            ProcessPoolExecutor(
                1, get_context('spawn'), signal.signal, (signal.SIGINT, signal.SIG_IGN)
            )
        )
        executor = self._ending.enter_context(EventsExecutor())
        node = DrivenNode(self.controller)
        self._ending.callback(node.destroy_node)
        self._ending.callback(node.close)
        executor.add_node(node)
        self.attach(node, partial(process.spin_once, executor, node), worker)
        self._ending.enter_context(undisturbed_loop())

    def attach(
        self,
        node: DrivenNode,
        spin: Callable[[], None],
        worker: Executor,
    ) -> None:
        """Use a node, which `spin` lets work for a moment, and a worker beside it."""
        self._node = node
        self._spin = spin
        self.worker = worker

    @property
    def inputs(self) -> MotionInput | None:
        """The topics and the service of the node."""
        return self._node.status.trajectories

    @property
    def declaration(self) -> LoadDeclaration | None:
        """How the node declares loads to the driver's service, if there is one."""
        return self._node.declaration

    def positions(self) -> Vector:
        """Return the positions (n,) [rad] of the last joint state."""
        self.wait(_FRESH)
        self._await_arm()
        position = self._node.position()
        assert position is not None  # noqa: S101 - for mypy
        return position

    def answer_by(
        self, controller: ArmController, took: Callable[[float], None]
    ) -> None:
        """Answer states by this controller from the next `start` on."""
        self._controller = controller
        self._node.took = took

    def start(self) -> None:
        """Let the controller take command with the next state that it may start from."""
        node = self._node
        self.problem = ''
        if not node.guard or not node.guard.commanding:
            self._others = node.others
        self._began = time.monotonic()
        self._last = self._controller.guard.journal.stamp
        node.begin(self._controller)

    def read(self) -> RobotState | None:
        """Let the node work for a moment; return the state that it has answered, if any."""
        self._spin()
        guard = self._controller.guard
        if guard.starting.error is not None and not guard.commanding:
            raise guard.starting.error
        self._check_for_loss()
        self._look_for_others()
        stamp = guard.journal.stamp
        if stamp == self._last or not guard.commanding:
            return None
        self._last = stamp
        last = guard.readings.last
        return RobotState(stamp * NANOSECOND, *last.measurement.reshape(3, -1))

    def write(self, torque: Vector | None) -> None:
        """Send torques (n,) [N m] after an error of the program."""
        self._node.command(torque)

    def finish(self) -> None:
        """Record no more; the node goes on holding the arm."""
        self._node.is_recorded = False

    def recover(self) -> None:
        """Do nothing: no robot behind ROS says that it has stopped by itself."""

    def wait_until(self, is_over: Callable[[], bool]) -> None:
        """Let time pass, in which the node holds the arm."""
        while not is_over():
            self._spin()

    def close(self) -> None:
        """Leave the torque that the driver may hold, and end the node."""
        self._ending.close()

    def _look_for_others(self) -> None:
        """Note a problem if there are more other publishers of torques than before the start.

        One that was killed stays visible for some time.
        """
        node = self._node
        self._others = min(self._others, node.others)
        if node.others > self._others:
            self.problem = f'another node publishes torques on {node.commands}, too'

    def _await_arm(self) -> None:
        """Wait until there are joint states, and somebody takes the torques.

        Raises ConnectionLostError if there are none, or nobody does, for ten seconds.
        """
        end = time.monotonic() + _PATIENCE
        while self._node.position() is None:
            self._spin()
            if time.monotonic() > end:
                self._check_for_loss()
                raise self._no_states(_PATIENCE)

    def _no_states(self, seconds: float) -> ConnectionLostError:
        """Return the error of this time [s] without joint states of the arm."""
        return ConnectionLostError(
            f'no joint states on {self._node.states} for {seconds:.2g} s: start the driver, or '
            'name its topic as drive.states (of commission, --states)'
        )

    def _check_for_loss(self) -> None:
        """Raise ConnectionLostError without joint states, or anybody who takes torques."""
        node, now = self._node, time.monotonic()
        silent = now - max(node.heard, self._began)
        if now - self._looked > _LOOK:
            self._looked = now
            if not node.is_observed():
                raise ConnectionLostError(
                    f'nobody takes torques on {node.commands}: start the effort controller, or '
                    'name its topic as drive.commands (of commission, --commands)'
                )
        if silent > _PATIENCE:
            raise self._no_states(silent)


def _begin_ros(config: DriveConfig) -> None:
    """Begin ROS, with the topics that a configuration names."""
    rules = [f'__ns:=/{config.namespace.strip("/")}']
    if config.states:
        rules.append(f'joint_states:={config.states}')
    if config.commands:
        rules.append(f'{CONTROLLER}:~/commands:={config.commands}')
    words = [word for rule in rules for word in ('-r', rule)]
    rclpy.init(
        args=['--ros-args', *words],
        signal_handler_options=rclpy.SignalHandlerOptions.NO,
    )
