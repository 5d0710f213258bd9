# SPDX-License-Identifier: Apache-2.0
"""The node `torque_watchdog`: the safe torque when the controller's process is dead or stopped.

Effort controllers hold the last torque for ever. When commands stop while joint states go on, this
node commands the safe torque of the controller's configuration until the controller is back. It
reads that configuration from the running controller, so it needs no parameters of the arm; only if
it is `armed`, to take over from a controller that has died before, it needs the parameter file.
"""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from math import inf
from typing import Any

import numpy as np
from rcl_interfaces.srv import GetParameters
from rclpy.task import Future

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import WatchdogConfig, load
from blf_dsc_controller.configuration.schema import build, parameters
from blf_dsc_controller.errors import ConfigurationError
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import (
    Float64MultiArrayDecoder,
    Float64MultiArrayEncoder,
    JointStateDecoder,
    MessageError,
)
from blf_dsc_controller.nodes.diagnostics import ERROR, OK, WARN, DiagnosticsPublisher
from blf_dsc_controller.nodes.endpoints import (
    RawMessage,
    RawSubscriptions,
    create_steady_timer,
    message_class,
    qos_profile,
)
from blf_dsc_controller.nodes.parameters import declare, values_of
from blf_dsc_controller.nodes.process import PlainNode, drain, parameter_files, run
from blf_dsc_controller.supervision.safe_torque import SecondLine

_PERIOD = 0.004  # s, of the checks and of the torques
_REPORT_PERIOD = 1.0  # s
_DEPTH = 20  # messages of a topic in a period
_STATES, _COMMANDS = range(2)


class WatchdogNode(PlainNode):
    """Publishes the safe torque on the controller's `~/commands` while the controller cannot.

    `line` decides when, None until the controller's parameters have been read; `steady` is its
    clock [ns].
    """

    def __init__(self, *, steady: Callable[[], int] = time.monotonic_ns, **options: Any) -> None:
        super().__init__(topics.WATCHDOG_NODE, **options)
        self._steady = steady
        self._config = declare(self, WatchdogConfig)
        self.line: SecondLine | None = None
        self._states: JointStateDecoder
        self._commands: Float64MultiArrayDecoder
        self._encoder: Float64MultiArrayEncoder
        self._sent: deque[tuple[int, bytes]] = deque(maxlen=10 * _DEPTH)
        self._sequence = 0
        self._raw_subscriptions = RawSubscriptions(self, _DEPTH)
        for handle, topic in ((_STATES, topics.JOINT_STATES), (_COMMANDS, topics.COMMANDS)):
            name = self.resolve_topic_name(topic.relative)
            self._raw_subscriptions.subscribe(name, topic.type, [topics.UNRELIABLE], handle)
        topic = topics.COMMANDS
        quality = qos_profile(topic.offered)
        self._output = self.create_publisher(message_class(topic.type), topic.relative, quality)
        self._diagnostics = DiagnosticsPublisher(self, ())
        self._controller = f'{self.get_namespace().rstrip("/")}/{topics.CONTROLLER}'
        self._names = [parameter.name for parameter in parameters(ControllerConfig)]
        self._client = self.create_client(GetParameters, f'{self._controller}/get_parameters')
        self._asked_at = -inf
        self._timer = create_steady_timer(self, _PERIOD, self._poll)
        create_steady_timer(self, _REPORT_PERIOD, self._report)
        if self._config.armed:
            files = parameter_files(sys.argv) or ['recommended']
            self._watch(load(files[-1], self._controller, ControllerConfig))
        else:
            self.get_logger().info(f'waiting for {self._controller}')

    def close(self) -> None:
        """Leave the torque that a driver may hold, if this node was the one to command it."""
        if self.line is not None:
            self._publish(self.line.leave())
            drain([self._output])
        self._raw_subscriptions.close()

    def _ask(self, now: float) -> None:
        """Ask for the parameters of the controller, again if it has died over them."""
        if now > self._asked_at + _REPORT_PERIOD and self._client.service_is_ready():
            self._asked_at = now
            request = GetParameters.Request(names=self._names)
            self._client.call_async(request).add_done_callback(self._on_parameters)

    def _on_parameters(self, response: Future) -> None:
        if self.line is not None:  # of an earlier response: it was asked again
            return
        try:
            given = values_of(self._names, response.result())
            config = build(ControllerConfig, given, self._controller)
        except ConfigurationError as error:
            self.failure, self.finished = error, True
            return
        self._watch(config)

    def _watch(self, config: ControllerConfig) -> None:
        count = len(config.joints)
        self._states = JointStateDecoder(config.joints, required=('position',))
        self._commands = Float64MultiArrayDecoder(count)
        self._encoder = Float64MultiArrayEncoder(count)
        self.line = SecondLine(config, self._config.timeout, armed=self._config.armed)
        self.get_logger().info(
            f'ready: {config.safety.torque} torque once {self._controller} is silent for '
            f'{self._config.timeout:g} s'
        )

    def _poll(self) -> None:
        messages, now = self._raw_subscriptions.take(), self._steady() * 1e-9
        if self.line is None:
            self._ask(now)
            return
        was_active = self.line.active
        for message in messages:
            self._take(self.line, message, now)
        self._publish(self.line.poll(now))
        if self.line.active != was_active:
            fast = min(_PERIOD, self.line.config.sample_time)  # at the limit of the torque's rate
            self._timer.timer_period_ns = round(1e9 * (fast if self.line.active else _PERIOD))
            self._log(self.line)
            self._report()

    def _take(self, line: SecondLine, message: RawMessage, now: float) -> None:
        try:
            if message.handle == _STATES:
                stamp = self._states.decode(message.raw)
                line.state(stamp, self._states.values, now)
            elif (message.sequence, message.raw) not in self._sent:
                self._commands.decode(message.raw)
                line.torque_of_controller(self._commands.values, now)
        except MessageError as error:
            self.get_logger().warning(f'ignored: {error}', throttle_duration_sec=10.0)

    def _log(self, line: SecondLine) -> None:
        if line.active:
            self.get_logger().fatal(
                f'no command for {line.silence:.3g} s while joint states go on: '
                f'{line.config.safety.torque} torque until {self._controller} is back'
            )
        else:
            self.get_logger().warning('this node no longer commands a torque')

    def _publish(self, torque: np.ndarray | None) -> None:
        if torque is not None:
            raw = self._encoder.encode(torque)
            self._sequence += 1
            self._sent.append((self._sequence, raw))
            self._output.publish(raw)

    def _report(self) -> None:
        level, message, takeovers = WARN, f'waiting for {self._controller}', 0
        if self.line is not None:
            level, message, takeovers = OK, 'watching', self.line.takeovers
            if self.line.active:
                level, message = ERROR, 'commands the safe torque: the controller is silent'
        self._diagnostics.publish(('torque', level, message, {'takeovers': takeovers}))


main = partial(run, WatchdogNode)

if __name__ == '__main__':
    sys.exit(main())
