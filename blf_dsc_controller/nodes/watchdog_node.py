# SPDX-License-Identifier: Apache-2.0
"""The node `torque_watchdog`: the safe torque if the controller is dead.

Effort controllers hold the last torque for ever. When commands stop while joint states
go on, this node commands the safe torque of the controller's configuration until the
controller is back. It reads that configuration, each change of it, and whether a
silence is meant from the controller's journal, so it needs no parameters of the arm;
only if it is `armed`, to take over from a controller that has died before, it needs the
parameter file.

Its own torques carry a label, by which it tells them from those of the controller under
any middleware.
"""

from __future__ import annotations

import sys
import time
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
from blf_dsc_controller.messages.journal import Event, EventType, decode
from blf_dsc_controller.messages.topics import Quality
from blf_dsc_controller.nodes.diagnostics import ERROR, OK, WARN, DiagnosticsPublisher
from blf_dsc_controller.nodes.endpoints import (
    PollingTimer,
    RawMessage,
    RawSubscriptions,
    create_steady_timer,
    message_class,
    qos_profile,
)
from blf_dsc_controller.nodes.parameters import declare
from blf_dsc_controller.nodes.process import PlainNode, drain, parameter_files, run
from blf_dsc_controller.supervision.torque_watchdog import TorqueWatchdog

_PERIOD = 0.004  # s, of the checks and of the torques
_REPORT_PERIOD = 1.0  # s
_DEPTH = 20  # messages of a topic in a period
_BACK_IN_COMMAND = (EventType.CONFIGURE, EventType.ACTIVATE, EventType.RESET)


