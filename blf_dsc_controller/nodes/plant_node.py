# SPDX-License-Identifier: Apache-2.0
"""The node `sim_plant`: the simulated arm and the time base of the loop.

In lock-step, a step is taken when the torque for the last state has arrived:
deterministic, and as fast as the machine allows. In real time, a step is taken each
sample time of the steady clock; if the new torque is late, the last one is held and the
delay published, but a torque older than `actuator.command_timeout` is not applied. The
arm is braked until the first torque arrives.

Load, events, disturbance and encoder offsets can be changed at run time, from the next
sample on; `~/changes` publishes the time, so that an event at that time repeats the
run.

A reset returns the arm to its start, which no real arm does by itself. The node
therefore also resets the controller, if there is one, before it sends the first state
and, in real time, at the end of its duration.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from functools import partial
from math import inf, nan
from typing import Any

from rclpy.timer import Timer
from std_msgs.msg import String
from std_srvs.srv import Trigger

from blf_dsc_controller.configuration.nodes import CONTROLLER, PLANT
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import Value, differences, flatten
from blf_dsc_controller.control.status_report import ERROR, OK, STALE, WARN, Part
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import Float64MultiArrayDecoder
from blf_dsc_controller.messages.errors import MessageError
from blf_dsc_controller.messages.journal import Change
from blf_dsc_controller.messages.plant_telemetry import PlantTelemetry
from blf_dsc_controller.nodes import parameters, process
from blf_dsc_controller.nodes.diagnostics import DiagnosticsPublisher
from blf_dsc_controller.nodes.endpoints import create_publisher, create_steady_timer
from blf_dsc_controller.nodes.lifecycle import LoopNode
from blf_dsc_controller.run import FIRST_STAMP
from sim_plant.plant import plant_of
from sim_plant.sampled_plant import Plant
from sim_plant.settings import parameter_names_of, plant_settings, steps_of, urdf_of
from sim_plant.torque_input import Latency, TorqueInput

_STALE = {
    'zero': 'none is applied until another comes',
    'hold': 'it is still applied',
}
_REPEAT_PERIOD = 3.0  # s, until a state without a torque is sent again
# samples in lock-step on their way to a subscriber: a fifth of its queue
_IN_FLIGHT = 1000
_EARLY = 0.05  # fraction of a sample by which a timer may fire early
# ns from the last stamp before a reset to the first after it
_BETWEEN_RUNS = 1_000_000_000
# s from the discovery of all peers until they have discovered this node
_SETTLING_TIME = 0.2
_RESET_TIMEOUT = 2.0  # s for the controller to respond


class PlantNode(LoopNode[PlantConfig]):
    """Node that publishes measured joint states and applies the received torques.

    Attributes:
        latency: measures how long, in real time, the arm waits for its torques.
        start_stamp: stamp of the plant's begin [ns].
        is_offered: whether the first state was published, once its peers are there.
        has_torque: whether a torque has answered the last state.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(PLANT, PlantConfig, **options)
        parameters.Changes(self, self.config, self._reconfigure)
        self.latency = Latency()
        joints = self.config.joints
        self._steps = steps_of(self.config)
        self._lockstep = self.config.mode == 'lockstep'
        published = self.config.sensor.published_joints
        self._telemetry = PlantTelemetry(
            joints, parameter_names_of(self.config), published
        )
        self._decoder = Float64MultiArrayDecoder(len(joints))
        self.input = TorqueInput(len(joints))
        self._reported_rejected = 0
        self._diagnostics = DiagnosticsPublisher(self, joints)
        self._step_timer: Timer | None = None
        self.start_stamp = FIRST_STAMP
        self._changed: dict[str, Value] = {}
        self._changes = create_publisher(self, topics.CHANGES)
        self._tell_parameters()
        self._controller = self.create_client(Trigger, f'{CONTROLLER}/reset')
        self.plant: Plant
        self.deactivate()
        self.start()

    def _now(self) -> float:
        return self.steady() * 1e-9

    # Life cycle.

    def configure(self) -> None:
        """Put the arm at its start; create the topics on the first call."""
        self.plant = plant_of(self.config)
        self._halt = ''  # why the arm stands still until a reset
        if self._changed:
            self._tell_parameters()
        self._changed.clear()
        self.plant.compile()
        self.deactivate()
        outputs = [topics.JOINT_STATES, topics.TRUTH]
        outputs += [] if self._lockstep else [topics.TIMING]
        both = self.config.sensor.side == 'both'
        outputs += [topics.MOTOR_STATES] if both else []
        outputs += [topics.CLOCK] if self.config.publish_clock else []
        if self.connect(outputs, topics.COMMANDS, self._on_command):
            description = create_publisher(self, topics.ROBOT_DESCRIPTION)
            description.publish(String(data=urdf_of(self.config)))

    def activate(self) -> None:
        """Send the present state once a controller subscribes, then use its torque."""
        self._peers = self._wait_for_peers(reset=False)
        self.get_logger().info(f'{self.config.mode}, waiting for a controller')

    def deactivate(self) -> None:
        """Stop time: the arm stays where it is, and torques are not applied."""
        self.is_offered = self._running = False
        self.has_torque = True
        self._published = self._began = 0.0
        self._first = 0
        self._torque_waits = self._stale = False
        if self._step_timer is not None:
            self.destroy_timer(self._step_timer)
            self._step_timer = None

    release = deactivate

    def close(self) -> None:
        """Wait until every subscriber has received the last messages."""
        process.drain(self._outputs.values())

    def reset(self) -> str:
        """Return the arm to its start, braked, and then reset the controller."""
        self.start_stamp = self.stamp + _BETWEEN_RUNS
        self.deactivate()
        self.plant.reset()
        self._halt = ''
        self._apply_changes()
        self.input.torque[:] = 0.0
        self._peers = self._wait_for_peers(reset=True)
        return 'the arm is at its start, braked until the first torque arrives'

    @property
    def stamp(self) -> int:
        """Time of the present sample [ns]."""
        return self.start_stamp + self.plant.elapsed_ns

    # The loop.

    def _on_poll(self) -> bool:
        if self.finished or self.state_label != 'active':
            return False
        waits = (self._lockstep or not self._running) and not self.has_torque
        if not self.is_offered:
            if not next(self._peers, False):
                self._offer()
        elif waits and self._now() - self._published > _REPEAT_PERIOD:
            self.get_logger().info('no torque yet: sending the state again')
            self._publish_state()
        return waits

    def _wait_for_peers(self, *, reset: bool) -> Iterator[bool]:
        """Yield True until the first state can be sent.

        With `reset`, the wait also lets torques of the previous run expire, and the
        controller is reset if it offers the service; any other controller must be reset
        by hand.
        """
        settled = inf
        while self._now() < settled:
            settled = (
                min(settled, self._now() + _SETTLING_TIME)
                if self.is_observed()
                else inf
            )
            yield True
        response = self._reset_controller() if reset else None
        if response is None:
            return
        while not response.done() and self._now() < settled + _RESET_TIMEOUT:
            yield True
        if not response.done():
            self.get_logger().warning('the controller did not respond to the reset')
        elif not response.result().success:
            self.get_logger().warning(
                f'no reset of the controller: {response.result().message}'
            )

    def _reset_controller(self) -> Any:
        """Request a reset of the controller; return the future, or None."""
        ready = self._controller.service_is_ready()
        return self._controller.call_async(Trigger.Request()) if ready else None

    def _offer(self) -> None:
        """Publish the first state, after incomplete ones; if a torque waits, go on at once."""
        if not self._lockstep:
            self.start_stamp = self.wall() - self.plant.elapsed_ns
        self.is_offered = True
        measurement = self.plant.measure().copy()
        measurement[len(self.config.joints) :] = nan
        for ahead in range(self.config.sensor.incomplete_states, 0, -1):
            stamp = self.stamp - ahead * self.config.sample_time_ns
            self._publish(self._telemetry.joint_states(stamp, measurement))
        if self._lockstep and self._torque_waits:
            self._running = True
            self._advance()
        else:
            self._publish_state()

    def _on_command(self, raw: bytes) -> None:
        """Take a torque: the first one releases the brake, and in lock-step each is a step."""
        try:
            size = self._decoder.decode(raw)
        except MessageError as error:
            self.get_logger().error(
                f'command rejected: {error}', throttle_duration_sec=1.0
            )
            return
        if not self.is_offered and self.state_label != 'inactive':
            return
        if not self.input.take(size, self._decoder.values, self.plant.sample):
            self.get_logger().error(self.input.problem, throttle_duration_sec=1.0)
            return
        if not self.is_offered:
            self._torque_waits = self.plant.sample > 0
            return
        self.latency.torque_received(self._now())
        self.has_torque = True
        if not self._running:
            self.get_logger().info('first torque received: brake off')
            self._release_brake()
        if self._lockstep:
            self._advance()

    def _release_brake(self) -> None:
        """Let the arm move from the present sample on."""
        self._running = True
        self._began = self._now()
        self.latency = Latency()  # without the wait for the controller's start
        self._first = self.plant.sample
        self.input.renew(self.plant.sample)
        if not self._lockstep:
            self._step_timer = create_steady_timer(
                self, self.config.sample_time, self._on_step_timer
            )

    def _on_step_timer(self) -> None:
        """Integrate all steps that are due; a late process catches up."""
        if not self._running:  # the timer was destroyed while this call was pending
            return
        elapsed = self._now() - self._began
        due = self._first + int(elapsed / self.config.sample_time + _EARLY)
        while self.plant.sample < due and not self._end_if_over():
            waited = self.latency.step(self._now())
            deadline = (self.plant.sample + 1 - self._first) * self.config.sample_time
            self._advance()
            lateness = max(0.0, self._now() - self._began - deadline)
            late_steps = self.latency.late_steps
            self._publish(
                self._telemetry.timing(self.stamp, waited, lateness, late_steps)
            )

    def _advance(self) -> None:
        """Integrate a sample with the last torque, if it is not too old; publish the state."""
        if self._end_if_over():
            return
        was_stale = self._stale
        limit = self.config.actuator.command_timeout
        samples = round(limit / self.config.sample_time)
        self._stale = not self._lockstep and self.input.count_stale(
            self.plant.sample, samples
        )
        if self._stale and self.config.actuator.without_command == 'zero':
            self.input.torque[:] = 0.0
        self._step()
        self._apply_changes()
        self._publish_state()
        if self._stale and not was_stale:
            self.get_logger().error(self._stale_text, throttle_duration_sec=1.0)
            self._report()

    @property
    def _stale_text(self) -> str:
        actuator = self.config.actuator
        after = _STALE[actuator.without_command]
        return (
            'the last torque is too old '
            f'(actuator.command_timeout, {actuator.command_timeout:g} s): {after}. The controller '
            'has ended, or it or this computer is too slow'
        )

    def _step(self) -> None:
        """Integrate a sample; say so if a reflex of the drives has stopped the arm."""
        torque = self.input.torque
        self.plant.step(torque)
        if self._halt or not self.plant.is_stopped:
            return
        rate = self.config.actuator.reflex_rate
        self._halt = (
            f'reflex: the commands jumped to {torque}, faster than {rate:g} N m/s or N/s: the arm '
            'stands still until it is reset'
        )
        self.get_logger().error(self._halt)
        self._report()

    def _end_if_over(self) -> bool:
        """End after the last step; return whether that has been."""
        if 0 < self._steps <= self.plant.sample and not self.finished:
            self.finished = True
            if not self._lockstep:  # a controller would take the silence for a fault
                self._reset_controller()
        return self.finished

    def _publish_state(self) -> None:
        if self._lockstep and self.plant.sample % _IN_FLIGHT == 0:
            # the loop must not outrun its recorder
            process.drain(self._outputs.values())
        stamp = self.stamp
        measurement = self.plant.measure()
        self.has_torque = False
        self._published = self._now()
        self.latency.state_published(self._published)
        for message in self._telemetry.states(
            self.plant.sample,
            stamp,
            measurement,
            self.plant.motor_reading,
            self.plant.truth,
        ):
            self._publish(message)
        if self.config.publish_clock:
            self._publish(self._telemetry.clock(stamp))

    def _tell_parameters(self) -> None:
        """Publish all parameters, in force from the start."""
        given = flatten(self.config)
        self._changes.publish(Change(self.start_stamp, given, configured=True).encode())

    def _reconfigure(self, config: PlantConfig) -> None:
        self._changed |= differences(self.config, config)
        self.config = config

    def _apply_changes(self) -> None:
        """Apply changed parameters at the present sample, before it is published."""
        if not self._changed:
            return
        self.plant.change(plant_settings(self.config))
        self._changes.publish(Change(self.stamp, self._changed).encode())
        self._changed = {}

    def _report(self) -> None:
        """Publish diagnostics, with a level for all since the last report."""
        rejected = self.input.rejected
        values = {
            'rejected commands': rejected,
            'steps with a torque that was too old': self.input.stale_steps,
            'late steps': self.latency.late_steps,
        }
        level, message = OK, 'running'
        if self.state_label != 'active':
            level, message = STALE, self.state_label
        elif self.others:
            level = ERROR
            message = 'another node publishes joint states, too'
        elif not self._running:
            level = WARN
            message = 'braked: waiting for the first torque'
        elif self._halt:
            level, message = ERROR, self._halt
        elif self._stale:
            level, message = ERROR, self._stale_text
        elif rejected > self._reported_rejected:
            level, message = WARN, self.input.problem
        self._reported_rejected = rejected
        self._diagnostics.publish(Part('torque', level, message, values))


main = partial(process.run, PlantNode)


if __name__ == '__main__':
    sys.exit(main())
