# SPDX-License-Identifier: Apache-2.0
"""Buttons and sliders of the live page, and what they ask of the nodes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from math import inf
from queue import SimpleQueue
from typing import Any

from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import Kind, Parameter, Value, flatten, parameters
from blf_dsc_controller.messages import topics
from blf_dsc_controller.nodes.endpoints import qos_profile, take_response

_GAINS = ('barrier', 'surface', 'feedback', 'disturbance', 'torque', 'learning')
_OF_OTHER_LAWS = ('comparison',)
_OWN = ('blf_dsc', 'model_based')
_HEADROOM = 4.0  # end of a slider without a limit, as a multiple of the current value
_STEPS = 400
_PUSH = 0.5  # s


class Requests:
    """What the controls ask of the nodes: queued in the page's threads, sent by `update`."""

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
        message = [RosParameter(name, value=content).to_parameter_msg()]

        def done(response: Any) -> None:
            (result,) = response.results
            if not result.successful:
                self._notify(f'{name} was rejected', result.reason)
                self._restore()

        service = f'{self._names[node]}/set_parameters'
        self._call(service, SetParameters.Request(parameters=message), done)

    def _call(self, service: str, request: Any, done: Callable[[Any], None]) -> None:
        client = self._clients[service]
        if client.service_is_ready():
            client.call_async(request)
            self._pending.append((client, done))
        else:
            self._notify(service, 'this service is not available: has the node exited?')


class Controls:
    """The tabs `Try` and `Gains` of a page.

    Attributes:
        buttons: by their label.
        sliders: by the name of the gain, one for each entry.
    """

    def __init__(
        self, gui: Any, tabs: Any, config: ControllerConfig, actions: Requests, *, simulated: bool
    ) -> None:
        self._gui, self._actions = gui, actions
        self.buttons: dict[str, Any] = {}
        self.sliders: dict[str, list[Any]] = {}
        with tabs.add_tab('Try'):
            self._button('Reset', actions.reset, 'return to the start, forget what was learned')
            if simulated:
                self._add_disturbances(config.joints)
            self._add_reference(config)
        values = flatten(config)
        with tabs.add_tab('Gains'):
            for group in (*_GAINS, *(_OF_OTHER_LAWS if config.law not in _OWN else ())):
                gains = [gain for gain in live_gains() if gain.name.startswith(f'{group}.')]
                with gui.add_folder(group, expand_by_default=group == 'feedback'):
                    for gain in gains:
                        self._add_gain(gain, values[gain.name], config.joints)

    def show(self, changed: Mapping[str, Value]) -> None:
        """Move the sliders of these parameters to the values in force."""
        for name, value in changed.items():
            for slider, entry in zip(self.sliders.get(name, ()), _entries(value), strict=False):
                slider.max = max(slider.max, entry)
                slider.value = entry

    def _button(self, label: str, action: Callable[[], None], hint: str) -> None:
        button = self.buttons[label] = self._gui.add_button(label, hint=hint)
        button.on_click(lambda _: action())

    def _add_disturbances(self, joints: Sequence[str]) -> None:
        joint = self._gui.add_dropdown('joint', tuple(joints), hint='joint to push')
        torque = self._gui.add_slider('push [N m]', -10.0, 10.0, 0.1, 2.0)
        self._button(
            'Push',
            lambda: self._actions.push([torque.value * (name == joint.value) for name in joints]),
            'push this joint with this torque for half a second',
        )
        mass = self._gui.add_slider('payload [kg]', 0.0, 5.0, 0.05, 0.5)
        self._button('Pick up', lambda: self._actions.payload(mass.value), 'attach this payload')
        self._button('Put down', lambda: self._actions.payload(0.0), 'remove the payload')

    def _add_reference(self, config: ControllerConfig) -> None:
        limits = zip(config.limits.position_lower, config.limits.position_upper, strict=True)
        offset = config.reference.offset
        sliders = {}
        for k, (joint, (low, high)) in enumerate(zip(config.joints, limits, strict=True)):
            at = min(max(offset[k] if k < len(offset) else 0.0, low), high)
            sliders[joint] = self._gui.add_slider(f'{joint} [rad]', low, high, 0.001, at)
        duration = self._gui.add_slider('in [s]', 0.5, 20.0, 0.1, 4.0)
        self._button(
            'Go there',
            lambda: self._actions.go_to(
                {joint: slider.value for joint, slider in sliders.items()}, duration.value
            ),
            'move there and stay; Reset returns to the configured reference',
        )

    def _add_gain(self, gain: Parameter, value: Value, joints: Sequence[str]) -> None:
        entries = _entries(value)
        names = joints if gain.kind.is_array else ('',)
        low = gain.above if gain.at_least is None else gain.at_least
        high = gain.below if gain.at_most is None else gain.at_most
        top = high or _HEADROOM * max((*entries, 0.0)) or 1.0
        step = top / _STEPS
        bottom = step if gain.above is not None else low or 0.0
        unit = f' [{gain.unit}]' if gain.unit else ''
        label = gain.name.rsplit('.', 1)[-1]
        limit = f'; {gain.allowed}' if gain.allowed else ''
        sliders = self.sliders[gain.name] = []
        for name, entry in zip(names, entries, strict=True):
            slider = self._gui.add_slider(
                f'{label} {name}{unit}',
                min(bottom, entry),
                top,
                step,
                entry,
                hint=f'{gain.symbol or gain.name}: {gain.description}{limit}',
            )
            sliders.append(slider)

        def changed(event: Any) -> None:
            if event.client is not None:  # moved by hand, not by `show`
                given = tuple(float(slider.value) for slider in sliders)
                self._actions.set_gain(gain.name, given if gain.kind.is_array else given[0])

        for slider in sliders:
            slider.on_update(changed)


def live_gains() -> Iterable[Parameter]:
    """Yield the controller's gains, scalar or per joint, that can change while it runs."""
    for gain in parameters(ControllerConfig):
        scalar = gain.kind is Kind.DOUBLE
        if not gain.read_only and (scalar or gain.length == ('joints',)):
            yield gain


def _entries(value: Any) -> tuple[float, ...]:
    return tuple(value) if isinstance(value, tuple) else (value,)
