# SPDX-License-Identifier: Apache-2.0
"""The node `view`: feeds the page from the topics, and does by services what its controls ask for.

It is a process of its own that gives way to the control loop, takes the newest messages thirty
times a second, and asks for none that is lost. The controller's configuration is in its journal.
"""

from __future__ import annotations

import json
import os
import sys
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from queue import SimpleQueue
from typing import Any

import numpy as np
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import VIEW, ViewConfig, is_builtin
from blf_dsc_controller.configuration.schema import Value, build, change, flatten
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.cdr import MessageError, joint_state_layout
from blf_dsc_controller.messages.codecs import JointStateDecoder
from blf_dsc_controller.messages.journal import Event, EventType, decode
from blf_dsc_controller.messages.topics import Quality, Topic
from blf_dsc_controller.nodes.endpoints import create_steady_timer, message_class, qos_profile
from blf_dsc_controller.nodes.parameter_client import ParameterClient, Values
from blf_dsc_controller.nodes.parameters import declare
from blf_dsc_controller.nodes.process import PlainNode, run
from blf_dsc_controller.nodes.raw_subscriptions import RawMessage, RawSubscriptions
from blf_dsc_controller.nodes.rclpy_internals import take_response
from blf_dsc_controller.run import Floats
from blf_dsc_controller.view.arm import arm_of
from blf_dsc_controller.view.controls import Controls
from blf_dsc_controller.view.moment import Confidence, Moment, estimates_of
from blf_dsc_controller.view.page import LOCAL, PAST, Page, open_to_others

_PERIOD = 1.0 / 30.0  # s
_PLOTTED = 6  # pictures from one plot to the next
_CHECKED = 30  # pictures from one look at what is identified to the next
_SILENCE = 30  # pictures without a joint state after which the page says so
_PUSH = 0.5  # s
_OUTDATED = 500_000_000  # ns
_NICE = 10  # less urgent than the loop
_NEWEST = Quality(depth=1, reliability='best_effort')
_STREAMS = (topics.JOINT_STATES, topics.TRACKING_ERROR, topics.BOUND, topics.MONITOR, topics.TRUTH)
_EVENTS = (topics.JOURNAL, topics.CHANGES, topics.STATE, topics.DIAGNOSTICS)
_LEVELS = dict(enumerate(('OK', 'WARN', 'ERROR', 'STALE')))


