# SPDX-License-Identifier: Apache-2.0
"""The node `torque_watchdog`: the safe torque when the controller's process is dead or stopped.

Effort controllers hold the last torque for ever. When commands stop while joint states go on, this
node commands the safe torque of the controller's configuration until the controller is back. It
reads that configuration from the controller's journal, so it needs no parameters of the arm; only
if it is `armed`, to take over from a controller that has died before, it needs the parameter file.
"""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import WatchdogConfig, load
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import (
    Float64MultiArrayDecoder,
    Float64MultiArrayEncoder,
    JointStateDecoder,
    MessageError,
)
from blf_dsc_controller.messages.journal import EventType, decode
from blf_dsc_controller.messages.topics import Quality
from blf_dsc_controller.nodes.diagnostics import ERROR, OK, WARN, DiagnosticsPublisher
from blf_dsc_controller.nodes.endpoints import (
    RawMessage,
    RawSubscriptions,
    create_steady_timer,
    message_class,
    qos_profile,
)
from blf_dsc_controller.nodes.parameters import declare
from blf_dsc_controller.nodes.process import PlainNode, drain, parameter_files, run
from blf_dsc_controller.supervision.safe_torque import SecondLine

_PERIOD = 0.004  # s, of the checks and of the torques
_REPORT_PERIOD = 1.0  # s
_DEPTH = 20  # messages of a topic in a period


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
        self._raw_subscriptions = RawSubscriptions(self)
        for topic in (topics.JOINT_STATES, topics.COMMANDS):
            self._raw_subscriptions.follow(topic, Quality(_DEPTH, 'best_effort'))
        self._raw_subscriptions.follow(topics.JOURNAL, topics.JOURNAL.requested)
        topic = topics.COMMANDS
        offered = qos_profile(topic.offered)
        self._output = self.create_publisher(message_class(topic.type), topic.relative, offered)
        self._diagnostics = DiagnosticsPublisher(self, ())
        self._controller = f'{self.get_namespace().rstrip("/")}/{topics.CONTROLLER}'
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

    def _read_journal(self, messages: Iterable[RawMessage]) -> None:
        """Watch the controller once it has told its parameters, with what was changed since."""
        given: dict[str, Any] = {}
        for message in messages:
            event = decode(message.raw)
            if event.type is EventType.CONFIGURE or given:
                given |= event.content.get('parameters', {})
        if given:
            self._watch(build(ControllerConfig, given, self._controller))

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
            try:
                self._read_journal(each for each in messages if each.handle is topics.JOURNAL)
            except BlfDscError as error:  # it is of another version
                self.failure, self.finished = error, True
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
        raw, sequence = message.raw, message.sequence
        try:
            if message.handle is topics.JOINT_STATES:
                stamp = self._states.decode(raw)
                line.state(stamp, self._states.values, now)
            elif message.handle is topics.COMMANDS and (sequence, raw) not in self._sent:
                self._commands.decode(raw)
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
