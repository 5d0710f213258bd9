# SPDX-License-Identifier: Apache-2.0
"""The node `view`, which feeds the page from the topics.

It runs in its own low-priority process, takes the newest messages thirty times a
second, and tolerates lost ones. The controller's configuration comes from its journal.
"""

from __future__ import annotations

import os
import sys
from collections import deque
from collections.abc import Mapping, Sequence
from math import inf
from typing import Any

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import VIEW, ViewConfig
from blf_dsc_controller.configuration.received import without_files
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.factory.estimate import estimate_names
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.errors import MessageError
from blf_dsc_controller.messages.journal import (
    MOTIONS,
    Change,
    Event,
    EventType,
    contact_in,
    decode,
    decode_change,
)
from blf_dsc_controller.messages.named_values import external_names
from blf_dsc_controller.messages.topics import Quality, Topic
from blf_dsc_controller.nodes.endpoints import RawSubscriptions, create_steady_timer
from blf_dsc_controller.nodes.parameters import declare
from blf_dsc_controller.nodes.process import PlainNode, run
from blf_dsc_controller.run import Floats
from blf_dsc_controller.view.model_error import ModelError
from blf_dsc_controller.view.newest import (
    LONGEST,
    check_positions,
    newest,
    state_in,
)
from blf_dsc_controller.view.page import PAST, Page, Snapshot, contact_text
from blf_dsc_controller.view.plant_events import plant_events
from blf_dsc_controller.view.thinned_run import ThinnedRun

