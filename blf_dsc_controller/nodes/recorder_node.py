# SPDX-License-Identifier: Apache-2.0
"""The node `bag_recorder`: records every message of the chosen topics without decoding it."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from functools import partial
from math import inf
from pathlib import Path
from typing import Any

from std_srvs.srv import Trigger

from blf_dsc_controller.bags.context import Losses, statistics
from blf_dsc_controller.bags.ring import Ring
from blf_dsc_controller.bags.sources import BagError
from blf_dsc_controller.bags.writer import BagWriter, DiskFullError
from blf_dsc_controller.configuration.nodes import RecorderConfig
from blf_dsc_controller.configuration.params_file import dumps
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.topics import Quality
from blf_dsc_controller.messages.types import UnknownTypeError
from blf_dsc_controller.nodes.endpoints import (
    create_steady_timer,
    message_class,
    register_definition,
)
from blf_dsc_controller.nodes.parameter_client import ParameterClient, Values
from blf_dsc_controller.nodes.parameters import declare
from blf_dsc_controller.nodes.process import PlainNode, run
from blf_dsc_controller.nodes.raw_subscriptions import RawSubscriptions, quality_of

_DISCOVERY_PERIOD = 0.1  # s
_TAKE_PERIOD = 0.01  # s
_FLUSH_INTERVAL = 0.05  # s; below 0.1 s including _TAKE_PERIOD, unless overloaded
_REPEAT = 60.0  # s between repeats of a warning
_MEGABYTE = 1_000_000
_UNKNOWN_NODE = '_NODE_NAME_UNKNOWN_'  # of rmw
_OF_EVERY_NODE = ('/parameter_events', '/rosout')


class BagRecorderNode(PlainNode):
    """Subscribes to topics as they appear and records their messages, or buffers the last seconds.

    Raises ConfigurationError if a parameter is invalid, BagError if the bag's folder exists.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('bag_recorder', enable_rosout=False, **options)
        self._config = declare(self, RecorderConfig)
        self._chosen = {self.resolve_topic_name(name) for name in self._config.topics}
        self._raw_subscriptions = RawSubscriptions(self, self._config.queue_depth)
        self._losses: dict[str, Losses] = {}
        self._losses_by_handle: dict[int, Losses] = {}
        self._skipped: set[str] = set()
        self._anonymous: set[str] = set()
        self._found_at: dict[str, float] = {}
        self._parameter_client = ParameterClient(self._on_parameters)
        self.parameters_of: dict[str, Values] = {}
        create_steady_timer(self, _DISCOVERY_PERIOD, self._discover)
        create_steady_timer(self, _TAKE_PERIOD, self._record)
        # The folder is created last: from here on, any end of the node also completes the bag.
        self._sink = self._open_sink()

    def _open_sink(self) -> BagWriter | Ring:
        config = self._config
        if config.ring:
            ring = Ring(config.ring, config.compression)
            self.create_service(Trigger, '~/trigger', partial(self._on_trigger, ring))
            kept = f'keeping the last {config.ring:g} s in memory, until ~/trigger is called'
            self.get_logger().info(kept)
            return ring
        bag = BagWriter(
            config.output,
            compression=config.compression,
            flush_interval=_FLUSH_INTERVAL,
            split_size=config.split_size * _MEGABYTE or inf,
            split_duration=config.split_duration or inf,
        )
        self.get_logger().info(f'recording into {bag.path}')
        return bag

    def _on_trigger(
        self, ring: Ring, _: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        output = path = Path(self._config.output)
        number = 1
        while path.exists():
            number += 1
            path = output.with_name(f'{output.name}-{number}')
        try:
            count = ring.dump(path, {'ring': 'the last time before a trigger'})
        except (BlfDscError, OSError) as error:
            response.success, response.message = False, str(error)
        else:
            response.success, response.message = True, f'wrote {count} messages into {path}'
        self.get_logger().info(response.message)
        return response

    def close(self) -> None:
        """Write the waiting messages, complete the bag and log a summary."""
        if self.failure is None:
            self._record()
        self._raw_subscriptions.close()
        if not self._sink.closed:
            self._sink.note(statistics(self._sink.message_counts, self._losses))
            self._sink.close()
        for line in self._summary():
            self.get_logger().info(line)

    def _discover(self) -> None:
        try:
            found = self.get_topic_names_and_types()
        except UnicodeDecodeError:  # caused by one participant, but rclpy then returns no topics
            self.get_logger().warning(
                'new topics cannot be found: the name of a topic or type is not UTF-8',
                throttle_duration_sec=_REPEAT,
            )
            return
        for topic, types in found:
            if topic in self._losses:
                self._losses[topic].publishers_seen(self.count_publishers(topic))
                if topic in self._anonymous:
                    self._request_parameters(topic)
            elif topic not in self._skipped and self._wanted(topic):
                self._offer_topic(topic, types)

    def _request_parameters(self, topic: str) -> bool:
        """Request the parameters of a topic's publishers; return whether all have been read.

        A node's name may be discovered after its publishers.
        """
        names = [
            f'{one.node_namespace.rstrip("/")}/{one.node_name}'
            for one in self.get_publishers_info_by_topic(topic)
        ]
        known = [name for name in names if not name.endswith(_UNKNOWN_NODE)]
        for name in known:
            self._parameter_client.request(self._raw_subscriptions.node, name)
        if known == names:
            self._anonymous.discard(topic)
        return known == names and not {*known}.intersection(self._parameter_client.pending)

    def _waits(self, topic: str) -> bool:
        """Whether to record a topic later: a short run may end before its parameters are read."""
        limit = self._config.wait_for_parameters
        if not limit or topic in _OF_EVERY_NODE:
            return False
        now = time.monotonic()
        found_at = self._found_at.setdefault(topic, now)
        return not self._request_parameters(topic) and now < found_at + limit

    def _on_parameters(self, node: str, values: Values) -> None:
        self.parameters_of[node] = values
        self._sink.configure(dumps(self.parameters_of))

    def _wanted(self, topic: str) -> bool:
        if self._chosen:
            return topic in self._chosen
        return not any(part.startswith('_') for part in topic.split('/'))

    def _offer_topic(self, topic: str, types: list[str]) -> None:
        publishers = self.get_publishers_info_by_topic(topic)
        if not publishers or self._waits(topic):
            return
        if len(types) > 1:
            self._skip(topic, f'it has several types, {" and ".join(types)}')
            return
        self._record(flush=True)  # importing a type and first subscribing to it may take 0.1 s
        try:
            message_class(types[0])
            register_definition(types[0])
        except (ImportError, AttributeError, UnknownTypeError):
            self._skip(topic, f'its type {types[0]} is not installed here')
            return
        self._start(topic, types[0], [quality_of(one.qos_profile) for one in publishers])

    def _start(self, topic: str, type_name: str, offered: list[Quality]) -> None:
        self._record(flush=True)
        if self.failure is not None:
            return
        handle = self._sink.add_topic(topic, type_name, offered)
        self._losses[topic] = self._losses_by_handle[handle] = Losses(len(offered))
        self._raw_subscriptions.subscribe(topic, type_name, offered, handle)
        if topic not in _OF_EVERY_NODE:
            self._anonymous.add(topic)
            self._request_parameters(topic)
        self.get_logger().info(f'recording {topic} ({type_name})')

    def _skip(self, topic: str, reason: str) -> None:
        self._skipped.add(topic)
        self.get_logger().warning(f'{topic} is not recorded: {reason}')

    def _record(self, *, flush: bool = False) -> None:
        """Write the waiting messages, and flush them to disk: all with `flush`, else those due."""
        if self.failure is not None:
            return
        try:
            for message in self._raw_subscriptions.take():
                self._losses_by_handle[message.handle].count(message.sequence)
                self._sink.write(*message)
            self._parameter_client.poll()
            (self._sink.flush if flush else self._sink.flush_if_due)()
        except DiskFullError as error:
            self.failure, self.finished = error, True
        except OSError as error:
            self.finished = True
            self.failure = BagError(
                f'the bag cannot be written any further: {error}; bag_recover saves what '
                'was written before'
            )

    def _summary(self) -> Iterator[str]:
        for topic in self._chosen.difference(self._losses, self._skipped):
            yield f'{topic}: never appeared'
        for node in self._parameter_client.pending:
            yield f'{node}: its parameters could not be read'
        for topic, count in self._sink.message_counts.items():
            yield f'{topic}: {count} messages{self._losses[topic].text()}'


main = partial(run, BagRecorderNode)

if __name__ == '__main__':
    sys.exit(main())
