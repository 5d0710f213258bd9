# SPDX-License-Identifier: Apache-2.0
"""The node `blf_dsc_controller`: a torque for every joint state."""

from __future__ import annotations

import sys
import traceback
from functools import partial
from typing import Any

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.errors import StartError
from blf_dsc_controller.law import factory
from blf_dsc_controller.law.telemetry import ControllerTelemetry, rejected_columns
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import (
    Float64MultiArrayEncoder,
    JointStateDecoder,
    MessageError,
)
from blf_dsc_controller.nodes import parameters, process
from blf_dsc_controller.nodes.diagnostics import ControllerStatus
from blf_dsc_controller.nodes.lifecycle import LoopNode
from blf_dsc_controller.nodes.trajectory_input import TrajectoryInput
from blf_dsc_controller.supervision.checks import SAME_CLOCK, Phase, rate_mismatch
from blf_dsc_controller.supervision.gains import (
    ReferenceLoad,
    config_warnings,
    reference_load,
    worsened,
)
from blf_dsc_controller.supervision.guard import Guard

_RARELY = 10  # samples between looks at what rarely changes
_RATE_SAMPLES = 1001  # samples before the rate is checked
_FAST = 0.9  # fraction of the sample time
_MEASURED = 10  # intervals between live states, measured before the start ...
_ALIKE = 1.5  # ... which may differ from the sample time by this factor ...
_TYPICAL = 0.2, 0.5  # ... at these quantiles: a busy computer loses states between two others
_PATIENCE = 25  # checks without a newer state (0.2 s): a simulated arm waits for its first torque
_WAITING_PERIOD = 5.0  # s between two warnings
_LONGEST_END = 3.0  # s from a signal to the end; ros2 launch sends the next signal after 5 s
_SILENT = 0.1  # s without joint states, after which nothing is left to bring to rest


