# SPDX-License-Identifier: Apache-2.0
"""The start of the controller's node: which joint state the law may start from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from rclpy.publisher import Publisher

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.errors import StartError
from blf_dsc_controller.messages.codecs import JointStateDecoder
from blf_dsc_controller.messages.errors import MessageError
from blf_dsc_controller.nodes.start_conditions import StartConditions
from blf_dsc_controller.run import NANOSECOND
from blf_dsc_controller.supervision.guard import Guard
from blf_dsc_controller.supervision.start_gate import GateState, StartGate
from blf_dsc_controller.supervision.state_watchdog import SAME_CLOCK
from blf_dsc_controller.supervision.supervisor import Phase


@dataclass(frozen=True)
class Surroundings:
    """What the node sees of others.

    Attributes:
        is_observed: whether somebody receives the commands.
        is_simulated: whether the joint states are of this package's simulated arm,
            which waits for a torque.
        wall: the wall clock [ns].
    """

    is_observed: Callable[[], bool]
    is_simulated: Callable[[], bool]
    wall: Callable[[], int]


class ControllerStart:
    """Holds joint states back until the law may start; of several, the last.

    It may start once the commands are received, nobody else commands the arm, an
    expected watchdog is ready, the states have the rate of the law, and the arm, if it
    must be, is held.  A start that is refused is an error of the guard.
    """

    def __init__(
        self,
        config: ControllerConfig,
        decoder: JointStateDecoder,
        conditions: StartConditions,
        surroundings: Surroundings,
    ) -> None:
        self._decoder = decoder
        self._conditions = conditions
        self._around = surroundings
        self._gate = StartGate(config.sample_time)
        self._was_observed = False
        self.held: bytes | None = None

    @property
    def count(self) -> int:
        """Number of states by which the rate has been measured so far."""
        return self._gate.count

    def measure(self) -> None:
        """Measure the rate of the states anew."""
        self._gate.restart()

    def look_around(self, commands: Publisher, config: ControllerConfig) -> None:
        """Look from now on who else commands the arm, and for an expected watchdog."""
        self._conditions.begin(commands, config)

    def close(self) -> None:
        """Look no more."""
        self._conditions.close()

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
        if is_starting:
            acting = self._conditions.end()
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
        if (
            waits
            and not self._around.is_simulated()
            and self._refuse_unsupported(guard)
        ):
            return None
        return raw

    def _note_observers(self) -> bool:
        """Return whether somebody receives the commands, or has once."""
        self._was_observed = self._was_observed or self._around.is_observed()
        return self._was_observed

    def _check_others(self, guard: Guard) -> bool:
        """Return whether the law may start beside others; refuse it if it must not."""
        try:
            return self._conditions.check(commanding=guard.commanding)
        except StartError as error:
            guard.starting.refuse(error)
            return False

    def _give_to_gate(self, guard: Guard, raw: bytes) -> bool:
        """Measure the rate by a state before the start; return whether that is its only use."""
        try:
            stamp = self._decoder.decode(raw)
        except MessageError:
            return False
        if guard.supervisor.phase is not Phase.STARTING:
            return False
        is_live = abs(self._around.wall() - stamp) * NANOSECOND < SAME_CLOCK
        if not is_live and self._around.is_simulated():  # in lock-step, it waits
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
