# SPDX-License-Identifier: Apache-2.0
"""What the recorder writes into: a bag, or a ring in memory that is dumped on request."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from math import inf
from pathlib import Path

from rclpy.node import Node
from std_srvs.srv import Trigger

from blf_dsc_controller.bags.writer import BagWriter, Ring, SplitLimits
from blf_dsc_controller.configuration.nodes import RecorderConfig
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.topics import Quality

_FLUSH_INTERVAL = 0.05  # s; with that of taking, data is in the process for less than 0.1 s
_MEGABYTE = 1_000_000


class BagSink(BagWriter):
    """Writes everything into one bag; BagError if its folder is there already.

    Attributes:
        notice: what to log at the start.
    """

    def __init__(self, config: RecorderConfig) -> None:
        super().__init__(
            config.output,
            compression=config.compression,
            flush_interval=_FLUSH_INTERVAL,
            limits=SplitLimits(config.split_size * _MEGABYTE or inf, config.split_duration or inf),
        )
        self.notice = f'recording into {self.path}'

    def finish(self, statistics: dict[str, str]) -> None:
        """Complete the bag."""
        if not self.closed:
            self.note(statistics)
            self.close()


class RingSink(Ring):
    """Keeps the last seconds in memory; each call of `~/trigger` writes them into a new bag.

    Attributes:
        notice: what to log at the start.
        message_counts: messages received so far, by topic.
    """

    def __init__(self, node: Node, config: RecorderConfig) -> None:
        super().__init__(config.ring, config.compression)
        self.message_counts: Counter[str] = Counter()
        self.notice = f'keeping the last {config.ring:g} s in memory, until ~/trigger is called'
        self._log = node.get_logger()
        self._output = Path(config.output)
        self._names: list[str] = []
        node.create_service(Trigger, '~/trigger', self._on_trigger)

    def add_topic(self, name: str, type_name: str, offered: Sequence[Quality]) -> int:
        """Announce a topic and return its handle."""
        self._names.append(name)
        self.message_counts[name] = 0
        return super().add_topic(name, type_name, offered)

    def write(
        self, handle: int, raw: bytes, log_time: int, publish_time: int, sequence: int
    ) -> None:
        """Keep a message."""
        self.message_counts[self._names[handle - 1]] += 1
        super().write(handle, raw, log_time, publish_time, sequence)

    def configure(self, configuration: str, known_at: int | None = None) -> None:
        """Keep the configuration of all nodes known so far."""
        super().configure(configuration, known_at or time.time_ns())

    def flush_if_due(self) -> None:
        """Do nothing: the messages stay in memory."""

    def flush(self) -> None:
        """Do nothing: the messages stay in memory."""

    def finish(self, statistics: dict[str, str]) -> None:
        """Do nothing: what was not requested is dropped."""

    def _on_trigger(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        path, number = self._output, 1
        while path.exists():
            number += 1
            path = self._output.with_name(f'{self._output.name}-{number}')
        try:
            count = self.dump(path, {'ring': 'the last time before a trigger'})
        except (BlfDscError, OSError) as error:
            response.success, response.message = False, str(error)
        else:
            response.success, response.message = True, f'wrote {count} messages into {path}'
        self._log.info(response.message)
        return response
