# SPDX-License-Identifier: Apache-2.0
"""The node `view`, which feeds the page from the topics.

It runs in its own low-priority process, takes the newest messages thirty times a
second, and tolerates lost ones. The controller's configuration comes from its journal.
"""

from __future__ import annotations

import json
import os
import sys
from collections import deque
from collections.abc import Mapping, Sequence
from math import inf
from typing import Any

import numpy as np
from rclpy.serialization import deserialize_message

from blf_dsc_controller.analysis.report import LEVELS
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import VIEW, ViewConfig
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.law.factory import estimate_names
from blf_dsc_controller.law.telemetry import external_names
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import (
    JointStateDecoder,
    MessageError,
    joint_state_layout,
)
from blf_dsc_controller.messages.journal import (
    Event,
    EventType,
    contact_in,
    decode,
)
from blf_dsc_controller.messages.topics import Topic
from blf_dsc_controller.nodes.endpoints import (
    RawSubscriptions,
    create_steady_timer,
    message_class,
)
from blf_dsc_controller.nodes.parameters import declare
from blf_dsc_controller.nodes.process import PlainNode, run
from blf_dsc_controller.run import Floats
from blf_dsc_controller.view.model_error import ModelError
from blf_dsc_controller.view.page import PAST, Page, Snapshot, contact_text

_PERIOD = 1.0 / 30.0  # s
_PLOTTED = 6  # frames between updates of the plots
_PAUSE = 1.0  # s without targets, after which another stream is listed
_SILENCE = 30  # frames without a joint state before the page reports it
_OUTDATED = 500_000_000  # ns
_LISTED = 12  # events
_KEPT = 2000  # snapshots of a run
_NICE = 10  # lower priority than the loop
_LOCAL = ('127.0.0.1', 'localhost')  # hosts that only this computer can reach
_STREAMS = (
    topics.JOINT_STATES,
    topics.TRACKING_ERROR,
    topics.BOUND,
    topics.MONITOR,
    topics.TRUTH,
    topics.EXTERNAL_TORQUE,
)
_LATCHED = (topics.BOUND, topics.JOURNAL, topics.CHANGES, topics.STATE)
_FIGURES = (
    *topics.TOOL,
    *topics.LOAD,
    topics.LAMBDA_MIN,
    topics.CONTACT[0],
    topics.LATCHED,
)


