# SPDX-License-Identifier: Apache-2.0
"""The node `torque_watchdog`: the safe torque if the controller has ended.

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
from typing import Any, NamedTuple

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import CONTROLLER, WATCHDOG, load
from blf_dsc_controller.configuration.received import without_files
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.configuration.side_nodes import WatchdogConfig
from blf_dsc_controller.control.status_report import ERROR, OK, WARN, Part
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import (
    Float64MultiArrayDecoder,
    Float64MultiArrayEncoder,
    JointStateDecoder,
)
from blf_dsc_controller.messages.errors import MessageError
from blf_dsc_controller.messages.journal import decode
from blf_dsc_controller.messages.topics import READY, Quality
from blf_dsc_controller.nodes.diagnostics import DiagnosticsPublisher
from blf_dsc_controller.nodes.endpoints import (
    PollingTimer,
    RawMessage,
    RawSubscriptions,
    create_steady_timer,
    is_listener,
    message_class,
    qos_profile,
)
from blf_dsc_controller.nodes.parameters import declare
from blf_dsc_controller.nodes.process import PlainNode, drain, run
from blf_dsc_controller.nodes.ros_arguments import parameter_files
from blf_dsc_controller.supervision.torque_watchdog import TorqueWatchdog
from blf_dsc_controller.supervision.watched_journal import Meaning, WatchedJournal

_PERIOD = 0.004  # s, of the checks and of the torques
_LOOK_PERIOD = 0.05  # s, of looks at whether it is ready
_REPORT_PERIOD = 1.0  # s
_DEPTH = 20  # messages of a topic in a period


class Status(NamedTuple):
    """What the node can do."""

    level: bytes
    text: str
    is_ready: bool = False  # whether it can take over from a controller that commands


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
        super().__init__(WATCHDOG, **options)
        self._steady = steady
        self._config = declare(self, WatchdogConfig)
        self.watchdog: TorqueWatchdog | None = None
        self.problem = ''
        self._journal = WatchedJournal()
        self._given = self._journal.parameters  # those that are watched by
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
        self._diagnostics = DiagnosticsPublisher(self, (), topics.WATCHDOG_STATE)
        self._controller = f'{self.get_namespace().rstrip("/")}/{CONTROLLER}'
        self._timer = PollingTimer(self, _PERIOD, self._poll)
        create_steady_timer(self, _LOOK_PERIOD, self._look)
        create_steady_timer(self, _REPORT_PERIOD, self._report)
        if self._config.armed:
            files = parameter_files(sys.argv) or ['recommended']
            self._watch(
                load(files[-1], self._controller, ControllerConfig, runs_law=False)
            )
        else:
            self.get_logger().info(f'waiting for {self._controller}')

    def close(self) -> None:
        """Leave a torque that a driver may hold, if this node commanded last."""
        if self.watchdog is not None:
            self._publish(self.watchdog.leave())
            drain([self._output])
        self._raw_subscriptions.close()

    # The journal.

    def _read_journal(self, messages: Iterable[RawMessage], now: float) -> None:
        """Follow the controller's configuration, and when its silence is meant."""
        engaged = self.watchdog is not None and self.watchdog.is_engaged(now)
        meanings = []
        for message in messages:
            try:
                event = decode(message.raw)
            except BlfDscError as error:  # of another version, or of somebody else
                self._report_problem(f'{error}')
                continue
            meanings.append(self._journal.take(event, is_engaged=engaged))
        self._adopt_parameters()
        for meaning in meanings:
            self._heed(meaning)

    def _adopt_parameters(self) -> None:
        """Watch a controller of the parameters that the journal has."""
        given = self._journal.parameters
        is_known = given is self._given or given == self._given
        if is_known and not self.problem:  # also of a controller that was started again
            return
        try:
            config = build(ControllerConfig, without_files(given), self._controller)
            self._watch(config)
        except BlfDscError as error:
            self._report_problem(f'the journal of {self._controller}: {error}')
            self._journal.parameters = self._given
        else:
            self.problem = ''
            self._given = given

    def _heed(self, meaning: Meaning) -> None:
        """Stand by if the controller is back, and stand down if it is silent on purpose."""
        watchdog = self.watchdog
        if watchdog is None:
            self._report_problem(
                self.problem
                or f'the journal of {self._controller} holds events, but no configuration: '
                'configure or restart the controller'
            )
            return
        if meaning is Meaning.BACK:
            watchdog.stand_by()
        is_zero = watchdog.config.safety.torque == 'zero'
        is_meant = meaning is Meaning.SILENT or (meaning is Meaning.LEFT and is_zero)
        if is_meant and watchdog.stand_down():
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
            return
        self._states = JointStateDecoder(config.joints, required=('position',))
        self._commands = Float64MultiArrayDecoder(count)
        self._encoder = Float64MultiArrayEncoder(count, WATCHDOG)
        self.watchdog = TorqueWatchdog(
            config, self._config.timeout, armed=self._config.armed
        )

    # States and torques.

    def _poll(self) -> bool:
        """Take what has arrived, and command if the controller does not."""
        messages = self._raw_subscriptions.take()
        now = self._steady() * 1e-9
        was_active = self.watchdog is not None and self.watchdog.active
        if self.watchdog is not None:
            # Before the journal: the torque that a controller leaves behind ends nothing.
            for message in messages:
                self._take(self.watchdog, message, now)
        journal = [each for each in messages if each.handle is topics.JOURNAL]
        if journal:
            self._read_journal(journal, now)
        watchdog = self.watchdog
        if watchdog is None:
            return bool(messages)
        self._publish(watchdog.poll(now))
        if swings := watchdog.name_swings():
            self.get_logger().warning(swings)
        if not watchdog.is_engaged(now):
            self._journal.adopt_next()
            self._adopt_parameters()
        if watchdog.active != was_active:
            self._change_command(watchdog)
        return bool(messages) or watchdog.active

    def _take(self, watchdog: TorqueWatchdog, message: RawMessage, now: float) -> None:
        raw = message.raw
        try:
            if message.handle is topics.JOINT_STATES:
                stamp = self._states.decode(raw)
                watchdog.take_state(stamp, self._states.values, now)
            elif message.handle is topics.COMMANDS and not self._encoder.has_layout(
                raw
            ):
                watchdog.take_torque(self._torque_in(raw), now)
        except MessageError as error:
            self.get_logger().warning(f'ignored: {error}', throttle_duration_sec=10.0)

    def _torque_in(self, raw: bytes) -> np.ndarray:
        """Return the torque (n,) [N m] of a command.

        Raises:
            MessageError: it is for other joints, so that no drive applies it.
        """
        size = self._commands.decode(raw)
        torque = self._commands.values
        if size != torque.size:
            raise MessageError(f'{size} torques for {torque.size} joints')
        return torque

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

    # What it can do.

    def _reaches_drives(self) -> bool:
        """Whether somebody takes its torques, besides those who only listen."""
        found = self.get_subscriptions_info_by_topic(self._output.topic_name)
        listening = sum(is_listener(each.node_name) for each in found)
        return self._output.get_subscription_count() > listening

    def status(self) -> Status:
        """Return what this node can do now."""
        watchdog = self.watchdog
        status = self._status_of(watchdog)
        if self.problem and not (watchdog is not None and watchdog.active):
            text = f'{self.problem}; {self._state_of_problem}'
            status = status._replace(level=ERROR, text=text)
        return status

    def _status_of(self, watchdog: TorqueWatchdog | None) -> Status:
        if watchdog is None:
            return Status(WARN, f'waiting for {self._controller}')
        if watchdog.active:
            text = 'commands the safe torque: the controller is silent'
            return Status(ERROR, text, is_ready=True)
        if watchdog.stands_down:
            return Status(OK, 'the controller is silent on purpose')
        lack = self._lack_of(watchdog)
        if lack:
            return Status(WARN, f'not ready: {lack}')
        waiting = f'ready: waiting for the first torque of {self._controller}'
        return Status(OK, 'watching' if watchdog.watches else waiting, is_ready=True)

    def _lack_of(self, watchdog: TorqueWatchdog) -> str:
        """Return what is missing for this node to take over, or empty."""
        if not watchdog.has_state:
            return 'no joint states arrive'
        return '' if self._reaches_drives() else 'nobody subscribes to its torques'

    def _look(self) -> None:
        """Report what this node can do if that has changed."""
        status = self.status()
        if status == self._diagnostics.key:
            return
        if status.level == OK:
            self.get_logger().info(status.text)
        self._report()

    def _report(self) -> None:
        status = self.status()
        takeovers = 0 if self.watchdog is None else self.watchdog.takeovers
        values = {'takeovers': takeovers, READY: status.is_ready}
        part = Part('torque', status.level, status.text, values)
        self._diagnostics.publish(part, key=status)


main = partial(run, WatchdogNode)

if __name__ == '__main__':
    sys.exit(main())
