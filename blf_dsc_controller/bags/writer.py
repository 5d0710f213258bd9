# SPDX-License-Identifier: Apache-2.0
"""A bag as `ros2 bag record` writes it: a folder of metadata.yaml and an MCAP file."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import final

from blf_dsc_controller.bags.context import ATTACHMENT, MEDIA_TYPE, RECORD, facts_of
from blf_dsc_controller.bags.errors import BagExistsError
from blf_dsc_controller.bags.mcap_file import McapFile
from blf_dsc_controller.bags.metadata import BagInformation, TopicInformation
from blf_dsc_controller.bags.topics import Quality
from blf_dsc_controller.bags.types import definition, type_hash


@final
class BagWriter:
    """Writes serialised messages into a new bag.

    All that is written leaves the process within `flush_interval` and the time to the next call
    of `write` or `flush_if_due`; what has left it survives the process being killed.

    Args:
        path: folder of the bag, which must not exist yet.
        compression: of the chunks, `none` or `zstd`.
        flush_interval: longest time that data stays in the process [s]; None leaves it to the size
            of a chunk, which is best where nothing is lost by starting over.
        clock: monotonic time [s].

    Raises:
        BagExistsError: `path` is there already.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        compression: str = 'none',
        flush_interval: float | None = 0.1,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.path = Path(path)
        self._bag = BagInformation()
        self._make_folder()
        self._file = McapFile(self.path / f'{self.path.name}_0.mcap', compression)
        self._bag.files.append(self._file.information)
        self._file.describe(self._bag)
        self._flush_interval = float('inf') if flush_interval is None else flush_interval
        self._clock = clock
        self._flushed = clock()
        self._closed = False

    def add_topic(
        self,
        name: str,
        type_name: str,
        offered: Sequence[Quality],
        *,
        text: str = '',
        hash_: str = '',
        encoding: str = 'ros2msg',
    ) -> int:
        """Announce a topic and return the handle to write to it.

        Args:
            name: full name.
            type_name: such as `sensor_msgs/msg/JointState`.
            offered: quality of service of each publisher.
            text: definition of the type and all nested ones, if not a common type of Jazzy.
            hash_: of the type, likewise.
            encoding: of the definition.

        Raises:
            UnknownTypeError: no `text` is given and the type is none of the common ones.
        """
        topic = TopicInformation(name, type_name, tuple(offered), hash_ or type_hash(type_name))
        handle = self._file.add_channel(topic, text or definition(type_name), encoding)
        self._bag.topics.append(topic)
        return handle

    def write(
        self,
        handle: int,
        raw: bytes,
        log_time: int,
        publish_time: int | None = None,
        sequence: int = 0,
    ) -> None:
        """Write one serialised message.

        Args:
            handle: from `add_topic`.
            raw: the message in CDR.
            log_time: when it was received [ns].
            publish_time: when it was published [ns], `log_time` if not known.
            sequence: number that the publisher gave it, 0 if not known.
        """
        self._file.write(
            handle, raw, log_time, log_time if publish_time is None else publish_time, sequence
        )
        self._bag.topics[handle - 1].message_count += 1
        self.flush_if_due()

    def configure(self, configuration: str, known_at: int | None = None) -> None:
        """Store the configuration of the run.

        Args:
            configuration: text of a parameter file of all nodes known so far.
            known_at: when it was learned [ns], now if not given.
        """
        known_at = time.time_ns() if known_at is None else known_at
        self._bag.custom_data.update(facts_of(configuration))
        self._file.note(RECORD, self._bag.custom_data)
        self._file.attach(ATTACHMENT, MEDIA_TYPE, configuration, known_at)

    def note(self, facts: dict[str, str]) -> None:
        """Store facts of the run under names of their own."""
        self._bag.custom_data.update(facts)
        self._file.note(RECORD, self._bag.custom_data)

    def flush_if_due(self) -> None:
        """Flush if the flush interval has passed, for use in a pause of the messages."""
        if self._clock() - self._flushed >= self._flush_interval:
            self.flush()

    def flush(self) -> None:
        """Hand everything written so far to the operating system."""
        self._file.flush()
        self._flushed = self._clock()

    def close(self) -> None:
        """Complete the bag; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        self._file.flush()
        self._file.describe(self._bag)
        self._file.close()
        (self.path / 'metadata.yaml').write_text(self._bag.file_text(), encoding='utf-8')

    @property
    def message_counts(self) -> dict[str, int]:
        """Messages written so far, by topic."""
        return {topic.name: topic.message_count for topic in self._bag.topics}

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _make_folder(self) -> None:
        try:
            self.path.mkdir(parents=True)
        except FileExistsError:
            raise BagExistsError(self.path) from None
