# SPDX-License-Identifier: Apache-2.0
"""The node `view`, which feeds the page from the topics.

It runs in its own low-priority process, takes the newest messages thirty times a
second, and tolerates lost ones. The controller's configuration comes from its journal.
"""

from __future__ import annotations

import os
import sys
from collections import deque
from typing import Any

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import VIEW
from blf_dsc_controller.configuration.received import without_files
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.configuration.side_nodes import ViewConfig
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.journal import (
    Change,
    Event,
    EventType,
    decode,
    decode_change,
)
from blf_dsc_controller.messages.topics import Quality, Topic
from blf_dsc_controller.nodes.endpoints import RawSubscriptions, create_steady_timer
from blf_dsc_controller.nodes.parameters import declare
from blf_dsc_controller.nodes.process import PlainNode, run
from blf_dsc_controller.view.events import Events
from blf_dsc_controller.view.newest import state_in
from blf_dsc_controller.view.page import PAST, Page
from blf_dsc_controller.view.samples import STREAMS, Samples
from blf_dsc_controller.view.snapshot import Snapshot
from blf_dsc_controller.view.thinned_run import ThinnedRun

_PERIOD = 1.0 / 30.0  # s
_PLOTTED = 6  # frames between updates of the plots
_SILENCE = 30  # frames without a joint state before the page reports it
_LATE = 1.0  # s, after which a first sample is that of a view that was started later
_MISSED = 'watches from here on: earlier curves are not sent again, only a bag has them'
_NICE = 10  # lower priority than the loop
_SHARED = Quality(10, 'best_effort')  # the newest may be those of a gripper
_LOCAL = ('127.0.0.1', 'localhost')  # hosts that only this computer can reach
_LATCHED = (topics.BOUND, topics.JOURNAL, topics.CHANGES, topics.STATE)


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
        samples: the newest values of its topics, once it has been seen.
        plant: parameters of the simulated plant, if there is one.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(VIEW, **options)
        config = declare(self, ViewConfig)
        self.page = Page(config.host, config.port)
        self.past: deque[Snapshot] = deque()
        self.run = ThinnedRun()
        self._is_offered = False  # whether the page offers to replay them
        self.config: ControllerConfig | None = None
        self.samples: Samples
        self.plant: dict[str, Any] = {}
        self._bound: list[bytes] = []  # newest messages
        self._events = Events()
        self._state = (
            'STALE',
            f'waiting for a controller ({self.resolve_topic_name(topics.JOURNAL.relative)})',
        )
        self._pictures = self._silent = 0
        self._finished = False  # the controller has released the arm
        self._clients_seen: frozenset[int] = frozenset()
        self._raw_subscriptions = RawSubscriptions(self)
        for topic in {*STREAMS, *_LATCHED, topics.TARGETS}:
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
            if message.handle in STREAMS:
                streams.setdefault(message.handle, []).append(message.raw)
            else:
                self._note(message.handle, message.raw)
        # latched, it may come before the journal that says what it is of
        self._bound = streams.setdefault(topics.BOUND, self._bound)
        stamp = None if self.config is None else self.samples.take(streams)
        has_state = stamp is not None
        if stamp is not None:
            self._keep(self._events.take_time(stamp))
        self._silent = 0 if has_state else self._silent + 1
        self.page.state(*self._health())
        self.page.events(list(self._events.listed))
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
                self._events.add_motion(decode(raw))
            elif topic is topics.STATE:
                self._state = state_in(raw)
            else:
                self._follow_plant(decode_change(raw))
        except BlfDscError as error:
            self._pass_over(error)

    def _follow_plant(self, change: Change) -> None:
        """Follow the parameters of the simulated plant."""
        plant = dict(change.parameters)
        if not change.configured:
            plant = self.plant | plant
        elif self.config is not None:
            self.page.draw_arm(self.config, plant)
        self.plant = plant
        self._events.plan(plant, anew=change.configured)
        if change.configured:
            return
        for name, value in change.parameters.items():
            self._events.add(self._events.take_time(change.stamp), name, f'{value}')

    def _follow(self, event: Event) -> None:
        """Follow the controller's journal, which begins with all its parameters."""
        if event.type is EventType.CONFIGURE:
            given = without_files(event.content['parameters'])
            self._configure(build(ControllerConfig, given))
            return
        self._finished = event.type is EventType.RELEASE
        if event.type is EventType.START:
            self._events.begin(event.stamp)
            self.past.clear()
            self.run = ThinnedRun()
        self._events.add_event(event)

    def _configure(self, config: ControllerConfig) -> None:
        try:
            self.page.draw_arm(config, self.plant)
        except BlfDscError as error:  # anyone may have sent this plant
            if not self.plant:
                raise
            self._pass_over(error)
            self.plant = {}
            self._events.plan({}, anew=False)
            self.page.draw_arm(config, {})
        self.config = config
        self.samples = Samples(config, self._pass_over)
        self._events.forget_latch()

    # Samples.

    def _keep(self, time: float) -> None:
        """Keep a snapshot of the newest values, at a time [s]."""
        if self.run.taken == 0 and time > _LATE:
            self._events.add(time, 'view', _MISSED)
        self._events.note_latch(time, self.samples.latched)
        now = self.samples.snapshot(time)
        self.past.append(now)
        self.run.take(now)
        while self.past[0].time < time - PAST - 1.0:
            self.past.popleft()
        self._events.pass_time(time)


def _quality(topic: Topic) -> Quality:
    """Return the quality requested of a topic; a late view needs what is latched."""
    if topic is topics.JOINT_STATES:
        return _SHARED
    is_stream = topic in STREAMS and topic not in _LATCHED
    return topics.UNRELIABLE if is_stream else topic.requested


def main() -> int:
    """Run the node at low priority."""
    os.nice(_NICE)
    return run(ViewNode)


if __name__ == '__main__':
    sys.exit(main())
