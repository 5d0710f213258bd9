# SPDX-License-Identifier: Apache-2.0
"""The node `bag_recorder`: records messages without decoding them."""

from __future__ import annotations

import sys
from collections import OrderedDict
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import partial
from typing import Any

from blf_dsc_controller.bags.writer import BagWriter
from blf_dsc_controller.configuration.nodes import RECORDER
from blf_dsc_controller.configuration.side_nodes import RecorderConfig
from blf_dsc_controller.messages.codecs import UnknownTypeError, joint_state_stamp
from blf_dsc_controller.messages.errors import MessageError
from blf_dsc_controller.messages.topics import JOINT_STATES
from blf_dsc_controller.nodes.endpoints import (
    PollingTimer,
    RawMessage,
    RawSubscriptions,
    compatible,
    create_steady_timer,
    message_class,
    quality_of,
    register_definition,
)
from blf_dsc_controller.nodes.parameters import declare
from blf_dsc_controller.nodes.process import PlainNode, run

_DISCOVERY_PERIOD = 0.1  # s
_TAKE_PERIOD = 0.01  # s
_RARE = 5  # messages at once, such as diagnostics; those of a loop are more
_FLUSH_INTERVAL = 0.05  # s; below 0.1 s including _TAKE_PERIOD, unless overloaded
_REPEAT = 60.0  # s between repeats of a warning


class RecentMessages:
    """Remembers the last messages of a topic, by sender's time, number and content."""

    def __init__(self, depth: int) -> None:
        """Remember at most this number."""
        self._known: OrderedDict[tuple[int, int, bytes], None] = OrderedDict()
        self._depth = depth

    def add(self, message: RawMessage) -> bool:
        """Remember a message; return whether it was new."""
        key = message.published, message.sequence, message.raw
        is_new = key not in self._known
        self._known[key] = None
        if len(self._known) > self._depth:
            self._known.popitem(last=False)
        return is_new