_PERIOD = 1.0 / 30.0  # s
_PLOTTED = 6  # frames between updates of the plots
_PAUSE = 1.0  # s without targets, after which another stream is listed
_SILENCE = 30  # frames without a joint state before the page reports it
_OUTDATED = 500_000_000  # ns
_LISTED = 12  # events
_LATE = 1.0  # s, after which a first sample is that of a view that was started later
_MISSED = 'watches from here on: earlier curves are not sent again, only a bag has them'
_NICE = 10  # lower priority than the loop
_SHARED = Quality(10, 'best_effort')  # the newest may be those of a gripper
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
        run: snapshots of the whole run.
        config: of the controller that is shown; None: none has been seen.
        plant: parameters of the simulated plant, if there is one.
        sampled: stamp of the last tracking error [ns]; -1 before the first.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(VIEW, **options)
        config = declare(self, ViewConfig)
        self.page = Page(config.host, config.port)
        self.past: deque[Snapshot] = deque()
        self.run = ThinnedRun()
        self._is_offered = False  # whether the page offers to replay them
        self.config: ControllerConfig | None = None
        self.plant: dict[str, Any] = {}  # parameters of the simulated plant
        self._planned: list[tuple[float, str, str]] = []  # its events
        self._bound: list[bytes] = []  # newest messages
        self._events: deque[tuple[float, str, str]] = deque(maxlen=_LISTED)
        self._noted = -1.0  # s, time up to which the plant's events are on the page
        self._state = (
            'STALE',
            f'waiting for a controller ({self.resolve_topic_name(topics.JOURNAL.relative)})',
        )
        self._start = self.sampled = -1  # ns, stamps of start and last tracking error
        self._pictures = self._silent = 0
        self._last_target = -inf  # s
        self._finished = False  # the controller has released the arm
        self._clients_seen: frozenset[int] = frozenset()
        self._raw_subscriptions = RawSubscriptions(self)
        for topic in {*_STREAMS, *_LATCHED, topics.TARGETS}:
            self._raw_subscriptions.follow(topic, _quality(topic))
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
        streams: dict[Topic, list[bytes]] = {}
        for message in self._raw_subscriptions.take():
            if message.handle in _STREAMS:
                streams.setdefault(message.handle, []).append(message.raw)
            else:
                self._note(message.handle, message.raw)
        # latched, it may come before the journal that says what it is of
        self._bound = streams.setdefault(topics.BOUND, self._bound)
        has_state = self.config is not None and self._take(streams)
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

    def survive(self, error: Exception) -> bool:
        """Keep the page when something could not be drawn."""
        self._pass_over(error)
        return True

    def _pass_over(self, error: Exception) -> None:
        """Report what is not shown; odd messages may come at any rate."""
        text = f'{error}' if isinstance(error, BlfDscError) else f'{error!r}'
        self.get_logger().warning(f'not shown: {text}', throttle_duration_sec=10.0)

    def _offer_replay(self) -> None:
        """Let the page replay a run that has ended, until another one begins."""
        has_ended = self._finished and self._silent >= _SILENCE
        if has_ended != self._is_offered:
            self._is_offered = has_ended
            self.page.offer_replay(list(self.run.snapshots) if has_ended else [])

    def _health(self) -> tuple[str, str]:
        """Return the state of the controller, or that it or the arm has gone silent."""
        if self.config is None or self._silent < _SILENCE:
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
        """Follow a message on what happens, unless it cannot be understood."""
        try:
            if topic is topics.JOURNAL:
                self._follow(decode(raw))
            elif topic is topics.TARGETS:
                self._list_motion(decode(raw))
            elif topic is topics.STATE:
                self._state = state_in(raw)
            else:
                self._follow_plant(decode_change(raw))
        except BlfDscError as error:
            self._pass_over(error)

    def _list(self, time: float, kind: str, text: str) -> None:
        """List an event; others may send texts of any length."""
        shown = text if len(text) <= LONGEST else f'{text[:LONGEST]} ...'
        self._events.append((time, kind[:LONGEST], shown))

    def _follow_plant(self, change: Change) -> None:
        """Follow the parameters of the simulated plant."""
        plant = dict(change.parameters)
        if not change.configured:
            plant = self.plant | plant
        elif self.config is not None:
            self.page.draw_arm(self.config, plant)
        self.plant = plant
        self._planned = plant_events(plant)
        if change.configured:
            self._noted = -1.0
            return
        for name, value in change.parameters.items():
            self._list(self._time(change.stamp), name, f'{value}')

    def _follow(self, event: Event) -> None:
        """Follow the controller's journal, which begins with all its parameters."""
        content = event.content
        if event.type is EventType.CONFIGURE:
            given = without_files(content['parameters'])
            self._configure(build(ControllerConfig, given))
            return
        self._finished = event.type is EventType.RELEASE
        if event.type is EventType.START:
            self._start, self._noted = event.stamp, -1.0
            self.past.clear()
            self.run = ThinnedRun()
        details = [
            f'{content[k]}' for k in ('reason', 'text', 'parameters') if k in content
        ]
        if event.type is EventType.CONTACT:
            _, joint, torque, interval, _ = contact_in(event)
            details = [contact_text(joint, torque, interval)]
        self._list(self._time(event.stamp), event.type.value, ', '.join(details))

    def _list_motion(self, event: Event) -> None:
        """List a trajectory, and a stream of targets when it begins."""
        if event.type not in MOTIONS:
            return
        time = self._time(event.stamp)
        if event.type is EventType.TARGET:
            if not 0.0 <= time - self._last_target < _PAUSE:
                self._events.append((time, 'stream', 'of targets'))
            self._last_target = time
            return
        points = len(event.content['points'])
        self._events.append((time, event.type.value, f'{points} points'))

    def _configure(self, config: ControllerConfig) -> None:
        try:
            self.page.draw_arm(config, self.plant)
        except BlfDscError as error:  # anyone may have sent this plant
            if not self.plant:
                raise
            self._pass_over(error)
            self.plant, self._planned = {}, []
            self.page.draw_arm(config, {})
        self.config = config
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

    # Samples.

    def _time(self, stamp: int) -> float:
        """Return the time [s] of a stamp [ns] since the start; the first may stand for that."""
        if self._start < 0 <= stamp:
            self._start = stamp
        return max(0.0, (stamp - self._start) * 1e-9)

    def _take(self, streams: Mapping[Topic, Sequence[bytes]]) -> bool:
        """Take the newest message of each topic.

        Return whether there was a joint state.
        """
        stamps: dict[Topic, int] = {}
        for topic, messages in streams.items():
            try:
                found = newest(messages, self._names[topic])
                if found is None:  # those of a gripper, for instance
                    continue
                at, values = found
                if topic is topics.JOINT_STATES:
                    check_positions(self._names[topic], values[0])
            except MessageError as error:
                self._pass_over(error)
            else:
                stamps[topic], self._values[topic] = at, values
        self.sampled = max(stamps.get(topics.TRACKING_ERROR, -1), self.sampled)
        stamp = stamps.get(topics.JOINT_STATES)
        if stamp is None:
            return False
        if stamp - self.sampled > _OUTDATED:  # the law is not running
            for topic in (topics.TRACKING_ERROR, topics.EXTERNAL_TORQUE):
                self._values[topic] = np.nan * self._values[topic]
        self._keep(self._time(stamp))
        return True

    def _keep(self, time: float) -> None:
        """Keep a snapshot of the newest values, at a time [s]."""
        if self.run.taken == 0 and time > _LATE:
            self._list(time, 'view', _MISSED)
        if np.isnan(self._first_truth).all():
            self._first_truth = self._values[topics.TRUTH][0]
        self._note_latch(time)
        now = self._snapshot(time)
        self.past.append(now)
        self.run.take(now)
        while self.past[0].time < time - PAST - 1.0:
            self.past.popleft()
        self._events += [e for e in self._planned if self._noted < e[0] <= time]
        self._noted = time

    def _snapshot(self, time: float) -> Snapshot:
        """Return the newest values of all topics."""
        position, velocity, effort = self._values[topics.JOINT_STATES]
        error, _, torque = self._values[topics.TRACKING_ERROR]
        truth = self._values[topics.TRUTH][0]
        monitor = self._values[topics.MONITOR][0]
        external, interval = np.split(self._values[topics.EXTERNAL_TORQUE][2], 2)
        estimate, tool, rest = np.split(
            monitor, [truth.size, truth.size + len(topics.TOOL)]
        )
        *load, lambda_min, contact, _ = rest.tolist()
        return Snapshot(
            time=time,
            position=position,
            error=error,
            bound=self._values[topics.BOUND][0],
            torque=effort if np.isnan(torque).any() else torque,
            estimate=estimate,
            truth=truth,
            lambda_min=lambda_min,
            squares=self._model_error.squares(
                time, position, velocity, estimate, truth
            ),
            load=load,
            loaded=self._is_loaded(truth),
            tool=tool.tolist(),
            external=external,
            interval=interval,
            touched=bool(contact > 0.0),
        )

    def _note_latch(self, time: float) -> None:
        """Note an event where learning begins or restarts."""
        latched = float(self._values[topics.MONITOR][0][-1])
        if latched != self._latched and np.isfinite(self._latched):
            text = (
                'excited window latched' if latched else 'restarts: the arm has changed'
            )
            self._events.append((time, 'learning', text))
        self._latched = latched

    def _is_loaded(self, truth: Floats) -> bool:
        """Whether the true parameters differ from the first ones."""
        return bool((np.abs(truth - self._first_truth) > 0.0).any())


def _quality(topic: Topic) -> Quality:
    """Return the quality requested of a topic; a late view needs what is latched."""
    if topic is topics.JOINT_STATES:
        return _SHARED
    is_stream = topic in _STREAMS and topic not in _LATCHED
    return topics.UNRELIABLE if is_stream else topic.requested


def main() -> int:
    """Run the node at low priority."""
    os.nice(_NICE)
    return run(ViewNode)


if __name__ == '__main__':
    sys.exit(main())
