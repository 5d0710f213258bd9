# SPDX-License-Identifier: Apache-2.0
"""The node `blf_dsc_controller`: a torque for every joint state."""

from __future__ import annotations

import sys
from time import perf_counter
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType

from blf_dsc_controller import assembly
from blf_dsc_controller.bags import topics
from blf_dsc_controller.bags.decoders import JointStateDecoder
from blf_dsc_controller.bags.errors import MessageError
from blf_dsc_controller.bags.telemetry import DECIMATION, ControllerTelemetry, Message
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.core.settings import pack
from blf_dsc_controller.nodes import compilation, executor, parameters, realtime
from blf_dsc_controller.nodes.endpoints import publisher, subscribe

_NANO = 1e-9
_READINESS_PERIOD = 0.01  # s
_DIAGNOSTICS_PERIOD = 1.0  # s

OUTPUTS = (
    topics.COMMANDS,
    topics.REFERENCE,
    topics.TRACKING_ERROR,
    topics.LEARNING,
    topics.BOUND,
    topics.MONITOR,
)


class ControllerNode(executor.RunnableNode):
    """Answers each joint state with a torque on `~/commands`, and tells how it goes.

    Attributes:
        config: the configuration in force.
        controller: the law with its state.
        stopped: why only zero torque is commanded any more; empty while the law is running.
        finished: never; the node runs until it is stopped.
    """

    def __init__(self, **options: Any) -> None:
        """Read the parameters, compile the law, and wait for joint states.

        Raises:
            ConfigurationError: the parameters do not describe a law that can run.
        """
        super().__init__(topics.CONTROLLER, **options)
        self.config = parameters.declare(self, ControllerConfig)
        if not compilation.is_compiled(*compilation.CONTROLLER):
            self.get_logger().info(compilation.NOTICE)
        self.controller = assembly.controller_of(self.config)
        self.stopped = ''
        joints = self.config.joints
        self._telemetry = ControllerTelemetry(joints, assembly.estimate_names(self.config))
        self._decoder = JointStateDecoder(joints)
        self._measurement = np.zeros(3 * len(joints))
        self._start_stamp = -1
        self._last_stamp = -1
        self._repeated = 0
        self._outside = 0
        self._ratio = np.zeros(len(joints))
        outputs = OUTPUTS if self.config.telemetry.enabled else OUTPUTS[:1]
        self._publisher_of = {topic: publisher(self, topic) for topic in outputs}
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._pending: bytes | None = None
        self._readiness = self.create_timer(_READINESS_PERIOD, self._answer_pending, clock=steady)
        self.create_timer(_DIAGNOSTICS_PERIOD, self._report, clock=steady)
        parameters.on_change(self, ControllerConfig, self._retune)
        subscribe(self, topics.JOINT_STATES, self._on_joint_state)
        realtime.request(self.config.realtime, self.get_logger())
        self.get_logger().info(f'ready for joint states of {", ".join(joints)}')

    def close(self) -> None:
        """See that every subscriber has the last messages."""
        executor.drain(self._publisher_of.values())

    def _on_joint_state(self, raw: bytes) -> None:
        if self._start_stamp < 0 and not self._is_observed():
            self._pending = raw
            return
        try:
            stamp = self._decoder.decode(raw)
        except MessageError as error:
            self._stop(str(error))
            self._publish(self._telemetry.command(np.zeros(len(self.config.joints))))
            return
        self._answer(stamp)

    def _answer(self, stamp: int) -> None:
        n = len(self.config.joints)
        self._measurement[:n] = self._decoder.position
        self._measurement[n : 2 * n] = self._decoder.velocity
        self._measurement[2 * n :] = self._decoder.effort
        if not np.isfinite(self._measurement[: 2 * n]).all():
            self._stop(f'the joint state is not finite: {self._measurement[: 2 * n]}')
        if self.stopped:
            self._publish(self._telemetry.command(np.zeros(n)))
            return
        if self._start_stamp < 0:
            self.controller.check_start(self.config.joints, self._measurement[:n])
            self._start_stamp = stamp
            self._last_stamp = stamp - self.config.sample_time_ns
            self._publish_bound(stamp)
        if stamp <= self._last_stamp:
            self._repeated += 1
            return
        self._control(stamp)

    def _control(self, stamp: int) -> None:
        begin = perf_counter()
        torque = self.controller.update(
            (stamp - self._start_stamp) * _NANO,
            (stamp - self._last_stamp) * _NANO,
            self._measurement,
        )
        compute_time = perf_counter() - begin
        self._last_stamp = stamp
        if not np.isfinite(torque).all():
            self._stop(f'the law gave a torque that is not finite: {torque}')
            torque = np.zeros(len(self.config.joints))
        self._publish(self._telemetry.command(torque))
        self._watch_bound()
        if self.config.telemetry.enabled:
            self._tell(stamp, compute_time)

    def _tell(self, stamp: int, compute_time: float) -> None:
        told = self.controller.sample
        for message in self._telemetry.sample(stamp, told, compute_time):
            self._publish(message)
        if (self.controller.samples - 1) % DECIMATION == 0:
            self._publish(self._telemetry.monitor(stamp, told, self._ratio))

    def _watch_bound(self) -> None:
        ratio = np.abs(self.controller.sample.xi1) / self.controller.settings.bound
        np.maximum(self._ratio, ratio, out=self._ratio)
        if ratio.max() >= 1.0:
            self._outside += 1

    def _publish(self, message: Message) -> None:
        topic, raw = message
        self._publisher_of[topic].publish(raw)

    def _publish_bound(self, stamp: int) -> None:
        if self.config.telemetry.enabled:
            settings = self.controller.settings
            self._publish(self._telemetry.bound(stamp, settings.bound, settings.torque_limit))

    def _is_observed(self) -> bool:
        observers = self.config.wait_for_subscribers
        for topic, output in self._publisher_of.items():
            needed = observers + 1 if topic is topics.COMMANDS else observers
            if output.get_subscription_count() < needed:
                return False
        return True

    def _answer_pending(self) -> None:
        if self._start_stamp >= 0:
            self._readiness.cancel()
        elif self._pending is not None and self._is_observed():
            raw, self._pending = self._pending, None
            self._on_joint_state(raw)

    def _retune(self, config: ControllerConfig) -> None:
        self.config = config
        self.controller.settings_vector[:] = pack(assembly.settings_of_config(config))
        if self._last_stamp >= 0:
            self._publish_bound(self._last_stamp)

    def _stop(self, reason: str) -> None:
        if not self.stopped:
            self.stopped = reason
            self.get_logger().fatal(f'zero torque from now on: {reason}')

    def _report(self) -> None:
        level, message = self._verdict()
        values = {
            'samples': f'{self.controller.samples}',
            'repeated or late states passed over': f'{self._repeated}',
            'samples outside the bound': f'{self._outside}',
            'lambda_min': f'{self.controller.state.lambda_min[0]:.3g}',
            'learning': 'latched' if self.controller.state.latched[0] else 'not yet excited',
        }
        array = DiagnosticArray()
        array.header.stamp = self.get_clock().now().to_msg()
        array.status = [
            DiagnosticStatus(
                level=level,
                name=f'{self.get_name()}: control loop',
                message=message,
                hardware_id=' '.join(self.config.joints),
                values=[KeyValue(key=key, value=value) for key, value in values.items()],
            )
        ]
        self._diagnostics.publish(array)

    def _verdict(self) -> tuple[bytes, str]:
        if self.stopped:
            return DiagnosticStatus.ERROR, f'stopped: {self.stopped}'
        if self._outside:
            return DiagnosticStatus.ERROR, 'the tracking error has left its bound'
        if self._start_stamp < 0:
            return DiagnosticStatus.WARN, 'waiting for the first joint state'
        return DiagnosticStatus.OK, 'tracking'


def main() -> int:
    """Run the node as a process."""
    return executor.run(ControllerNode)


if __name__ == '__main__':
    sys.exit(main())