class BagRecorderNode(PlainNode):
    """Subscribes to topics as they appear and records their messages.

    Raises ConfigurationError if a parameter is invalid, BagError if the bag's folder
    exists.

    Attributes:
        bag: where messages are written.
        waiting: messages that wait for the first joint state, with the plant as the clock.
        plant_time: stamp of the last joint state [ns]; -1 before the first.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(RECORDER, enable_rosout=False, **options)
        self._config = declare(self, RecorderConfig)
        self._chosen = {self.resolve_topic_name(name) for name in self._config.topics}
        self._raw_subscriptions = RawSubscriptions(self)
        self._recorded: set[str] = set()
        self._skipped: set[str] = set()
        # handles of topics whose publishers are all reliable so far
        self._reliable: dict[str, int] = {}
        self._publisher_counts: dict[str, int] = {}  # when they were last looked at
        # by the handle of a topic with two subscriptions
        self._twice: dict[int, RecentMessages] = {}
        self._joint_states = self.resolve_topic_name(JOINT_STATES.relative)
        self._handle_of_states = 0
        self.waiting: list[RawMessage] = []  # for the first joint state
        self.plant_time = -1  # ns; -1 before the first joint state
        create_steady_timer(self, _DISCOVERY_PERIOD, self.discover)
        PollingTimer(self, _TAKE_PERIOD, self._record)
        # The folder is created last: from here on, any end of the node also completes
        # the bag.
        self.bag = BagWriter(
            self._config.output,
            compression=self._config.compression,
            flush_interval=_FLUSH_INTERVAL,
        )
        self.get_logger().info(f'recording into {self.bag.path}')

    def close(self) -> None:
        """Write the waiting messages, complete the bag and log a summary."""
        self._record()
        self._raw_subscriptions.close()
        if self.failure is not None or self.bag.closed:
            return
        try:
            for message in self.waiting:  # there was no joint state
                self.bag.write(*message)
            self.bag.close()
        except OSError as error:
            raise self.bag.abandon(error) from error
        for line in self._summary():
            self.get_logger().info(line)

    def discover(self) -> None:
        """Subscribe to topics that have appeared since."""
        try:
            found = self.get_topic_names_and_types()
        # caused by one participant, but rclpy then returns no topics
        except UnicodeDecodeError:
            self.get_logger().warning(
                'new topics cannot be found: the name of a topic or type is not UTF-8',
                throttle_duration_sec=_REPEAT,
            )
            return
        for topic, types in found:
            if topic in self._reliable:
                self._follow_unreliable(topic, types[0])
            elif topic not in self._recorded | self._skipped and self._wanted(topic):
                self._offer_topic(topic, types)

    def _follow_unreliable(self, topic: str, type_name: str) -> None:
        """Subscribe again where a best-effort publisher has joined reliable ones.

        A reliable subscription gets nothing from it, and a best-effort one may lose
        messages of the others: both are kept, and what arrives twice is recorded once.
        """
        count = self.count_publishers(topic)
        if count == self._publisher_counts.get(topic):
            return
        self._publisher_counts[topic] = count
        publishers = self.get_publishers_info_by_topic(topic)
        offered = [quality_of(each.qos_profile) for each in publishers]
        if all(each.reliability == 'reliable' for each in offered):
            return
        handle = self._reliable.pop(topic)
        quality = compatible(offered, self._config.queue_depth)
        self._raw_subscriptions.subscribe(topic, type_name, quality, handle)
        self._twice[handle] = RecentMessages(self._config.queue_depth)
        self.get_logger().info(f'recording the best-effort publishers of {topic}, too')

    def _wanted(self, topic: str) -> bool:
        if self._chosen:
            return topic in self._chosen
        return not any(part.startswith('_') for part in topic.split('/'))

    def _offer_topic(self, topic: str, types: list[str]) -> None:
        publishers = self.get_publishers_info_by_topic(topic)
        if not publishers:
            return
        if len(types) > 1:
            self._skip(topic, f'it has several types, {" and ".join(types)}')
            return
        # importing a type and first subscribing to it may take 0.1 s
        self._record(flush=True)
        try:
            message_class(types[0])
            register_definition(types[0])
        except (ImportError, AttributeError, UnknownTypeError):
            self._skip(topic, f'its type {types[0]} is not installed here')
            return
        self._record(flush=True)
        if self.failure is not None:
            return
        offered = [quality_of(each.qos_profile) for each in publishers]
        handle = self.bag.add_topic(topic, types[0], offered)
        self._recorded.add(topic)
        quality = compatible(offered, self._config.queue_depth)
        self._raw_subscriptions.subscribe(topic, types[0], quality, handle)
        if quality.reliability == 'reliable':
            self._reliable[topic] = handle
        if topic == self._joint_states:
            self._handle_of_states = handle
        self.get_logger().info(f'recording {topic} ({types[0]})')

    def _skip(self, topic: str, reason: str) -> None:
        self._skipped.add(topic)
        self.get_logger().warning(f'{topic} is not recorded: {reason}')

    def _record(self, *, flush: bool = False) -> bool:
        """Write the waiting messages and flush them: all with `flush`, else those due.

        Returns whether there were so many that more are due soon.
        """
        if self.failure is not None:
            return False
        taken = self._raw_subscriptions.take()
        try:
            for message in self._give_times(self._drop_repeats(taken)):
                self.bag.write(*message)
            if flush:
                self.bag.flush()
            else:
                self.bag.flush_if_due()
        except OSError as error:
            self.finished = True
            self.failure = self.bag.abandon(error)
        return len(taken) > _RARE

    def _drop_repeats(self, taken: Iterable[RawMessage]) -> list[RawMessage]:
        """Remember messages; return those that no other subscription has brought before."""
        new = []
        for message in taken:
            recent = self._twice.get(message.handle)
            if recent is None or recent.add(message):
                new.append(message)
        return new

    def _give_times(self, messages: list[RawMessage]) -> list[RawMessage]:
        """Return the messages whose log times are known: those of the plant if it is the clock.

        That is the stamp of the last joint state; until the first one, messages wait.
        """
        if self._config.clock != 'plant':
            return messages
        timed = []
        for message in messages:
            if message.handle == self._handle_of_states:
                with suppress(MessageError):
                    self.plant_time = max(
                        self.plant_time, joint_state_stamp(message.raw)
                    )
            self.waiting.append(message)
            if self.plant_time >= 0:
                timed += [
                    each._replace(received=self.plant_time) for each in self.waiting
                ]
                self.waiting = []
        return timed

    def _summary(self) -> Iterator[str]:
        for topic in self._chosen.difference(self._recorded, self._skipped):
            yield f'{topic}: never appeared'
        for topic, count in self.bag.message_counts.items():
            yield f'{topic}: {count} messages'


main = partial(run, BagRecorderNode)

if __name__ == '__main__':
    sys.exit(main())