class ViewNode(PlainNode):
    """Node that serves the page.

    Raises:
        ConfigurationError: a parameter is invalid.
        MissingExtraError: viser is not installed.
        BlfDscError: the page cannot be served at this host.

    Attributes:
        page: what is served.
        past: the snapshots of the last `PAST` seconds.
        run: snapshots of the whole run, at most `_KEPT`, evenly spaced.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(VIEW, **options)
        config = declare(self, ViewConfig)
        self.page = Page(config.host, config.port)
        self.past: deque[Snapshot] = deque()
        self.run: list[Snapshot] = []
        self._stride, self._taken = 1, 0  # of the snapshots that are kept
        self._is_offered = False  # whether the page offers to replay them
        self._config: ControllerConfig | None = None
        self._plant: dict[str, Any] = {}  # parameters of the simulated plant
        self._events: deque[tuple[float, str, str]] = deque(maxlen=_LISTED)
        self._noted = -1.0  # s, time up to which the plant's events are on the page
        self._state = (
            'STALE',
            f'waiting for a controller ({self.resolve_topic_name(topics.JOURNAL.relative)})',
        )
        self._start = self._sampled = -1  # ns, stamps of start and last tracking error
        self._pictures = self._silent = 0
        self._last_target = -inf  # s
        self._finished = False  # the controller has released the arm
        self._clients_seen: frozenset[int] = frozenset()
        self._raw_subscriptions = RawSubscriptions(self)
        for topic in {*_STREAMS, *_LATCHED, topics.TARGETS}:
            quality = topics.UNRELIABLE if topic in _STREAMS else topic.requested
            self._raw_subscriptions.follow(topic, quality)
        self.get_logger().info(f'open {self.page.url}')
        if config.host not in _LOCAL:
            self.get_logger().warning(
                f'at {config.host} the page is open to other computers, without a password'
            )
        create_steady_timer(self, _PERIOD, self.update)

    def close(self) -> None:
        """Close the page and the subscriptions."""
        self.page.close()
        self._raw_subscriptions.close()

    def update(self) -> None:
        """Process new messages and draw."""
        streams: dict[Topic, bytes] = {}
        for message in self._raw_subscriptions.take():
            if message.handle in _STREAMS:
                streams[message.handle] = message.raw
            else:
                self._note(message.handle, message.raw)
        has_state = self._config is not None and self._take(streams)
        self._silent = 0 if has_state else self._silent + 1
        self.page.state(*self._health())
        self.page.events(list(self._events))
        self._offer_replay()
        before = self._clients_seen
        self._clients_seen = frozenset(self.page.server.get_clients())
        is_new = before != self._clients_seen
        if self.past and self._clients_seen and (has_state or is_new):
            self._pictures += 1
            self.page.move(list(self.past))
            if self._pictures % _PLOTTED == 0 or is_new:
                self.page.plot(list(self.past))

    def _offer_replay(self) -> None:
        """Let the page replay a run that has ended, until another one begins."""
        has_ended = self._finished and self._silent >= _SILENCE
        if has_ended != self._is_offered:
            self._is_offered = has_ended
            self.page.offer_replay(list(self.run) if has_ended else [])

    def _keep_for_replay(self, snapshot: Snapshot) -> None:
        """Keep every `_stride`-th snapshot of the run; thin them out if too many."""
        if self._taken % self._stride == 0:
            self.run.append(snapshot)
        self._taken += 1
        if len(self.run) > _KEPT:
            del self.run[1::2]
            self._stride *= 2

    def _health(self) -> tuple[str, str]:
        """Return the state of the controller, or that it or the arm has gone silent."""
        if self._config is None or self._silent < _SILENCE:
            return self._state
        if self._finished:
            return 'OK', 'finished: the controller has ended normally'
        for topic, node in (
            (topics.TRACKING_ERROR, 'controller'),
            (topics.JOINT_STATES, 'arm'),
        ):
            if not self.count_publishers(topic.relative):
                return (
                    'ERROR',
                    f'the {node} is gone: {topic.relative} is no longer published',
                )
        return self._state[0], f'{self._state[1]} (no joint states received)'

    # Events.

    def _note(self, topic: Topic, raw: bytes) -> None:
        if topic is topics.JOURNAL:
            self._follow(decode(raw))
            return
        if topic is topics.TARGETS:
            self._list_motion(decode(raw))
            return
        content: Any = deserialize_message(raw, message_class(topic.type))
        if topic is topics.STATE:
            self._state = LEVELS[content.level[0]], content.message
            return
        said = json.loads(content.data)
        if said.get('configured'):
            self._plant = said['parameters']
            self._noted = -1.0
            if self._config is not None:
                self.page.draw_arm(self._config, self._plant)
            return
        self._plant |= said['parameters']
        for name, value in said['parameters'].items():
            self._events.append((self._time(said['stamp']), name, f'{value}'))

    def _follow(self, event: Event) -> None:
        """Follow the controller's journal, which begins with all its parameters."""
        content = event.content
        if event.type is EventType.CONFIGURE:
            self._configure(build(ControllerConfig, content['parameters']))
            return
        self._finished = event.type is EventType.RELEASE
        if event.type is EventType.START:
            self._start, self._noted = event.stamp, -1.0
            self.past.clear()
            self.run.clear()
            self._stride, self._taken = 1, 0
        details = [
            f'{content[k]}' for k in ('reason', 'text', 'parameters') if k in content
        ]
        if event.type is EventType.CONTACT:
            _, joint, torque, interval, _ = contact_in(event)
            details = [contact_text(joint, torque, interval)]
        self._events.append(
            (self._time(event.stamp), event.type.value, ', '.join(details))
        )

    def _list_motion(self, event: Event) -> None:
        """List a trajectory, and a stream of targets when it begins."""
        time = self._time(event.stamp)
        if event.type is EventType.TARGET:
            if not 0.0 <= time - self._last_target < _PAUSE:
                self._events.append((time, 'stream', 'of targets'))
            self._last_target = time
            return
        points = len(event.content['points'])
        self._events.append((time, event.type.value, f'{points} points'))

    def _configure(self, config: ControllerConfig) -> None:
        self._config = config
        estimates = estimate_names(config)
        joints = config.joints
        names = (
            *[joints] * 3,
            (*estimates, *_FIGURES),
            estimates,
            external_names(joints),
        )
        self._names = dict(zip(_STREAMS, names, strict=True))
        self._values = {
            topic: np.full((3, len(of)), np.nan) for topic, of in self._names.items()
        }
        self._first_truth = self._values[topics.TRUTH][0]
        self._latched = np.nan
        self._model_error = ModelError(config)
        self.page.draw_arm(config, self._plant)

    # Samples.

    def _time(self, stamp: int) -> float:
        """Return the time [s] since the controller's start, or the first stamp."""
        if self._start < 0 <= stamp:
            self._start = stamp
        return max(0.0, (stamp - self._start) * 1e-9)

    def _take(self, newest: Mapping[Topic, bytes]) -> bool:
        """Take the newest message of each topic.

        Return whether there was a joint state.
        """
        stamps: dict[Topic, int] = {}
        for topic, raw in newest.items():
            try:
                stamps[topic], self._values[topic] = _read(raw, self._names[topic])
            except MessageError as error:
                self.get_logger().warning(
                    f'not shown: {error}', throttle_duration_sec=10.0
                )
        self._sampled = max(stamps.get(topics.TRACKING_ERROR, -1), self._sampled)
        stamp = stamps.get(topics.JOINT_STATES)
        if stamp is None:
            return False
        if stamp - self._sampled > _OUTDATED:  # the law is not running
            for topic in (topics.TRACKING_ERROR, topics.EXTERNAL_TORQUE):
                self._values[topic] = np.nan * self._values[topic]
        self._keep(self._time(stamp))
        return True

    def _keep(self, time: float) -> None:
        state, (xi1, _, tau), (k_c, *_), (monitor, *_), (truth, *_), (*_, external) = (
            self._values.values()
        )
        m = len(truth)
        tool = monitor[m : m + len(topics.TOOL)].tolist()
        *load, lambda_min, contact, latched = monitor[m + len(topics.TOOL) :].tolist()
        if latched != self._latched and np.isfinite(self._latched):
            text = (
                'excited window latched' if latched else 'restarts: the arm has changed'
            )
            self._events.append((time, 'learning', text))
        self._latched = latched
        if np.isnan(self._first_truth).all():
            self._first_truth = truth
        loaded = bool((np.abs(truth - self._first_truth) > 0.0).any())
        tau = state[2] if np.isnan(tau).any() else tau
        squares = self._model_error.squares(
            time, state[0], state[1], monitor[:m], truth
        )
        learned = monitor[:m], truth, lambda_min, squares, load, loaded, tool
        felt, interval = np.split(external, 2)
        now = Snapshot(time, state[0], xi1, k_c, tau, *learned, felt, interval)
        now = now._replace(touched=bool(contact > 0.0))
        self.past.append(now)
        self._keep_for_replay(now)
        while self.past[0].time < time - PAST - 1.0:
            self.past.popleft()
        self._events += [
            e for e in plant_events(self._plant) if self._noted < e[0] <= time
        ]
        self._noted = time