class ViewNode(PlainNode):
    """Serves the page.

    Raises:
        ConfigurationError: a parameter is wrong.
        MissingExtraError: viser is not installed.
        BlfDscError: the page cannot be served at this host.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(VIEW, **options)
        config = declare(self, ViewConfig)
        self.page = Page(config.host, config.port)
        self.controls: Controls | None = None
        self.past: deque[Moment] = deque()
        self._config: ControllerConfig | None = None
        self._plant: dict[str, Any] = {}  # parameters of the simulated one
        self._acting: set[int] = set()  # which of its events
        self._state = 'STALE', f'waiting for {self.resolve_topic_name(topics.JOURNAL.relative)}'
        self._start = self._told = -1  # ns, stamps: of the start, of the last tracking error
        self._pictures = self._silent = 0
        self._clients_seen: frozenset[int] = frozenset()
        self._rejected = -1  # trajectories; -1: not known
        self._worker = ThreadPoolExecutor(1, 'confidence')
        self._check: Future[tuple[Floats, Floats]] | None = None
        self._asked: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._gains: dict[str, Value] = {}  # moved and not yet sent
        self._awaited: list[tuple[Any, Callable[[Any], None]]] = []
        self._push_ends = np.inf
        self._newest = self._subscribe(_STREAMS, _NEWEST)
        self._kept = self._subscribe(_EVENTS)
        node = self._newest.node
        self._names = {one: self._resolved(one) for one in (topics.CONTROLLER, topics.PLANT)}
        self._offered: dict[str, Any] = {
            f'{name}/{service}': node.create_client(type_, f'{name}/{service}')
            for name in self._names.values()
            for service, type_ in (('reset', Trigger), ('set_parameters', SetParameters))
        }
        self._reader = ParameterClient(self._meet_plant)
        self._reader.request(node, self._names[topics.PLANT])
        trajectory = topics.JOINT_TRAJECTORY
        self._trajectories = self.create_publisher(
            JointTrajectory, trajectory.relative, qos_profile(trajectory.offered)
        )
        self.get_logger().info(f'open {self.page.url}')
        if config.host not in LOCAL:
            self.get_logger().warning(open_to_others(config.host))
        create_steady_timer(self, _PERIOD, self.update)

    def _resolved(self, name: str) -> str:
        return f'{self.get_namespace().rstrip("/")}/{name}'

    def _subscribe(self, of: Sequence[Topic], quality: Quality | None = None) -> RawSubscriptions:
        made = RawSubscriptions(self, (quality or topics.HISTORY).depth)
        for handle, topic in enumerate(of):
            offered = topic.offered if quality is None or topic is topics.BOUND else quality
            made.subscribe(self.resolve_topic_name(topic.relative), topic.type, [offered], handle)
        return made

    def close(self) -> None:
        """End the page and the subscriptions."""
        self._worker.shutdown(wait=False, cancel_futures=True)
        self.page.close()
        self._newest.close()
        self._kept.close()

    def update(self) -> None:
        """Take what has come, do what was asked for, and draw."""
        self._reader.poll()
        for message in self._kept.take():
            self._note(_EVENTS[message.handle], message.raw)
        self._serve()
        config = self._config
        has_state = config is not None and self._take(self._newest.take())
        self._silent = 0 if has_state else self._silent + 1
        self.page.state(*self._health())
        clients = frozenset(self.page.server.get_clients())
        if config is not None and self.past and (has_state or clients != self._clients_seen):
            self._draw(config, clients)

    def _health(self) -> tuple[str, str]:
        """State of the controller, or that it says nothing any more."""
        if self._config is None or self._silent < _SILENCE:
            return self._state
        for topic, node in ((topics.TRACKING_ERROR, 'controller'), (topics.JOINT_STATES, 'arm')):
            if not self._newest.node.count_publishers(self.resolve_topic_name(topic.relative)):
                return 'ERROR', f'the {node} is gone: nobody publishes {topic.relative} any more'
        return self._state[0], f'{self._state[1]} (no joint state comes)'

    # What the page asks for, in its threads.

    def reset(self) -> None:
        """Reset the simulated plant, which resets the controller, or the controller alone."""

        def done(response: Trigger.Response) -> None:
            if not response.success:
                self.page.notify('reset', response.message)

        name = self._names[topics.PLANT if self._plant else topics.CONTROLLER]
        self._asked.put(partial(self._call, f'{name}/reset', Trigger.Request(), done))

    def push(self, torque: Sequence[float]) -> None:
        """Push the joints [N m] for half a second of the plant's time."""

        def begin() -> None:
            self._push_ends = self.past[-1].time + _PUSH if self.past else 0.0
            self._set(topics.PLANT, 'load.torque', tuple(torque))

        self._asked.put(begin)

    def payload(self, mass: float) -> None:
        """Hang a mass on the tip of the simulated arm [kg]."""
        self._asked.put(partial(self._set, topics.PLANT, 'load.payload', mass))

    def go_to(self, position: Mapping[str, float], duration: float) -> None:
        """Send a trajectory of one point: a position of each joint [rad] after a time [s]."""
        point = JointTrajectoryPoint(positions=list(position.values()))
        point.time_from_start.sec = int(duration)
        point.time_from_start.nanosec = int(1e9 * (duration % 1.0))
        message = JointTrajectory(joint_names=list(position), points=[point])
        self._asked.put(partial(self._trajectories.publish, message))

    def set_gain(self, name: str, value: Value) -> None:
        """Set a parameter of the controller: the last value in the time of a picture."""
        self._gains[name] = value

    # Services.

    def _serve(self) -> None:
        while not self._asked.empty():
            self._asked.get()()
        for name in list(self._gains):
            self._set(topics.CONTROLLER, name, self._gains.pop(name))
        if self.past and self.past[-1].time >= self._push_ends:
            self._push_ends = np.inf
            self._set(topics.PLANT, 'load.torque', self._pushes)
        for waiting in list(self._awaited):
            client, done = waiting
            response = take_response(client)
            if response is not None:
                self._awaited.remove(waiting)
                done(response)

    def _set(self, node: str, name: str, value: Value) -> None:
        content = list(value) if isinstance(value, tuple) else value
        parameters = [Parameter(name, value=content).to_parameter_msg()]

        def done(response: Any) -> None:
            (result,) = response.results
            if not result.successful:
                self.page.notify(f'{name} was rejected', result.reason)
                if self._config is not None and self.controls is not None:
                    self.controls.show(flatten(self._config))

        service = f'{self._names[node]}/set_parameters'
        self._call(service, SetParameters.Request(parameters=parameters), done)

    def _call(self, service: str, request: Any, done: Callable[[Any], None]) -> None:
        client = self._offered[service]
        if client.service_is_ready():
            client.call_async(request)
            self._awaited.append((client, done))
        else:
            self.page.notify(service, 'nobody offers this service: has the node ended?')

    # What comes.

    def _note(self, topic: Topic, raw: bytes) -> None:
        if topic is topics.JOURNAL:
            self._follow(decode(raw))
            return
        content: Any = deserialize_message(raw, message_class(topic.type))
        if topic is topics.STATE:
            self._state = _LEVELS[content.level[0]], content.message
        elif topic is topics.CHANGES:
            one = json.loads(content.data)
            self._plant |= one['parameters']
            for name, value in one['parameters'].items():
                self.page.event(self._time(one['stamp']), name, f'{value}')
        else:
            for status in content.status:
                self._note_rejection({pair.key: pair.value for pair in status.values})

    def _note_rejection(self, values: Mapping[str, str]) -> None:
        before = self._rejected
        self._rejected = int(values.get('trajectories rejected', before))
        if 0 <= before < self._rejected:
            self.page.notify('the reference was rejected', values['last rejection'])

    def _follow(self, event: Event) -> None:
        """Follow the controller's journal, which begins with all its parameters."""
        content = event.content
        if event.type is EventType.CONFIGURE:
            values = {k: v for k, v in content['parameters'].items() if not is_builtin(k)}
            self._configure(build(ControllerConfig, values))
            return
        if event.type is EventType.PARAMETERS and self._config is not None:
            self._config = change(self._config, content['parameters'])
            if self.controls is not None:
                self.controls.show(flatten(self._config))
        if event.type is EventType.START:
            self._start = event.stamp
            self.past.clear()
        told = [f'{content[k]}' for k in ('reason', 'text', 'parameters') if k in content]
        self.page.event(self._time(event.stamp), event.type.value, ', '.join(told))

    def _configure(self, config: ControllerConfig) -> None:
        self._config = config
        self._estimates = estimates_of(config)
        self._longest = 1.0 + max(PAST, config.learning.window)
        self._decoders = {
            topic: JointStateDecoder(config.joints, ('position',)) for topic in _STREAMS[:3]
        }
        self._learned = np.full(len(self._estimates) + 2, np.nan)
        self._truth = np.full(len(self._estimates), np.nan)
        self._confidence: Confidence | None = None
        self._draw_all()

    def _meet_plant(self, _: str, values: Values) -> None:
        self._plant = dict(values)
        self._pushes = values.get('load.torque', ())
        self._draw_all()

    def _draw_all(self) -> None:
        if self._config is not None:
            self.page.clear()
            lengths = [self._plant[name] for name in ('arm.l1', 'arm.l2') if name in self._plant]
            tabs = self.page.draw_arm(arm_of(self._config, lengths), self._estimates)
            self.controls = Controls(
                self.page.server.gui, tabs, self._config, self, simulated=bool(self._plant)
            )

    def _time(self, stamp: int) -> float:
        """Time [s] since the controller's start, or since the first stamp that is known."""
        if self._start < 0 <= stamp:
            self._start = stamp
        return max(0.0, (stamp - self._start) * 1e-9)

    def _take(self, messages: Sequence[RawMessage]) -> bool:
        """Take the newest of each topic; whether there was a joint state."""
        stamp = told = -1
        for message in messages:
            topic = _STREAMS[message.handle]
            try:
                if topic in self._decoders:
                    at = self._decoders[topic].decode(message.raw)
                    stamp = at if topic is topics.JOINT_STATES else stamp
                    told = at if topic is topics.TRACKING_ERROR else told
                elif topic is topics.TRUTH:
                    self._truth = _named(message.raw, (*self._estimates,))
                else:
                    figures = (topics.LAMBDA_MIN, topics.LATCHED)
                    self._learn(_named(message.raw, (*self._estimates, *figures)))
            except MessageError as error:
                self.get_logger().warning(f'not shown: {error}', throttle_duration_sec=10.0)
        self._told = max(told, self._told)
        if stamp >= 0:
            if stamp - self._told > _OUTDATED:  # the law does not run
                self._decoders[topics.TRACKING_ERROR].values[:] = np.nan
            self._keep(self._time(stamp))
        return stamp >= 0

    def _learn(self, values: Floats) -> None:
        before, self._learned = self._learned[-1], values
        if self.past and values[-1] != before and np.isfinite(before):
            text = 'an excited window' if values[-1] else 'restarts: the arm has changed'
            self.page.event(self.past[-1].time, 'learning', text)

    def _keep(self, time: float) -> None:
        state, error, bound = self._decoders.values()
        torque = state.effort if np.isnan(error.effort).any() else error.effort
        arrays = (state.position, error.position, bound.position, torque, bound.effort)
        q, xi1, k_c, tau, limit = (one.copy() for one in arrays)
        *estimate, lambda_min, _ = self._learned
        loaded = self._payload(time) > 0.0
        learned = np.array(estimate), self._truth, float(lambda_min), loaded
        self.past.append(Moment(time, q, xi1, k_c, tau, limit, *learned))
        while self.past[0].time < time - self._longest:
            self.past.popleft()

    def _payload(self, time: float) -> float:
        """Payload of the simulated arm [kg]; notes which of its events begin and end."""
        get = self._plant.get
        begin, duration = get('events.begin', ()), get('events.duration', ())
        masses = get('events.payload', ()) or (0.0,) * len(begin)
        acting = {
            k
            for k, (at, lasts) in enumerate(zip(begin, duration, strict=False))
            if at <= time < at + (lasts or np.inf)
        }
        for k in acting ^ self._acting:
            what = f'payload of {masses[k]:g} kg' if masses[k] else f'event {k + 1}'
            self.page.event(time, 'plant', f'{what} {"begins" if k in acting else "ends"}')
        self._acting = acting
        return float(get('load.payload', 0.0)) + sum(masses[k] for k in acting)

    def _draw(self, config: ControllerConfig, clients: frozenset[int]) -> None:
        self._pictures += 1
        past = list(self.past)
        if self._check is not None and self._check.done():
            self.page.learned(*self._check.result())
            self._check = None
        if self._check is None and self._pictures % _CHECKED == 0:
            self._check = self._worker.submit(self._deviations, config, past)
        if clients:
            self.page.move(past)
            if self._pictures % _PLOTTED == 0 or clients != self._clients_seen:
                self.page.plot(past)
        self._clients_seen = clients

    def _deviations(self, config: ControllerConfig, past: list[Moment]) -> tuple[Floats, Floats]:
        """Standard deviations before and after a window; compiles at first, beside the page."""
        confidence = self._confidence = self._confidence or Confidence(config)
        return confidence.prior, confidence.deviations(past)


def _named(raw: bytes, names: Sequence[str]) -> Floats:
    """Values (m,) of some names in a message, NaN where it does not have them."""
    decoder = JointStateDecoder(joint_state_layout(raw).names, ('position',))
    decoder.decode(raw)
    found = dict(zip(joint_state_layout(raw).names, decoder.position, strict=True))
    return np.array([found.get(name, np.nan) for name in names])


def main() -> int:
    """Run the node, less urgently than others."""
    os.nice(_NICE)
    return run(ViewNode)


if __name__ == '__main__':
    sys.exit(main())