class WatchdogNode(PlainNode):
    """Publishes the safe torque on `~/commands` while the controller cannot.

    `steady` is its clock [ns].

    Attributes:
        watchdog: decides when to command; None until the controller's parameters are known.
        problem: why the controller's journal cannot be read; empty if it can.
    """

    def __init__(
        self, *, steady: Callable[[], int] = time.monotonic_ns, **options: Any
    ) -> None:
        super().__init__(topics.WATCHDOG_NODE, **options)
        self._steady = steady
        self._config = declare(self, WatchdogConfig)
        self.watchdog: TorqueWatchdog | None = None
        self.problem = ''
        self._given: dict[str, Any] = {}  # parameters of the controller
        self._states: JointStateDecoder
        self._commands: Float64MultiArrayDecoder
        self._encoder: Float64MultiArrayEncoder
        self._raw_subscriptions = RawSubscriptions(self)
        for topic in (topics.JOINT_STATES, topics.COMMANDS):
            self._raw_subscriptions.follow(topic, Quality(_DEPTH, 'best_effort'))
        self._raw_subscriptions.follow(topics.JOURNAL, topics.JOURNAL.requested)
        topic = topics.COMMANDS
        offered = qos_profile(topic.offered)
        self._output = self.create_publisher(
            message_class(topic.type), topic.relative, offered
        )
        self._diagnostics = DiagnosticsPublisher(self, ())
        self._controller = f'{self.get_namespace().rstrip("/")}/{topics.CONTROLLER}'
        self._timer = PollingTimer(self, _PERIOD, self._poll)
        create_steady_timer(self, _REPORT_PERIOD, self._report)
        if self._config.armed:
            files = parameter_files(sys.argv) or ['recommended']
            self._watch(load(files[-1], self._controller, ControllerConfig))
        else:
            self.get_logger().info(f'waiting for {self._controller}')

    def close(self) -> None:
        """Leave a torque that a driver may hold, if this node commanded last."""
        if self.watchdog is not None:
            self._publish(self.watchdog.leave())
            drain([self._output])
        self._raw_subscriptions.close()

    # The journal.

    def _read_journal(self, messages: Iterable[RawMessage]) -> None:
        """Follow the controller's configuration, and when its silence is meant."""
        events = []
        for message in messages:
            try:
                events.append(decode(message.raw))
            except BlfDscError as error:  # of another version, or of somebody else
                self._report_problem(f'{error}')
        given = dict(self._given)
        try:
            for event in events:
                if event.type is EventType.CONFIGURE:
                    given = {}
                if event.type is EventType.CONFIGURE or given:
                    given |= event.content.get('parameters', {})
            if given != self._given:
                self._watch(build(ControllerConfig, given, self._controller))
                self._given = given
        except BlfDscError as error:
            self._report_problem(f'the journal of {self._controller}: {error}')
        for event in events:
            self._take_event(event)

    def _take_event(self, event: Event) -> None:
        watchdog = self.watchdog
        if watchdog is None:
            self._report_problem(
                self.problem
                or f'the journal of {self._controller} holds events, but no configuration: '
                'configure or restart the controller'
            )
            return
        if event.type is EventType.CONFIGURE:
            self.problem = ''
        if event.type in _BACK_IN_COMMAND:
            watchdog.stand_by()
        is_zero = watchdog.config.safety.torque == 'zero'
        is_end = event.type is EventType.RELEASE
        is_orderly = is_end and (is_zero or event.content.get('resting', True))
        if event.type is EventType.WITHDRAW or is_orderly:
            watchdog.stand_down()
            self.get_logger().info(
                f'{self._controller} has stopped commanding on purpose'
            )

    def _report_problem(self, problem: str) -> None:
        if problem != self.problem:
            self.problem = problem
            self.get_logger().error(f'{problem}; {self._state_of_problem}')
            self._report()

    @property
    def _state_of_problem(self) -> str:
        if self.watchdog is None:
            return 'this node cannot watch the controller'
        return 'this node acts by the parameters from before'

    def _watch(self, config: ControllerConfig) -> None:
        """Watch a controller of this configuration."""
        count = len(config.joints)
        if self.watchdog is not None and config.joints == self.watchdog.config.joints:
            self.watchdog.configure(config)
        else:
            self._states = JointStateDecoder(config.joints, required=('position',))
            self._commands = Float64MultiArrayDecoder(count)
            self._encoder = Float64MultiArrayEncoder(count, topics.WATCHDOG_NODE)
            self.watchdog = TorqueWatchdog(
                config, self._config.timeout, armed=self._config.armed
            )
        self.get_logger().info(
            f'ready: {config.safety.torque} torque once {self._controller} is silent for '
            f'{self._config.timeout:g} s'
        )

    # States and torques.

    def _poll(self) -> bool:
        """Take what has arrived, and command if the controller does not."""
        messages = self._raw_subscriptions.take()
        was_active = self.watchdog is not None and self.watchdog.active
        journal = [each for each in messages if each.handle is topics.JOURNAL]
        if journal:
            self._read_journal(journal)
        watchdog = self.watchdog
        if watchdog is None:
            return bool(messages)
        now = self._steady() * 1e-9
        for message in messages:
            self._take(watchdog, message, now)
        self._publish(watchdog.poll(now))
        if watchdog.active != was_active:
            self._change_command(watchdog)
        return bool(messages) or watchdog.active

    def _take(self, watchdog: TorqueWatchdog, message: RawMessage, now: float) -> None:
        raw = message.raw
        try:
            if message.handle is topics.JOINT_STATES:
                stamp = self._states.decode(raw)
                watchdog.state(stamp, self._states.values, now)
            elif message.handle is topics.COMMANDS and not self._encoder.has_layout(
                raw
            ):
                self._commands.decode(raw)
                watchdog.torque_of_controller(self._commands.values, now)
        except MessageError as error:
            self.get_logger().warning(f'ignored: {error}', throttle_duration_sec=10.0)

    def _change_command(self, watchdog: TorqueWatchdog) -> None:
        """Report who commands now, and poll as fast as the torque's rate needs."""
        period = _PERIOD
        if watchdog.active:
            period = min(_PERIOD, watchdog.config.sample_time)
            self.get_logger().fatal(
                f'no command for {watchdog.silence:.3g} s while joint states go on: '
                f'{watchdog.config.safety.torque} torque until {self._controller} is back'
            )
        else:
            self.get_logger().warning('this node no longer commands a torque')
        self._timer.period = period
        self._report()

    def _publish(self, torque: np.ndarray | None) -> None:
        if torque is not None:
            self._output.publish(self._encoder.encode(torque))

    def _report(self) -> None:
        watchdog = self.watchdog
        takeovers = 0 if watchdog is None else watchdog.takeovers
        level = OK
        message = 'watching'
        if watchdog is not None and watchdog.active:
            level = ERROR
            message = 'commands the safe torque: the controller is silent'
        elif self.problem:
            level = ERROR
            message = f'{self.problem}; {self._state_of_problem}'
        elif watchdog is None:
            level = WARN
            message = f'waiting for {self._controller}'
        elif watchdog.stands_down:
            message = 'the controller is silent on purpose'
        self._diagnostics.publish(('torque', level, message, {'takeovers': takeovers}))


main = partial(run, WatchdogNode)

if __name__ == '__main__':
    sys.exit(main())
