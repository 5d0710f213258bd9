# SPDX-License-Identifier: Apache-2.0
"""The node `sim_plant`: the arm, and the owner of time.

Lock-step takes the next step when the torque for the last state has arrived: deterministic, as fast
as the machine allows.  Real time takes a step each sample time of the steady clock, holding the
last torque where the new one is late, and says how late; past `actuator.command_timeout` it holds
it no longer.  In both the arm stands braked at its first state until the first torque comes.

A reset takes the arm back to its start, which no real arm does by itself: so it is this node that
asks the controller, if there is one, to start anew before it sends the first state.
"""

from __future__ import annotations

import sys
import time
from time import perf_counter
from typing import Any

import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.publisher import Publisher
from rclpy.timer import Timer
from std_msgs.msg import String
from std_srvs.srv import Trigger

from blf_dsc_controller.arms.two_link import PARAMETER_NAMES
from blf_dsc_controller.arms.two_link_urdf import urdf
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.decoders import Float64MultiArrayDecoder
from blf_dsc_controller.messages.errors import MessageError
from blf_dsc_controller.messages.telemetry import DECIMATION, Message, PlantTelemetry
from blf_dsc_controller.nodes import compilation, executor, parameters, realtime
from blf_dsc_controller.nodes.endpoints import are_observed, publisher, subscribe
from blf_dsc_controller.nodes.latency import Latency
from blf_dsc_controller.nodes.lifecycle import ManagedNode
from sim_plant import plant as plant_kernels
from sim_plant.command_input import Reception
from sim_plant.factory import plant_of, steps_of
from sim_plant.handshake import Handshake
from sim_plant.sampled import Plant
from sim_plant.status import PlantStatus

LOCKSTEP_START = 1_000_000_000
"""First stamp in lock-step [ns]: a zero stamp says 'not set' in ROS."""

_TICK = 0.01  # s
_REPEAT_PERIOD = 3.0  # s, for a state that nobody has answered
_DIAGNOSTICS_PERIOD = 1.0  # s
_EARLY = 0.05  # of a sample: a timer that fires this much early is on time
_BETWEEN_RUNS = 1_000_000_000  # ns from the last stamp before a reset to the first after it


