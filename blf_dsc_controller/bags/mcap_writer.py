# SPDX-License-Identifier: Apache-2.0
"""One MCAP file, laid out as rosbag2's own storage does it."""

from __future__ import annotations

from pathlib import Path
from typing import IO, cast

from mcap.writer import CompressionType, Writer

from blf_dsc_controller import __version__
from blf_dsc_controller.bags.metadata import (
    BagInformation,
    FileInformation,
    TopicInformation,
    quality_text,
)
from blf_dsc_controller.bags.reserved_file import ReservedFile

COMPRESSIONS = {'none': CompressionType.NONE, 'zstd': CompressionType.ZSTD}
CHANNEL_RECORD = 'blf_dsc_controller channel '
"""Start of the name of a metadata record that repeats a topic outside of the chunks."""

CHUNK_SIZE = 1 << 20

_CHUNK_ENTRY = 100  # bytes that a chunk takes in the index at the end ...
_CHANNEL_ENTRY = 16  # ... and for each channel


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
        self._stream = ReservedFile(path)
        self._index_size = 0
        self._writer = Writer(
            cast('IO[bytes]', self._stream),
            chunk_size=CHUNK_SIZE,
            compression=COMPRESSIONS[compression],
        )
        self._writer.start(profile='ros2', library=f'blf_dsc_controller {__version__}')
        self._schemas: dict[str, int] = {}
        self._channels = 0

    def describe(self, bag: BagInformation) -> None:
        """Store what is known of the bag; rosbag2 reads the last such record of a file."""
        self.note('rosbag2', {'serialized_metadata': bag.record_text()})

    def note(self, name: str, facts: dict[str, str]) -> None:
        """Store a metadata record."""
        self._writer.add_metadata(name, facts)

    def attach(self, name: str, media_type: str, text: str, log_time: int) -> None:
        """Store a text of this time [ns] as an attachment."""
        self._writer.add_attachment(log_time, log_time, name, media_type, text.encode())

    def add_channel(
        self, topic: TopicInformation, definition: str, encoding: str = 'ros2msg'
    ) -> int:
        """Announce a topic and return its number within the file.

        It stands in the chunk of its first message and in the index at the end; a third time, in a
        record of its own, for a file that has lost both.
        """
        if topic.type not in self._schemas:
            self._schemas[topic.type] = self._writer.register_schema(
                topic.type, encoding, definition.encode()
            )
        metadata = {
            'offered_qos_profiles': quality_text(topic.offered),
            'topic_type_hash': topic.type_hash,
        }
        schema = self._schemas[topic.type]
        self._channels += 1
        number = self._writer.register_channel(topic.name, 'cdr', schema, metadata)
        repeated = {'topic': topic.name, 'topic_type': topic.type, **metadata}
        self.note(f'{CHANNEL_RECORD}{number}', repeated)
        return number

    def write(
        self, channel: int, raw: bytes, log_time: int, publish_time: int, sequence: int
    ) -> None:
        """Put a message into the current chunk; times [ns]."""
        self._writer.add_message(channel, log_time, raw, publish_time, sequence)
        information = self.information
        information.message_count += 1
        information.starting_time = min(information.starting_time, log_time)
        information.ending_time = max(information.ending_time, log_time)

    @property
    def size(self) -> int:
        """Bytes of the file so far."""
        return self._stream.tell()

    @property
    def is_full(self) -> bool:
        """Whether its disk is full: it can still be closed in order, but should take no more."""
        return self._stream.is_full

    def flush(self) -> None:
        """End the current chunk and hand all of it to the operating system."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._stream.flush()
        self._index_size += _CHUNK_ENTRY + _CHANNEL_ENTRY * self._channels
        self._stream.hold(self._index_size)

    def close(self) -> None:
        """Write the index and close the file."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._stream.close()
