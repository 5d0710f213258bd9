# SPDX-License-Identifier: Apache-2.0
"""The base of the control loop's two nodes: a managed (lifecycle) node."""

from __future__ import annotations

import time
import traceback
from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Generic, TypeVar

from rclpy._rclpy_pybind11 import RCLError
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.publisher import Publisher

from blf_dsc_controller.compiled.announcement import announced_compilation
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import VIEW, WATCHDOG
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.control.realtime import request_realtime
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.topics import Message, Topic
from blf_dsc_controller.nodes import parameters, process
from blf_dsc_controller.nodes.endpoints import (
    PollingTimer,
    create_publisher,
    create_steady_timer,
    create_subscription,
    create_trigger,
    subscriptions_of,
)
from blf_dsc_controller.supervision.state_watchdog import PERIOD

Config = TypeVar('Config', ControllerConfig, PlantConfig)

_DIAGNOSTICS_PERIOD = 1.0  # s
_RECORDER = 'record'  # in the names bag_recorder and rosbag2_recorder


class LoopNode(LifecycleNode, process.PlainNode, Generic[Config]):
    """A node that can configure and activate itself, and survives invalid requests.

    Override `configure`, `activate`, `deactivate` and `release`. Topics, services and
    parameters exist as long as the node; everything it computes with is created when it
    is configured and released when it is cleaned up. `steady` [ns] is the clock for
    timeouts and real time, `wall` [ns] the one for live stamps. Raises
    ConfigurationError if a parameter is invalid.

    Attributes:
        config: configuration in force.
        others: number of other publishers of the output to the other node of the loop.
    """

    def __init__(
        self,
        name: str,
        cls: type[Config],
        *,
        steady: Callable[[], int] = time.monotonic_ns,
        wall: Callable[[], int] = time.time_ns,
        **options: Any,
    ) -> None:
        self._transition_error: Exception | None = None
        super().__init__(name, **options)
        service = self._service_change_state
        service.callback = partial(self._change_state, service.callback)
        self.steady, self.wall = steady, wall
        self.config: Config = parameters.declare(self, cls)
        self._outputs: dict[Topic, Publisher] = {}
        self._senders: dict[Topic, Callable[[bytes], None]] = {}
        self.others = 0

    def destroy_node(self) -> None:
        """Destroy the node with its state machine, which rclpy forgets.

        It would keep the middleware's threads alive until the process exits: a known
        cause of crashes.
        """
        super().destroy_node()
        self._state_machine.destroy_when_not_in_use()

    @abstractmethod
    def configure(self) -> None:
        """Create everything the node computes with."""

    @abstractmethod
    def activate(self) -> None:
        """Start working."""

    @abstractmethod
    def deactivate(self) -> None:
        """Stop working."""

    @abstractmethod
    def release(self) -> None:
        """Release what `configure` created, if anything; also called after an error."""

    @property
    def state_label(self) -> str:
        """State of the node: unconfigured, inactive, active or finalized."""
        return str(self._state_machine.current_state[1])

    def autostart(self) -> None:
        """Configure and activate the node as a manager would, or raise BlfDscError."""
        self._try_each('configure', 'activate')

    def _try_each(self, *names: str) -> None:
        """Trigger transitions in a row, or raise BlfDscError."""
        for name in names:
            if getattr(self, f'trigger_{name}')() != TransitionCallbackReturn.SUCCESS:
                error = self._transition_error
                if isinstance(error, BlfDscError):
                    raise error
                raise BlfDscError(
                    f'{self.get_name()} could not {name}: {error!r}'
                ) from error

    def on_configure(self, _state: LifecycleState) -> TransitionCallbackReturn:  # noqa: D102
        with announced_compilation(self.get_logger().info):
            return self._try(self.configure)

    def on_activate(self, _state: LifecycleState) -> TransitionCallbackReturn:  # noqa: D102
        return self._try(self.activate)

    def on_deactivate(self, _state: LifecycleState) -> TransitionCallbackReturn:  # noqa: D102
        return self._try(self.deactivate)

    def on_cleanup(self, _state: LifecycleState) -> TransitionCallbackReturn:  # noqa: D102
        return self._try(self.release)

    def on_shutdown(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Release everything and end the process."""
        result = self._try(self.release)
        self.finished = True
        return result

    def on_error(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Return to unconfigured after an unforeseen error."""
        self.release()
        return TransitionCallbackReturn.SUCCESS

    def _try(self, step: Callable[[], None]) -> TransitionCallbackReturn:
        try:
            step()
        except BlfDscError as error:
            self._transition_error = error
            self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        except Exception as error:  # noqa: BLE001 - rclpy would drop it silently
            self._transition_error = error
            self.get_logger().error(traceback.format_exc())
            return TransitionCallbackReturn.ERROR
        return TransitionCallbackReturn.SUCCESS

    def _change_state(
        self, change_state: Callable[[Any, Any], Any], request: Any, response: Any
    ) -> Any:
        """Reject impossible transitions, which would otherwise end the process."""
        try:
            return change_state(request, response)
        except RCLError:
            wanted = request.transition.label or request.transition.id
            self.get_logger().warning(
                f'no transition {wanted} from {self.state_label}: rejected'
            )
            response.success = False
            return response

    def start(self) -> None:
        """Start timers and services, and the node itself if `autostart` is set."""
        PollingTimer(self, PERIOD, self._on_poll)
        create_steady_timer(self, _DIAGNOSTICS_PERIOD, self.on_second)
        create_trigger(self, '~/reset', self._on_reset)
        if self.config.autostart:
            self.autostart()

    def connect(
        self, outputs: Sequence[Topic], source: Topic, callback: Callable[[bytes], None]
    ) -> bool:
        """Create the loop's topics; return False if they exist."""
        if self._outputs:
            return False
        self._outputs = {topic: create_publisher(self, topic) for topic in outputs}
        # This takes half the time of `publish`, while the node exists.
        self._senders = {
            topic: self._outputs[topic].handle.publish_raw for topic in outputs
        }
        create_subscription(self, source, callback)
        request_realtime(self.config.realtime, self.get_logger().warning)
        return True

    @abstractmethod
    def reset(self) -> str:
        """Restart the active node; return the message of the response."""

    @abstractmethod
    def _on_poll(self) -> bool:
        """Do what cannot wait for a message; return whether there is anything to do."""

    @abstractmethod
    def _report(self) -> None:
        """Publish diagnostics."""

    def on_second(self) -> None:
        """Warn of other publishers of this node's output, and report."""
        if self._outputs:
            publisher = next(iter(self._outputs.values()))
            found = self.get_publishers_info_by_topic(publisher.topic_name)
            before = self.others
            self.others = sum(each.node_name != WATCHDOG for each in found) - 1
            if self.others > before:
                self.get_logger().warning(
                    f'another node publishes on {publisher.topic_name}, too: stop one of the two '
                    '(a killed node stays visible for 20 s)'
                )
        self._report()

    def _on_reset(self) -> str:
        if self.state_label != 'active':
            raise BlfDscError(
                f'{self.get_name()} is {self.state_label}: activate it first'
            )
        return self.reset()

    def _publish(self, message: Message) -> None:
        topic, raw = message
        self._senders[topic](raw)

    def is_observed(self) -> bool:
        """Whether each output has its recorders, and the first one the other node."""
        wanted = self.config.wait_for_subscribers
        publishers = [*self._outputs.values()]
        others = publishers[0].get_subscription_count()
        others -= self._subscribers(publishers[0], WATCHDOG)
        others -= self._subscribers(publishers[0], subscriptions_of(self.get_name()))
        others -= self._subscribers(publishers[0], subscriptions_of(VIEW))
        recorders = (self._subscribers(each, _RECORDER) for each in publishers)
        return others > wanted and (wanted == 0 or min(recorders) >= wanted)

    def _subscribers(self, publisher: Publisher, kind: str) -> int:
        """Return the number of subscribers whose nodes have this in their names."""
        found = self.get_subscriptions_info_by_topic(publisher.topic_name)
        return sum(kind in each.node_name for each in found)