class PlantNode(ManagedNode):
    """Publishes measured joint states and applies the torques that answer them.

    Attributes:
        config: the configuration.
        plant: the simulated arm.
        reception: the torques that came.
        latency: how long, in real time, the arm waits for its torques.
    """

    def __init__(self, **options: Any) -> None:
        """Read the parameters and, with `autostart`, wait until a controller listens.

        Raises:
            ConfigurationError: the parameters do not describe a plant.
        """
        super().__init__(topics.PLANT, **options)
        self.config = parameters.declare(self, PlantConfig)
        parameters.on_change(self, PlantConfig, self._reconfigure)
        self.latency = Latency()
        joints = self.config.joints
        self._steps = steps_of(self.config)
        self._lockstep = self.config.mode == 'lockstep'
        self._telemetry = PlantTelemetry(joints, PARAMETER_NAMES)
        self._decoder = Float64MultiArrayDecoder(len(joints))
        self.reception = Reception(joints)
        self._publisher_of: dict[topics.Topic, Publisher] = {}
        self._status = PlantStatus(self, joints)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._beat: Timer | None = None
        self._start_stamp = LOCKSTEP_START
        self._handshake = Handshake(self)
        self.create_timer(_TICK, self._tick, clock=self._steady)
        self.create_timer(_DIAGNOSTICS_PERIOD, self._report, clock=self._steady)
        self.create_service(Trigger, '~/reset', self._on_reset)
        self.plant: Plant
        self._rest()
        if self.config.autostart:
            self.autostart()

    def _rest(self) -> None:
        """Stand still: neither offering a state nor running."""
        self._offered = self._running = self._active = False
        self._answered = True
        self._published = self._began = 0.0
        self._first = 0
        self._answer_waits = self._stale = False
        if self._beat is not None:
            self.destroy_timer(self._beat)
            self._beat = None

    # The life of the node.

    def configure(self) -> None:
        """Put the arm at its start; from the first time on, its topics are there."""
        if not compilation.is_compiled(*plant_kernels.KERNELS):
            self.get_logger().info(compilation.NOTICE)
        self.plant = plant_of(self.config)
        self.plant.measure()
        self.plant.truth()
        self.plant.step(np.zeros(len(self.config.joints)))
        self.plant.reset()
        self._rest()
        if not self._publisher_of:
            self._publisher_of = {topic: publisher(self, topic) for topic in self._output_topics()}
            self._publish_description()
            subscribe(self, topics.COMMANDS, self._on_command)
            realtime.request(self.config.realtime, self.get_logger())

    def _publish_description(self) -> None:
        limits = self.config.actuator.torque_limit
        text = urdf(topics.PLANT, self.config.joints, self.config.arm, limits)
        publisher(self, topics.ROBOT_DESCRIPTION).publish(String(data=text))

    def activate(self) -> None:
        """Send the present state once a controller listens, and go on from its answer."""
        self._active = True
        self._handshake.begin(ask=False)
        self.get_logger().info(f'{self.config.mode}, waiting for a controller')

    def deactivate(self) -> None:
        """Stop time: the arm stays where it is, and torques are not applied."""
        self._rest()

    def release(self) -> None:
        """Let go of the arm."""
        self._rest()

    def close(self) -> None:
        """See that every subscriber has the last messages."""
        executor.drain(self._publisher_of.values())

    def _on_reset(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = self._active
        if not response.success:
            response.message = f'{self.get_name()} is {self.state_label}: activate it first'
            return response
        self._start_stamp = self.stamp + _BETWEEN_RUNS
        self._rest()
        self._active = True
        self.plant.reset()
        self.reception.restart()
        self._handshake.begin(ask=True)
        response.message = 'the arm is at its start, braked until the first torque comes'
        return response

    @property
    def rejected(self) -> int:
        """Commands passed over because of their length or a number that is not finite."""
        return self.reception.rejected

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

    # The loop.

    def _tick(self) -> None:
        if not self._active or self.finished:
            return
        if not self._offered:
            if self._handshake.is_done(observed=self._is_observed()):
                self._offer()
        elif self._is_overdue():
            self.get_logger().info('no torque yet: sending the state again')
            self._publish_state()

    def _is_overdue(self) -> bool:
        waits = self._lockstep or not self._running
        silent = perf_counter() - self._published
        return waits and not self._answered and silent > _REPEAT_PERIOD

    def _offer(self) -> None:
        if not self._lockstep:
            self._start_stamp = time.time_ns() - self.plant.elapsed_ns
        self._offered = True
        if self._lockstep and self._answer_waits:
            self._running = True
            self._advance()
        else:
            self._publish_state()

    def _is_observed(self) -> bool:
        observers = self.config.wait_for_subscribers
        return are_observed(self._publisher_of, topics.JOINT_STATES, observers)

    def _on_command(self, raw: bytes) -> None:
        try:
            size = self._decoder.decode(raw)
        except MessageError as error:
            self.get_logger().error(f'command passed over: {error}', throttle_duration_sec=1.0)
            return
        if not self._offered and self.state_label != 'inactive':
            return
        if not self.reception.take(size, self._decoder.data, self.plant.sample):
            self.get_logger().error(self.reception.complaint, throttle_duration_sec=1.0)
            return
        if not self._offered:
            self._answer_waits = self.plant.sample > 0
            return
        self.latency.answered(perf_counter())
        self._answered = True
        if not self._running:
            self.get_logger().info('first torque received: brake off')
            self._release()
        if self._lockstep:
            self._advance()

    def _release(self) -> None:
        self._running = True
        self._began = perf_counter()
        self.latency = Latency()  # what it has waited for the controller's start is not counted
        self._first = self.plant.sample
        self.reception.renew(self.plant.sample)
        if not self._lockstep:
            self._beat = self.create_timer(
                self.config.sample_time, self._on_beat, clock=self._steady
            )

    def _on_beat(self) -> None:
        """Take every step that is due: time does not wait for a late process."""
        if not self._running:  # the timer was destroyed with this beat on its way
            return
        elapsed = perf_counter() - self._began
        due = self._first + int(elapsed / self.config.sample_time + _EARLY)
        while self.plant.sample < due and not self.finished:
            waited = self.latency.step(perf_counter())
            deadline = (self.plant.sample + 1 - self._first) * self.config.sample_time
            self._advance()
            self._tell_timing(waited, max(0.0, perf_counter() - self._began - deadline))

    def _advance(self) -> None:
        if self._steps and self.plant.sample >= self._steps:
            self.finished = True
            return
        was_stale, self._stale = self._stale, self._is_stale()
        if self._stale and self.config.actuator.without_command == 'brake':
            self.plant.hold()
        else:
            if self._stale:
                self.reception.torque[:] = 0.0
            self.plant.step(self.reception.torque)
        self._publish_state()
        if self._stale and not was_stale:
            self.get_logger().error('the torque is too old and not applied any more')
            self._report()

    def _is_stale(self) -> bool:
        if self._lockstep:
            return False
        limit = round(self.config.actuator.command_timeout / self.config.sample_time)
        return self.reception.is_stale(self.plant.sample, limit)

    def _publish_state(self) -> None:
        stamp = self.stamp
        measurement = self.plant.measure()
        self._answered = False
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

    def _reconfigure(self, config: PlantConfig) -> None:
        self.config = config

    def _report(self) -> None:
        phase = 'running' if self._running else 'waiting' if self._active else self.state_label
        self._status.report(phase, self.reception, self.latency.late_steps)


def main() -> int:
    """Run the node as a process."""
    return executor.run(PlantNode)


if __name__ == '__main__':
    sys.exit(main())
