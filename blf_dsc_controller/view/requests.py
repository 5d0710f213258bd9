# SPDX-License-Identifier: Apache-2.0
"""Actions of the page's controls on a running system, by services, parameters and topics."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from math import inf
from queue import SimpleQueue
from typing import Any

from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from blf_dsc_controller.configuration.schema import Value
from blf_dsc_controller.messages import topics
from blf_dsc_controller.nodes.endpoints import qos_profile
from blf_dsc_controller.nodes.rclpy_internals import take_response

_PUSH = 0.5  # s


class Requests:
    """The `Actions` of the controls: queued in the page's threads, carried out by `update`."""

    def __init__(
        self,
        node: Node,
        waiting: Node,
        prefix: str,
        notify: Callable[[str, str], None],
        restore: Callable[[], None],
    ) -> None:
        """Create the publisher and the clients.

        `node` publishes; `waiting` is in no executor, so that its responses are taken here.
        `prefix` precedes the names of controller and plant. `notify` shows a title and a text;
        `restore` shows the parameters in force after a request was rejected.
        """
        self._names = {name: f'{prefix}/{name}' for name in (topics.CONTROLLER, topics.PLANT)}
        self._clients: dict[str, Any] = {
            f'{name}/{service}': waiting.create_client(type_, f'{name}/{service}')
            for name in self._names.values()
            for service, type_ in (('reset', Trigger), ('set_parameters', SetParameters))
        }
        trajectory = topics.JOINT_TRAJECTORY
        self._trajectories = node.create_publisher(
            JointTrajectory, trajectory.relative, qos_profile(trajectory.offered)
        )
        self._notify, self._restore = notify, restore
        self._queue: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._gains: dict[str, Value] = {}  # moved but not yet sent
        self._pending: list[tuple[Any, Callable[[Any], None]]] = []
        self._has_plant = False
        self._torque: Value = ()  # without a push [N m]
        self._time, self._push_ends = 0.0, inf

    def meet_plant(self, values: Mapping[str, Value]) -> None:
        """Store the parameters of the simulated arm, once it has responded."""
        self._has_plant, self._torque = True, values.get('load.torque', ())

    def reset(self) -> None:
        """Reset the simulated plant, which resets the controller; without one, the controller."""

        def done(response: Trigger.Response) -> None:
            if not response.success:
                self._notify('reset', response.message)

        name = self._names[topics.PLANT if self._has_plant else topics.CONTROLLER]
        self._queue.put(partial(self._call, f'{name}/reset', Trigger.Request(), done))

    def push(self, torque: Sequence[float]) -> None:
        """Push the joints by these torques [N m] for half a second of plant time."""

        def begin() -> None:
            self._push_ends = self._time + _PUSH
            self._set(topics.PLANT, 'load.torque', tuple(torque))

        self._queue.put(begin)

    def payload(self, mass: float) -> None:
        """Attach a mass [kg] to the tip of the simulated arm."""
        self._queue.put(partial(self._set, topics.PLANT, 'load.payload', mass))

    def go_to(self, position: Mapping[str, float], duration: float) -> None:
        """Send a trajectory of one point: joint positions [rad] reached after `duration` [s]."""
        point = JointTrajectoryPoint(positions=list(position.values()))
        point.time_from_start.sec = int(duration)
        point.time_from_start.nanosec = int(1e9 * (duration % 1.0))
        message = JointTrajectory(joint_names=list(position), points=[point])
        self._queue.put(partial(self._trajectories.publish, message))

    def set_gain(self, name: str, value: Value) -> None:
        """Set a parameter of the controller; the next update sends the last value."""
        self._gains[name] = value

    def update(self, time: float) -> None:
        """Send the queued requests at a plant time [s], and process the responses."""
        self._time = time
        while not self._queue.empty():
            self._queue.get()()
        for name in list(self._gains):
            self._set(topics.CONTROLLER, name, self._gains.pop(name))
        if time >= self._push_ends:
            self._push_ends = inf
            self._set(topics.PLANT, 'load.torque', self._torque)
        for waiting in list(self._pending):
            client, done = waiting
            response = take_response(client)
            if response is not None:
                self._pending.remove(waiting)
                done(response)

    def _set(self, node: str, name: str, value: Value) -> None:
        content = list(value) if isinstance(value, tuple) else value
        parameters = [Parameter(name, value=content).to_parameter_msg()]

        def done(response: Any) -> None:
            (result,) = response.results
            if not result.successful:
                self._notify(f'{name} was rejected', result.reason)
                self._restore()

        service = f'{self._names[node]}/set_parameters'
        self._call(service, SetParameters.Request(parameters=parameters), done)

    def _call(self, service: str, request: Any, done: Callable[[Any], None]) -> None:
        client = self._clients[service]
        if client.service_is_ready():
            client.call_async(request)
            self._pending.append((client, done))
        else:
            self._notify(service, 'this service is not available: has the node exited?')
