# SPDX-License-Identifier: Apache-2.0
"""One MCAP file, laid out as rosbag2's own storage does it."""

from __future__ import annotations

from pathlib import Path

from mcap.writer import CompressionType, Writer

from blf_dsc_controller import __version__
from blf_dsc_controller.bags.metadata import (
    BagInformation,
    FileInformation,
    TopicInformation,
    quality_text,
)

COMPRESSIONS = {'none': CompressionType.NONE, 'zstd': CompressionType.ZSTD}
CHUNK_SIZE = 1 << 20


class McapFile:
    """Messages into chunks, an index of them all at the end.

    Args:
        path: of a file that does not exist yet.
        compression: of the chunks, `none` or `zstd`.

    Attributes:
        information: what metadata.yaml says about this file.
    """

    def __init__(self, path: Path, compression: str) -> None:
        self.information = FileInformation(path.name)
        self._stream = path.open('xb')
        self._writer = Writer(
            self._stream, chunk_size=CHUNK_SIZE, compression=COMPRESSIONS[compression]
        )
        self._writer.start(profile='ros2', library=f'blf_dsc_controller {__version__}')
        self._schemas: dict[str, int] = {}

    def describe(self, bag: BagInformation) -> None:
        """Store what is known of the bag; rosbag2 reads the last such record of a file."""
        self._writer.add_metadata('rosbag2', {'serialized_metadata': bag.record_text()})

    def add_channel(self, topic: TopicInformation, definition: str) -> int:
        """Announce a topic and return its number within the file."""
        if topic.type not in self._schemas:
            self._schemas[topic.type] = self._writer.register_schema(
                topic.type, 'ros2msg', definition.encode()
            )
        metadata = {
            'offered_qos_profiles': quality_text(topic.offered),
            'topic_type_hash': topic.type_hash,
        }
        return self._writer.register_channel(topic.name, 'cdr', self._schemas[topic.type], metadata)

    def write(
        self, channel: int, raw: bytes, log_time: int, publish_time: int, sequence: int
    ) -> None:
        """Put a message into the current chunk; times [ns]."""
        self._writer.add_message(channel, log_time, raw, publish_time, sequence)
        information = self.information
        information.message_count += 1
        information.starting_time = min(information.starting_time, log_time)
        information.ending_time = max(information.ending_time, log_time)

    def flush(self) -> None:
        """End the current chunk and hand all of it to the operating system."""
        self._writer.flush()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        """Write the index and close the file."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._stream.close()
