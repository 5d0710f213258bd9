# SPDX-License-Identifier: Apache-2.0
"""Where the recorder puts what has arrived: into a bag at once, or into a ring for later."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from math import inf
from pathlib import Path

from rclpy.node import Node
from std_srvs.srv import Trigger

from blf_dsc_controller.bags.ring import Ring
from blf_dsc_controller.bags.writer import BagWriter, Limits
from blf_dsc_controller.configuration.nodes import RecorderConfig
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.topics import Quality
from blf_dsc_controller.nodes.raw_subscriptions import Arrival

_FLUSH_INTERVAL = 0.05  # s; with that of taking, data is in the process for less than 0.1 s
_MEGABYTE = 1_000_000


class Recording:
    """Everything goes into one bag.

    Args:
        config: of the recorder.

    Attributes:
        beginning: what to tell at the start.

    Raises:
        BagExistsError: the folder of the bag is there already.
    """

    def __init__(self, config: RecorderConfig) -> None:
        self._writer = BagWriter(
            config.output,
            compression=config.compression,
            flush_interval=_FLUSH_INTERVAL,
            limits=Limits(config.split_size * _MEGABYTE or inf, config.split_duration or inf),
        )
        self.beginning = f'recording into {self._writer.path}'

    @property
    def message_counts(self) -> dict[str, int]:
        """Messages written so far, by topic."""
        return self._writer.message_counts

    def add_topic(self, name: str, type_name: str, offered: Sequence[Quality]) -> int:
        """Announce a topic and return its handle."""
        return self._writer.add_topic(name, type_name, offered)

    def write(self, arrival: Arrival) -> None:
        """Take a message; DiskFullError if there is no room."""
        self._writer.write(
            arrival.handle, arrival.raw, arrival.received, arrival.published, arrival.sequence
        )

    def configure(self, configuration: str) -> None:
        """Store the configuration of all nodes known so far."""
        self._writer.configure(configuration)

    def flush_if_due(self) -> None:
        """Hand over to the disk what has waited long enough; DiskFullError if there is no room."""
        self._writer.flush_if_due()

    def flush(self) -> None:
        """Hand over to the disk all that has come; DiskFullError if there is no room."""
        self._writer.flush()

    def close(self, statistics: dict[str, str]) -> None:
        """Complete the bag."""
        if not self._writer.closed:
            self._writer.note(statistics)
            self._writer.close()


class BlackBox:
    """The last seconds stay in memory; each call of `~/trigger` writes them into a bag of its own.

    Args:
        node: that offers the service.
        config: of the recorder.

    Attributes:
        beginning: what to tell at the start.
        message_counts: messages that came so far, by topic.
    """

    def __init__(self, node: Node, config: RecorderConfig) -> None:
        self._node = node
        self._ring = Ring(config.ring, config.compression)
        self._output = Path(config.output)
        self._names: list[str] = []
        self.message_counts: Counter[str] = Counter()
        self.beginning = f'keeping the last {config.ring:g} s in memory, until ~/trigger is called'
        node.create_service(Trigger, '~/trigger', self._on_trigger)

    def add_topic(self, name: str, type_name: str, offered: Sequence[Quality]) -> int:
        """Announce a topic and return its handle."""
        self._names.append(name)
        self.message_counts[name] = 0
        return self._ring.add_topic(name, type_name, offered)

    def write(self, arrival: Arrival) -> None:
        """Take a message."""
        self.message_counts[self._names[arrival.handle - 1]] += 1
        self._ring.write(
            arrival.handle, arrival.raw, arrival.received, arrival.published, arrival.sequence
        )

    def configure(self, configuration: str) -> None:
        """Keep the configuration of all nodes known so far."""
        self._ring.configure(configuration, time.time_ns())

    def flush_if_due(self) -> None:
        """Do nothing: what is kept stays in memory."""

    def flush(self) -> None:
        """Likewise."""

    def close(self, _: dict[str, str]) -> None:
        """Do nothing: what nobody has asked for is let go."""

    def _on_trigger(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        path = self._free_folder()
        try:
            count = self._ring.dump(path, {'ring': 'the last time before a trigger'})
        except (BlfDscError, OSError) as error:
            response.success, response.message = False, str(error)
        else:
            response.success, response.message = True, f'wrote {count} messages into {path}'
        self._node.get_logger().info(response.message)
        return response

    def _free_folder(self) -> Path:
        path, number = self._output, 1
        while path.exists():
            number += 1
            path = self._output.with_name(f'{self._output.name}-{number}')
        return path
