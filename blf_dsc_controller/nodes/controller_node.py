# SPDX-License-Identifier: Apache-2.0
"""The node `blf_dsc_controller`: a torque for every joint state."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import Inertia

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import CONTROLLER, WATCHDOG
from blf_dsc_controller.control.guarded_loop import GuardedLoop
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import (
    Float64MultiArrayEncoder,
    JointStateDecoder,
)
from blf_dsc_controller.messages.errors import MessageError
from blf_dsc_controller.messages.tip_load import TipLoad
from blf_dsc_controller.nodes import parameters, process
from blf_dsc_controller.nodes.controller_log import ControllerLog
from blf_dsc_controller.nodes.controller_start import (
    WAITING_PERIOD,
    ControllerStart,
    is_simulated,
)
from blf_dsc_controller.nodes.diagnostics import ControllerStatus
from blf_dsc_controller.nodes.endpoints import create_trigger
from blf_dsc_controller.nodes.lifecycle import LoopNode
from blf_dsc_controller.nodes.service_declaration import ServiceDeclaration
from blf_dsc_controller.nodes.trajectory_action import TrajectoryAction, offered_action
from blf_dsc_controller.nodes.trajectory_input import motion_input_of
from blf_dsc_controller.nodes.watchdog_presence import WatchdogPresence
from blf_dsc_controller.reference.approach import end_of_waypoints
from blf_dsc_controller.supervision.guard import Guard
from blf_dsc_controller.supervision.state_check import rate_mismatch
from blf_dsc_controller.warnings.table import config_warnings, worsened

_RARELY = 10  # samples between looks at what rarely changes
_RATE_SAMPLES = 1001  # samples before the rate is checked
_FAST = 0.9  # fraction of the sample time
# s from a signal to the end; ros2 launch sends the next signal after 5 s
_LONGEST_END = 3.0
_SILENT = 0.1  # s without joint states, after which nothing is left to bring to rest


class ControllerNode(LoopNode[ControllerConfig]):
    """Commands a torque on `~/commands` for each joint state, and publishes telemetry.

    Attributes:
        guard: runs the guarded law; None until the node is configured.
        is_recorded: whether the loop's outputs take its messages, too: joint states, torques,
            telemetry and events.
        starting: what is looked at before the first state is used.
        status: diagnostics and events; its `trajectories` are the motions that were asked for.
        action: offers trajectories as an action; None: nobody can ask for any.
        declaration: declares loads to the drives; None: nothing does.
        log: logs what is new of the law.
        warned_at: stamp of the start that the last warning was about [ns].
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(CONTROLLER, ControllerConfig, **options)
        joints = self.config.joints
        self.guard: Guard | None = None
        self.is_recorded = False
        self._loop: GuardedLoop | None = None
        self.declaration: ServiceDeclaration | None = None
        self._decoder = JointStateDecoder(joints, required=('position',))
        self._encoder = Float64MultiArrayEncoder(len(joints))
        self._started = False
        self._polled = 0  # joint states at the last poll
        # whether the tracking errors had subscribers at the last count
        self._errors_subscribed = False
        self.warned_at = -1
        self.log = ControllerLog(self)
        # After a signal:
        self._ends_at = 0.0  # s, at the latest
        self._last_seen = 0, 0.0  # joint states processed by then, and s, the last
        self.status = ControllerStatus(self, joints, self._write)
        self.action: TrajectoryAction | None = None
        self._watchdog = WatchdogPresence(expected=self.config.safety.expect_watchdog)
        self.starting = ControllerStart(self, self._decoder, self._watchdog)
        self._changes = parameters.Changes(
            self, self.config, self._retune, self._problems, self._check
        )
        if self.config.contact.enabled:
            create_trigger(self, '~/tare', self._on_tare)
        if self.config.robot.tip:
            self.create_subscription(
                Inertia, '~/expected_load', self._on_expected_load, 10
            )
            create_trigger(self, '~/expect_last_load', self._on_expect_last_load)
        self.start()

    # Life cycle.

    def configure(self) -> None:
        """Compile the law; create the topics of the loop on the first call."""
        self._loop = GuardedLoop(self.config, self.steady, self.wall)
        self.guard = self._loop.guard
        self.log.begin()
        self._record_topics(self.guard)
        for warning in config_warnings(self.config):
            self.get_logger().warning(warning)
        if end := end_of_waypoints(self.config):
            self.get_logger().info(end)
        self._begin_declaring_loads()
        if self.connect(
            self._output_topics(), topics.JOINT_STATES, self._on_joint_state
        ):
            joints = self.config.joints
            inputs = motion_input_of(self, len(joints), lambda: self.guard)
            self.status.trajectories = inputs
            self.action = offered_action(self, inputs, joints)
        self.starting.look_around(self._outputs[topics.COMMANDS].topic_name)
        self._report()

    def _record_topics(self, guard: Guard) -> None:
        """Add the names of the topics to the first event of the journal."""
        guard.journal.pending[-1].content['topics'] = {
            topic.leaf: self.resolve_topic_name(topic.relative)
            for topic in (topics.JOINT_STATES, topics.COMMANDS)
        }

    def _begin_declaring_loads(self) -> None:
        """Declare loads to the driver's service, if there is one; warn if one is missing."""
        load = self.config.load
        if load.service:
            if self.declaration is None:
                self.declaration = ServiceDeclaration(self, self.config)
            self.declaration.begin()
        elif load.tell_drive:
            self.get_logger().warning(
                'load.tell_drive: without load.service no load is declared to the '
                "drives: give the driver's service, or set robot.drive_payload and the load of "
                'the driver'
            )

    def _output_topics(self) -> list[topics.Topic]:
        """Return the topics that this node publishes in the loop."""
        outputs = [
            topics.COMMANDS,
            topics.REFERENCE,
            topics.TRACKING_ERROR,
            topics.BOUND,
            topics.MONITOR,
        ]
        if self.config.contact.enabled:
            outputs.append(topics.EXTERNAL_TORQUE)
            if self.config.robot.tip:
                outputs.append(topics.EXTERNAL_WRENCH)
        return outputs

    def activate(self) -> None:
        """Take command with the next joint state."""
        self.starting.measure()
        if self.guard is not None:
            self._begin_again(self.guard)
            self.guard.starting.activate()
        self.get_logger().info(
            f'ready for joint states of {", ".join(self.config.joints)}'
        )
        self._report()

    def deactivate(self) -> None:
        """Ramp to the safe torque, and answer all further states with it."""
        if self.guard is not None:
            self.guard.deactivate()
        self.get_logger().info(f'deactivated: {self.config.safety.torque} torque')
        self._report()

    def release(self) -> None:
        """Command the torque to leave behind and release the law."""
        self._leave()
        self.starting.close()
        self.guard = None
        self._loop = None
        self._report()

    def close(self) -> None:
        """Command the torque to leave behind; wait until all have received it."""
        self._leave()
        process.drain([*self._outputs.values(), self.status.journal])

    def destroy_node(self) -> None:
        """Destroy the node, and end the process of its action."""
        if self.action is not None:
            self.action.close()
            self.action = None
        self.starting.close()
        super().destroy_node()

    def prepare_to_end(self) -> bool:
        """Bring the arm to rest first, unless the safe torque is zero; return whether it rests."""
        guard = self.guard
        if guard is None or not guard.commanding or self.config.safety.torque == 'zero':
            return True
        now = self.steady() * 1e-9
        messages = guard.journal.messages
        if not self._ends_at:
            self._ends_at = now + _LONGEST_END
            if guard.supervisor.running:
                self.deactivate()
        if messages > self._last_seen[0]:
            self._last_seen = messages, now
        return guard.is_settled or now > min(
            self._last_seen[1] + _SILENT, self._ends_at
        )

    def _begin_again(self, guard: Guard) -> None:
        """Look at the conditions of the start, if this node does not command now."""
        if guard.silenced or not guard.commanding:
            self.starting.look_around(self._outputs[topics.COMMANDS].topic_name)

    def _leave(self) -> None:
        """Command the torque that drivers may hold, and release the guard."""
        if self.guard is not None:
            self.command(self.guard.release())
            self.status.publish_events(self.guard)

    def reset(self) -> str:
        """Restart with the next joint state and the initial estimates."""
        if self.guard is not None:
            if self.guard.starting.error is not None:
                self.starting.measure()
            self._begin_again(self.guard)
            self.guard.starting.reset()
        self.failure = None
        self._report()
        return 'estimates cleared: starting with the next state'

    def _on_tare(self) -> str:
        return self._do(
            lambda guard: guard.findings.tare(), 'the external torque is zero here'
        )

    def _on_expect_last_load(self) -> str:
        return self._do(
            lambda guard: guard.expect_load(None), 'the last load is expected'
        )

    def _on_expected_load(self, message: Inertia) -> None:
        """Let the law expect a load of the tip: mass and centre of mass, no more of it."""
        centre = message.com.x, message.com.y, message.com.z
        try:
            self._do(
                lambda guard: guard.expect_load(TipLoad.given(message.m, centre)), ''
            )
        except BlfDscError as error:
            self.get_logger().warning(f'~/expected_load: {error}')

    def _do(self, act: Callable[[Guard], object], done: str) -> str:
        """Do what somebody asks for, and return that it is `done`.

        Raises:
            BlfDscError: it cannot be.
        """
        if self.guard is None:
            raise BlfDscError(
                f'{self.get_name()} is {self.state_label}: activate it first'
            )
        act(self.guard)
        self._report()
        return done

    # The loop.

    def _on_joint_state(self, raw: bytes) -> None:
        guard = self.guard
        if guard is None:
            return
        if self.starting.hold_early(guard, raw):
            self.report_if_changed(guard)
            return
        trajectories = self.status.trajectories
        if trajectories is not None and trajectories.job is not None:
            trajectories.poll(guard)
        try:
            if self.declaration is not None:
                self.declaration.follow(guard, in_motion=self.declaration.in_motion)
            torque = self._torque_for(guard, raw)
            self._write(topics.JOINT_STATES, raw)
            self.command(torque)
            guard.perceive()
        except Exception as error:  # noqa: BLE001 - the arm needs a torque after any error
            self.survive(error)
            return
        if guard.has_sample:
            self._look_at_what_rarely_changes(guard)
        self._publish_telemetry(torque)
        if self.action is not None:
            self.action.poll(guard)
        if guard.starting.waiting_for:
            self.get_logger().warning(
                f'not started, waiting for a usable joint state: {guard.starting.waiting_for}',
                throttle_duration_sec=WAITING_PERIOD,
            )
        self.report_if_changed(guard)

    def survive(self, error: Exception) -> bool:
        """Make a safe stop after an unexpected error."""
        if self.guard is None:
            return False
        self.get_logger().fatal(''.join(traceback.format_exception(error)))
        self.command(self.guard.fail(f'{type(error).__name__}: {error}'))
        self.report_if_changed(self.guard)
        return True

    def _torque_for(self, guard: Guard, raw: bytes) -> np.ndarray | None:
        """Return the torque (n,) [N m] for a joint state; None: command nothing."""
        try:
            stamp = self._decoder.decode(raw)
        except MessageError as error:
            foreign = guard.foreign
            torque = guard.reject(error)
            if guard.foreign != foreign:
                self.get_logger().warning(
                    f'ignored: {error}', throttle_duration_sec=10.0
                )
            return torque
        return guard.update(stamp, self._decoder.values)

    def _look_at_what_rarely_changes(self, guard: Guard) -> None:
        """Update from time to time what rarely changes: subscribers, learning, rate."""
        samples = guard.controller.samples
        if (samples - 1) % _RARELY == 0:
            errors = self._outputs.get(topics.TRACKING_ERROR)
            self._errors_subscribed = (
                errors is not None and errors.get_subscription_count() > 0
            )
            self._report_learning(guard)
            if samples == _RATE_SAMPLES:
                self._warn_of_rate(guard)

    def _publish_telemetry(self, torque: np.ndarray | None) -> None:
        """Publish the messages about the last state and its torque (n,) [N m]."""
        if self._loop is not None:
            for message in self._loop.messages(
                torque, errors_wanted=self._errors_subscribed or self.is_recorded
            ):
                self._publish(message)

    def _warn_of_rate(self, guard: Guard) -> None:
        period = guard.reference.time / (_RATE_SAMPLES - 1)
        expected = self.config.sample_time
        if period < _FAST * expected:
            self.get_logger().warning(rate_mismatch(period, expected))

    def _report_learning(self, guard: Guard) -> None:
        """Report columns that were rejected or restored, and changes of the arm."""
        if self.log.warn_of_learning(guard, self.status):
            self._report()

    def command(self, torque: np.ndarray | None) -> None:
        """Send torques (n,) [N m]; None: none."""
        if torque is not None:
            raw = self._encoder.encode(torque)
            self._senders[topics.COMMANDS](raw)
            self._write(topics.COMMANDS, raw)

    def _publish(self, message: topics.Message) -> None:
        super()._publish(message)
        self._write(*message)

    def _write(self, topic: topics.Topic, raw: bytes) -> None:
        """Give a message to the outputs beside the topics."""
        if self.is_recorded and self._loop is not None:
            stamp = max(self._loop.guard.journal.stamp, 0)
            self._loop.outputs.write(stamp, topic, raw)

    def _on_poll(self) -> bool:
        """Check for missing states."""
        self._changes.poll()
        guard = self.guard
        if self.action is not None:
            self.action.poll(guard)
        if guard is None:
            return False
        held = self.starting.take_held(guard)
        if held is not None:
            self._on_joint_state(held)
        self.command(guard.watch())
        self.report_if_changed(guard)
        is_watched = guard.watchdog.on and guard.commanding
        polled, self._polled = self._polled, guard.journal.messages
        return is_watched or self.starting.held is not None or polled != self._polled

    # Changes of the configuration, and reports.

    def _problems(self, config: ControllerConfig) -> list[str]:
        return [] if self.guard is None else self.guard.problems(config)

    def _check(self, before: ControllerConfig, after: ControllerConfig) -> list[str]:
        """Return what is worse than before; called beside the loop."""
        if self.guard is None:
            return []
        remedy = '; to use it anyway, start the node with it'
        return [text + remedy for text in worsened(before, after)]

    def _retune(self, config: ControllerConfig) -> None:
        self.config = config
        if self._loop is not None:
            message = self._loop.retune(config)
            if message is not None:
                self._publish(message)

    def report_if_changed(self, guard: Guard) -> None:
        """Publish new events, and diagnostics if they have changed."""
        if not self.status.has_news(guard):
            self.status.publish_events(guard)
            return
        self._started = self._started or guard.supervisor.running
        if (
            guard.starting.error is not None
            and self.config.autostart
            and not self._started
        ):
            self.failure = guard.starting.error
            self.finished = True
        self.log.warn_of_findings(guard)
        self.log.log_phase(guard, ends=self.finished)
        self._report()

    def on_second(self) -> None:
        """Look for what may appear or vanish beside this node, and report."""
        self._look_for_watchdog()
        if self.declaration is not None:
            self.declaration.look()
        super().on_second()
        guard = self.guard
        if guard is not None and guard.reference.start_stamp != self.warned_at:
            self.warned_at = guard.reference.start_stamp
            if not is_simulated(self):
                self.log.warn_of_start(guard)

    def _look_for_watchdog(self) -> None:
        commands = self._outputs.get(topics.COMMANDS)
        if commands is None or process.interrupted():
            return
        there = self._subscribers(commands, WATCHDOG) > 0
        if self._watchdog.look(there=there):
            self.get_logger().error(self._watchdog.problem)

    def _report(self) -> None:
        self.status.report(
            self.state_label, self.guard, self.others, self._watchdog.problem
        )


main = partial(process.run, ControllerNode)

if __name__ == '__main__':
    sys.exit(main())
