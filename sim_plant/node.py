# SPDX-License-Identifier: Apache-2.0
"""The node `sim_plant`: the arm, and the owner of time.

Lock-step takes the next step when the torque for the last state has arrived: deterministic, as fast
as the machine allows.  Real time takes a step each sample time of the steady clock, holding the
last torque where the new one is late, and says how late.  In both the arm stands braked at its
first state until the first torque comes.
"""

from __future__ import annotations

import sys
import time
from time import perf_counter
from typing import Any

import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.timer import Timer

from blf_dsc_controller.bags import topics
from blf_dsc_controller.bags.decoders import Float64MultiArrayDecoder
from blf_dsc_controller.bags.telemetry import DECIMATION, Message, PlantTelemetry
from blf_dsc_controller.core.two_link import PARAMETER_NAMES
from blf_dsc_controller.nodes import compilation, executor, parameters, realtime
from blf_dsc_controller.nodes.endpoints import publisher, subscribe
from blf_dsc_controller.nodes.latency import Latency
from sim_plant.assembly import plant_of, steps_of
from sim_plant.configuration import PlantConfig

LOCKSTEP_START = 1_000_000_000
"""First stamp in lock-step [ns]: a zero stamp says 'not set' in ROS."""

_READINESS_PERIOD = 0.01  # s
_SETTLING = 0.2  # s from having found every peer until they have found this node too
_REPEAT_PERIOD = 3.0  # s, for a first state that nobody has answered
_EARLY = 0.05  # of a sample: a timer that fires this much early is on time


class PlantNode(executor.RunnableNode):
    """Publishes measured joint states and applies the torques that answer them.

    Attributes:
        config: the configuration.
        plant: the simulated arm.
        finished: True once `duration` has passed and the last state has been answered.
        rejected: commands passed over because of their length or a number that is not finite.
        latency: how long, in real time, the arm waits for its torques.
    """

    def __init__(self, **options: Any) -> None:
        """Read the parameters and wait until a controller listens.

        Raises:
            ConfigurationError: the parameters do not describe a plant.
        """
        super().__init__(topics.PLANT, **options)
        self.config = parameters.declare(self, PlantConfig)
        self.plant = plant_of(self.config)
        self._compile()
        self.rejected = 0
        self.latency = Latency()
        joints = self.config.joints
        self._steps = steps_of(self.config)
        self._lockstep = self.config.mode == 'lockstep'
        self._telemetry = PlantTelemetry(joints, PARAMETER_NAMES)
        self._decoder = Float64MultiArrayDecoder(len(joints))
        self._torque = np.zeros(len(joints))
        self._start_stamp = LOCKSTEP_START
        self._published = 0.0
        self._publisher_of = {topic: publisher(self, topic) for topic in self._output_topics()}
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._began = 0.0
        self._observed_since = 0.0
        self._beat: Timer | None = None
        self._readiness = self.create_timer(_READINESS_PERIOD, self._try_start, clock=self._steady)
        subscribe(self, topics.COMMANDS, self._on_command)
        realtime.request(self.config.realtime, self.get_logger())
        self.get_logger().info(f'{self.config.mode}, waiting for a controller')

    def _compile(self) -> None:
        if not compilation.is_compiled(*compilation.PLANT):
            self.get_logger().info(compilation.NOTICE)
        self.plant.measure()
        self.plant.truth()
        self.plant.step(np.zeros(len(self.config.joints)))
        self.plant.reset()

    def close(self) -> None:
        """See that every subscriber has the last messages."""
        executor.drain(self._publisher_of.values())

    @property
    def stamp(self) -> int:
        """Time of the present sample [ns]."""
        return self._start_stamp + self.plant.elapsed_ns

    def _output_topics(self) -> tuple[topics.Topic, ...]:
        outputs = [topics.JOINT_STATES, topics.TRUTH]
        if not self._lockstep:
            outputs.append(topics.TIMING)
        if self.config.publish_clock:
            outputs.append(topics.CLOCK)
        return tuple(outputs)

    def _try_start(self) -> None:
        if self._began:
            if perf_counter() - self._published > _REPEAT_PERIOD:
                self.get_logger().info('no torque yet: sending the first state again')
                self._publish_state()
        elif not self._is_observed():
            self._observed_since = 0.0
        elif not self._observed_since:
            self._observed_since = perf_counter()
        elif perf_counter() - self._observed_since > _SETTLING:
            if not self._lockstep:
                self._start_stamp = time.time_ns()
            self._began = perf_counter()
            self._publish_state()

    def _is_observed(self) -> bool:
        observers = self.config.wait_for_subscribers
        for topic, output in self._publisher_of.items():
            needed = observers + 1 if topic is topics.JOINT_STATES else observers
            if output.get_subscription_count() < needed:
                return False
        return True

    def _on_command(self, raw: bytes) -> None:
        size = self._decoder.decode(raw)
        if size != self._torque.size or not np.isfinite(self._decoder.data).all():
            self.rejected += 1
            self.get_logger().error(
                f'command passed over: {size} values, {self._torque.size} expected'
                if size != self._torque.size
                else f'command passed over: not finite: {self._decoder.data}',
                throttle_duration_sec=1.0,
            )
            return
        if not self._began:
            return
        self._torque[:] = self._decoder.data
        self.latency.answered(perf_counter())
        if self.plant.sample == 0 and not self._readiness.is_canceled():
            self._readiness.cancel()
            self.get_logger().info('first torque received: brake off')
            self._release()
        if self._lockstep:
            self._advance()

    def _release(self) -> None:
        self._began = perf_counter()
        self.latency = Latency()  # what it has waited for the controller's start is not counted
        if not self._lockstep:
            self._beat = self.create_timer(
                self.config.sample_time, self._on_beat, clock=self._steady
            )

    def _on_beat(self) -> None:
        """Take every step that is due: time does not wait for a late process."""
        elapsed = perf_counter() - self._began
        due = int(elapsed / self.config.sample_time + _EARLY)
        while self.plant.sample < due and not self.finished:
            waited = self.latency.step(perf_counter())
            deadline = (self.plant.sample + 1) * self.config.sample_time
            self._advance()
            self._tell_timing(waited, max(0.0, perf_counter() - self._began - deadline))

    def _advance(self) -> None:
        if self._steps and self.plant.sample >= self._steps:
            self.finished = True
            return
        self.plant.step(self._torque)
        self._publish_state()

    def _publish_state(self) -> None:
        stamp = self.stamp
        measurement = self.plant.measure()
        self._published = perf_counter()
        self.latency.asked(self._published)
        self._publish(self._telemetry.joint_states(stamp, measurement))
        if self.plant.sample % DECIMATION == 0:
            self._publish(self._telemetry.truth(stamp, self.plant.truth()))
        if self.config.publish_clock:
            self._publish(self._telemetry.clock(stamp))

    def _tell_timing(self, waited: float, lateness: float) -> None:
        if not self.finished:
            late_steps = self.latency.late_steps
            self._publish(self._telemetry.timing(self.stamp, waited, lateness, late_steps))

    def _publish(self, message: Message) -> None:
        topic, raw = message
        self._publisher_of[topic].publish(raw)


def main() -> int:
    """Run the node as a process."""
    return executor.run(PlantNode)


if __name__ == '__main__':
    sys.exit(main())