class ControllerNode(LoopNode[ControllerConfig]):
    """Commands a torque on `~/commands` for each joint state, and publishes telemetry.

    `guard` runs the guarded law; None until the node is configured.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(topics.CONTROLLER, ControllerConfig, **options)
        self.guard: Guard | None = None
        self._load: ReferenceLoad | None = None
        joints = self.config.joints
        self._estimates = factory.estimate_names(self.config)
        self._telemetry = ControllerTelemetry(self.config, self._estimates)
        self._columns = b''  # those that are estimated, and whether they were checked
        self._model_changes = 0.0
        self._decoder = JointStateDecoder(joints, required=('position',))
        self._encoder = Float64MultiArrayEncoder(len(joints))
        self._pending: bytes | None = None
        self._arrivals: list[int] | None = []  # stamps before the start [ns]; None: measured
        self._checks = 0  # of the timer since the last of them
        self._warned_at = -1  # stamp of the start that the last warning was about
        self._heard = False  # whether the tracking errors had subscribers at the last count
        self._observed = self._started = False
        self._logged = Phase.INACTIVE, 0, False  # phase, stops, silenced
        self._ends_at = 0.0  # s, at the latest, since a signal
        self._last_seen = 0, 0.0  # joint states processed by then, and when the last was
        self._status = ControllerStatus(self, joints)
        parameters.on_change(self, ControllerConfig, self._retune, self._problems)
        self.start()

    # Life cycle.

    def configure(self) -> None:
        """Compile the law; create the topics of the loop on the first call."""
        self.guard = Guard(self.config, self._steady, self._wall)
        self.guard.journal.pending[-1].content['topics'] = {
            topic.leaf: self.resolve_topic_name(topic.relative)
            for topic in (topics.JOINT_STATES, topics.COMMANDS)
        }
        self._load = reference_load(self.config, self.guard.controller.settings)
        for warning in config_warnings(self.config, load=self._load):
            self.get_logger().warning(warning)
        outputs = [topics.COMMANDS]
        if self.config.telemetry.enabled:
            outputs += [topics.REFERENCE, topics.TRACKING_ERROR, topics.BOUND, topics.MONITOR]
        if self.connect(outputs, topics.JOINT_STATES, self._on_joint_state):
            self._status.trajectories = TrajectoryInput(
                self, len(self.config.joints), lambda: self.guard
            )
        self._report()

    def activate(self) -> None:
        """Take command with the next joint state."""
        self._arrivals = []
        if self.guard is not None:
            self.guard.activate()
        self.get_logger().info(f'ready for joint states of {", ".join(self.config.joints)}')
        self._report()

    def deactivate(self) -> None:
        """Ramp to the safe torque, which is commanded for all joint states from then on."""
        if self.guard is not None:
            self.guard.deactivate()
        self.get_logger().info(f'deactivated: {self.config.safety.torque} torque')
        self._report()

    def release(self) -> None:
        """Command the torque to leave behind and release the law."""
        self._leave()
        self.guard = None
        self._report()

    def close(self) -> None:
        """Command the torque to leave behind, and wait until all subscribers have received it."""
        self._leave()
        process.drain([*self._outputs.values(), self._status.journal])

    def ready_to_end(self) -> bool:
        """Bring the arm to rest first, unless the safe torque is zero."""
        guard = self.guard
        if guard is None or not guard.commanding or self.config.safety.torque == 'zero':
            return True
        now, messages = self._steady() * 1e-9, guard.journal.messages
        if not self._ends_at:
            self._ends_at = now + _LONGEST_END
            if guard.supervisor.running:
                self.deactivate()
        if messages > self._last_seen[0]:
            self._last_seen = messages, now
        return guard.is_settled or now > min(self._last_seen[1] + _SILENT, self._ends_at)

    def _leave(self) -> None:
        """Command the torque that drivers may hold from now on, and release the guard."""
        if self.guard is not None:
            self._command(self.guard.release())
            self._status.publish_events(self.guard)

    def reset(self) -> str:
        """Restart with the next joint state and the initial estimates."""
        if self.guard is not None:
            if self.guard.start_error is not None:
                self._arrivals = []
            self.guard.reset()
        self.failure = None
        self._report()
        return 'estimates cleared: starting with the next state'

    # The loop.

    def _on_joint_state(self, raw: bytes) -> None:
        guard = self.guard
        if guard is None:
            return
        if not self._observed:
            self._observed = self._is_observed()
            if not self._observed:
                self._pending = raw
                return
        if self._arrivals is not None and self._measures_rate(guard, raw):
            return
        trajectories = self._status.trajectories
        if trajectories is not None and trajectories.job is not None:
            trajectories.poll(guard)
        try:
            torque = self._torque_for(guard, raw)
        except Exception as error:  # noqa: BLE001 - the arm needs a torque after any error
            self.survive(error)
            return
        self._command(torque)
        guard.weigh()
        if guard.has_sample:
            self._publish_telemetry(guard)
        elif torque is not None and self._heard:
            self._publish(self._telemetry.answer(guard.journal.stamp, torque))
        if guard.waiting_for:
            self.get_logger().warning(
                f'not started, waiting for a usable joint state: {guard.waiting_for}',
                throttle_duration_sec=_WAITING_PERIOD,
            )
        self._report_if_changed(guard)

    def _measures_rate(self, guard: Guard, raw: bytes) -> bool:
        """Measure the rate of live states before the start; return whether to wait for more.

        At another rate than that of `sample_time` the gains are wrong, up to instability. A live
        arm whose support is not known is refused, too.
        """
        try:
            stamp = self._decoder.decode(raw)
        except MessageError:
            return False
        if guard.supervisor.phase is not Phase.STARTING or self._arrivals is None:
            return False
        if abs(self._wall() - stamp) * 1e-9 >= SAME_CLOCK:  # a plant in lock-step waits
            self._arrivals = None
            return False
        if self._arrivals and stamp <= self._arrivals[-1]:
            return True
        self._arrivals.append(stamp)
        self._pending, self._checks = raw, 0
        if len(self._arrivals) <= _MEASURED:
            return True
        often, period = 1e-9 * np.quantile(np.diff(self._arrivals), _TYPICAL)
        self._arrivals, self._pending = None, None
        T = self.config.sample_time
        if period <= T / _ALIKE or often >= T * _ALIKE:
            guard.refuse(StartError(rate_mismatch(period, T)))
        else:
            guard.check_support(self._decoder.values)
        self._report_if_changed(guard)
        return guard.start_error is not None

    def survive(self, error: Exception) -> bool:
        """Make a safe stop after an unexpected error, instead of leaving the arm without torque."""
        if self.guard is None:
            return False
        self.get_logger().fatal(''.join(traceback.format_exception(error)))
        self._command(self.guard.fail(f'{type(error).__name__}: {error}'))
        self._report_if_changed(self.guard)
        return True

    def _torque_for(self, guard: Guard, raw: bytes) -> np.ndarray | None:
        try:
            stamp = self._decoder.decode(raw)
        except MessageError as error:
            foreign = guard.foreign
            torque = guard.reject(error)
            if guard.foreign != foreign:
                self.get_logger().warning(f'ignored: {error}', throttle_duration_sec=10.0)
            return torque
        return guard.update(stamp, self._decoder.values)

    def _publish_telemetry(self, guard: Guard) -> None:
        controller, stamp = guard.controller, guard.last_stamp
        sample, samples = controller.sample, controller.samples
        if (samples - 1) % _RARELY == 0:
            errors = self._outputs.get(topics.TRACKING_ERROR)
            self._heard = errors is not None and errors.get_subscription_count() > 0
            self._report_learning(guard)
            if samples == _RATE_SAMPLES:
                self._warn_of_rate(guard)
        if not self.config.telemetry.enabled:
            return
        if samples == 1:
            self._telemetry.restart()
        limit, ratio = controller.settings.torque_limit, guard.samples.ratio
        for message in self._telemetry.sample(
            stamp, sample, limit, ratio, guard.compute_time, heard=self._heard
        ):
            self._publish(message)

    def _warn_of_rate(self, guard: Guard) -> None:
        period, expected = guard.time / (_RATE_SAMPLES - 1), self.config.sample_time
        if period < _FAST * expected:
            self.get_logger().warning(rate_mismatch(period, expected))

    def _report_learning(self, guard: Guard) -> None:
        """Report columns that were rejected or taken back, and changes of the arm."""
        state = guard.controller.state
        columns = state.active.tobytes() + state.columns_checked.tobytes()
        has_changed = state.changes[0] > self._model_changes
        self._model_changes = state.changes[0]
        if has_changed:
            residual = state.contradiction[0] ** 0.5
            self.get_logger().warning(
                f'the arm has changed: torques differ by {residual:.3g} N m from those learned; '
                'learning restarts'
            )
        if columns != self._columns:
            self._columns = columns
            self._status.rejected = rejected_columns(guard.controller, self._estimates)
            for reason in self._status.rejected.values():
                self.get_logger().warning(reason)
            has_changed |= bool(self._status.rejected)
        if has_changed:
            self._report()

    def _command(self, torque: np.ndarray | None) -> None:
        if torque is not None:
            self._senders[topics.COMMANDS](self._encoder.encode(torque))

    def _on_poll(self) -> None:
        """Check for missing states; a timer reset by its own callback would multiply under load."""
        guard = self.guard
        if guard is not None:
            self._checks += 1
            measures = self._arrivals and self._checks < _PATIENCE
            if self._pending is not None and not measures and self._is_observed():
                raw, self._pending = self._pending, None
                self._arrivals = None if self._arrivals else self._arrivals
                self._on_joint_state(raw)
            self._command(guard.watch())
            self._report_if_changed(guard)

    # Changes of the configuration, and reports.

    def _problems(self, config: ControllerConfig) -> list[str]:
        if self.guard is None or self._load is None:
            return []
        remedy = '; to use it anyway, start the node with it'
        warnings = [text + remedy for text in worsened(self.config, config, self._load)]
        return self.guard.problems(config) + warnings

    def _retune(self, config: ControllerConfig) -> None:
        self.config, guard = config, self.guard
        if guard is not None:
            guard.retune(config)
            if guard.last_stamp >= 0 and config.telemetry.enabled:
                bound = guard.controller.bound_at(guard.time)
                limit = guard.controller.settings.torque_limit
                self._publish(self._telemetry.bound(guard.journal.stamp, bound, limit))

    def _report_if_changed(self, guard: Guard) -> None:
        if not self._status.has_news(guard):
            return
        supervisor = guard.supervisor
        self._log_phase(guard)
        self._started = self._started or supervisor.running
        if guard.start_error is not None and self.config.autostart and not self._started:
            self.failure, self.finished = guard.start_error, True
        self._report()

    def _on_second(self) -> None:
        super()._on_second()
        guard = self.guard
        if guard is not None and guard.watchdog.why_off and guard.start_stamp != self._warned_at:
            self._warned_at = guard.start_stamp
            found = self.get_publishers_info_by_topic(topics.JOINT_STATES.relative)
            if any(each.node_name != topics.PLANT for each in found):  # which waits in lock-step
                self.get_logger().warning(guard.watchdog.why_off)

    def _log_phase(self, guard: Guard) -> None:
        supervisor = guard.supervisor
        now = supervisor.phase, supervisor.stops, guard.silenced
        if now == self._logged:
            return
        self._logged = now
        if guard.silenced:
            self.get_logger().warning(supervisor.text)
        elif supervisor.phase is Phase.SAFE_STOP:
            stop = f'{self.config.safety.torque} torque: {supervisor.text}'
            self.get_logger().fatal(f'{stop}; {self.get_fully_qualified_name()}/reset starts again')
        elif supervisor.phase is Phase.APPROACHING:
            left = guard.settled - guard.time
            self.get_logger().info(f'approaching the reference, for {left:.3g} s')
        elif supervisor.phase is Phase.TRACKING:
            self.get_logger().info('tracking the reference')

    def _report(self) -> None:
        self._status.report(self.state_label, self.guard, self.others)


main = partial(process.run, ControllerNode)

if __name__ == '__main__':
    sys.exit(main())
