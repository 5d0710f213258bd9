# SPDX-License-Identifier: Apache-2.0
"""The start of the controller's node: which joint state the law may start from."""

from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import PLANT
from blf_dsc_controller.errors import StartError
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import JointStateDecoder
from blf_dsc_controller.messages.errors import MessageError
from blf_dsc_controller.nodes.endpoints import qos_profile
from blf_dsc_controller.nodes.lifecycle import LoopNode
from blf_dsc_controller.nodes.other_commander import Finding, OtherCommander
from blf_dsc_controller.nodes.watchdog_presence import WatchdogPresence
from blf_dsc_controller.run import NANOSECOND
from blf_dsc_controller.supervision.guard import Guard
from blf_dsc_controller.supervision.start_gate import GateState, StartGate
from blf_dsc_controller.supervision.state_watchdog import SAME_CLOCK
from blf_dsc_controller.supervision.supervisor import Phase

WAITING_PERIOD = 5.0
"""Time [s] between two warnings that the start is waited for."""


class ControllerStart:
    """Holds joint states back until the law may start; of several, the last.

    It may start once the commands are received, nobody else commands the arm, an
    expected watchdog is ready, the states have the rate of the law, and the arm, if it
    must be, is held.  A start that is refused is an error of the guard.

    Attributes:
        held: the state that is held back, serialised; or None.
    """

    def __init__(
        self,
        node: LoopNode[ControllerConfig],
        decoder: JointStateDecoder,
        watchdog: WatchdogPresence,
    ) -> None:
        self.held: bytes | None = None
        self._node = node
        self._decoder = decoder
        self._watchdog = watchdog
        self._gate = StartGate(node.config.sample_time)
        self._was_observed = False
        self._other: OtherCommander | None = None  # while the node listens
        self._is_free = False  # to start, beside others
        topic = topics.WATCHDOG_STATE
        quality = qos_profile(topic.requested)
        node.create_subscription(
            DiagnosticStatus, topic.relative, self._on_watchdog_state, quality
        )

    @property
    def count(self) -> int:
        """Number of states by which the rate has been measured so far."""
        return self._gate.count

    def measure(self) -> None:
        """Measure the rate of the states anew."""
        self._gate.restart()

    def look_around(self, commands: str) -> None:
        """Look from now on who else publishes on the topic `commands`, and for a watchdog."""
        self._is_free = False
        config = self._node.config
        if config.safety.other_commands == 'allow':
            return
        if self._other is None:
            joints = len(config.joints)
            self._other = OtherCommander(
                self._node, commands, joints, self._node.steady
            )
        self._other.begin()

    def close(self) -> None:
        """Look no more."""
        if self._other is not None:
            self._other.close()
            self._other = None

    def hold_early(self, guard: Guard, raw: bytes) -> bool:
        """Hold or refuse a state that comes too early to be used; return whether it does."""
        is_starting = guard.supervisor.phase is Phase.STARTING
        if not self._note_observers() or (
            is_starting and not self._check_others(guard)
        ):
            self.held = raw
            return True
        is_measuring = self._gate.state is GateState.MEASURING
        if is_measuring and self._give_to_gate(guard, raw):
            return True
        if is_starting and self._other is not None:
            acting = self._other.torque_of_watchdog()
            self.close()
            if acting is not None:
                guard.starting.take_over_from(acting)
        return False

    def take_held(self, guard: Guard) -> bytes | None:
        """Return the state held, once it may be used, and hold none; call it every 8 ms.

        An arm that is not supported is refused instead.
        """
        waits = self._gate.poll()
        if self.held is None or not self._note_observers():
            return None
        if self._gate.state is GateState.MEASURING and self._gate.count:
            return None
        raw, self.held = self.held, None
        if waits and not is_simulated(self._node) and self._refuse_unsupported(guard):
            return None
        return raw

    def _note_observers(self) -> bool:
        """Return whether somebody receives the commands, or has once."""
        self._was_observed = self._was_observed or self._node.is_observed()
        return self._was_observed

    def _check_others(self, guard: Guard) -> bool:
        """Return whether the law may start beside others, now or before; refuse if it must not."""
        if not self._is_free:
            try:
                self._is_free = self._is_alone() and (
                    guard.commanding or self._watchdog_lets_start()
                )
            except StartError as error:
                guard.starting.refuse(error)
        return self._is_free

    def _is_alone(self) -> bool:
        """Whether nobody else commands the arm; StartError if somebody does."""
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
        if not self._watchdog.delay_start(self._node.steady() * NANOSECOND):
            return True
        self._node.get_logger().warning(
            'not started, waiting until torque_watchdog is ready',
            throttle_duration_sec=WAITING_PERIOD,
        )
        return False

    def _on_watchdog_state(self, message: DiagnosticStatus) -> None:
        values = {pair.key: pair.value for pair in message.values}
        self._watchdog.is_ready = values.get(topics.READY) == 'True'

    def _give_to_gate(self, guard: Guard, raw: bytes) -> bool:
        """Measure the rate by a state before the start; return whether that is its only use."""
        try:
            stamp = self._decoder.decode(raw)
        except MessageError:
            return False
        if guard.supervisor.phase is not Phase.STARTING:
            return False
        is_live = abs(self._node.wall() - stamp) * NANOSECOND < SAME_CLOCK
        if not is_live and is_simulated(self._node):  # in lock-step, it waits
            return False
        guard.observe(stamp, self._decoder.values)
        state = self._gate.take(stamp)
        self.held = raw if state is GateState.MEASURING else None
        if state is GateState.MEASURING:
            return True
        if state is GateState.REFUSED:
            guard.starting.refuse(StartError(self._gate.problem))
        return self._refuse_unsupported(guard)

    def _refuse_unsupported(self, guard: Guard) -> bool:
        """Refuse a start without support; return whether it is refused, if by the gate."""
        if guard.starting.error is None:
            guard.starting.check_support(self._decoder.values)
        return guard.starting.error is not None


def is_simulated(node: Node) -> bool:
    """Whether all joint states are of this package's simulated arm, which waits for a torque."""
    found = node.get_publishers_info_by_topic(topics.JOINT_STATES.relative)
    return all(each.node_name == PLANT for each in found)