def _read(raw: bytes, names: Sequence[str]) -> tuple[int, Floats]:
    """Return stamp [ns] and values (3, m) of these names in a message.

    Missing values are NaN.
    """
    theirs = joint_state_layout(raw).names
    decoder = JointStateDecoder(theirs, ())
    stamp = decoder.decode(raw)
    known = dict(zip(theirs, decoder.values.reshape(3, -1).T, strict=True))
    return stamp, np.transpose([known.get(name, (np.nan,) * 3) for name in names])


def plant_events(values: Mapping[str, Any]) -> list[tuple[float, str, str]]:
    """Return time [s], kind and text of a simulated arm's events."""
    begin = values.get('events.begin', ())
    nothing = (0.0,) * len(begin)
    duration, masses = (
        values.get(f'events.{k}') or nothing for k in ('duration', 'payload')
    )
    found = []
    for k, (at, lasts, mass) in enumerate(
        zip(begin, duration, masses, strict=False), 1
    ):
        texts = (f'{mass:g} kg picked up', f'{mass:g} kg put down')
        first, last = texts if mass else (f'event {k} begins', f'event {k} ends')
        found.append((at, 'plant', first))
        found += [(at + lasts, 'plant', last)] if lasts else []
    return sorted(found)


def main() -> int:
    """Run the node at low priority."""
    os.nice(_NICE)
    return run(ViewNode)


if __name__ == '__main__':
    sys.exit(main())
