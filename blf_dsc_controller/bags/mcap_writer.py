# SPDX-License-Identifier: Apache-2.0
"""One MCAP file, laid out as rosbag2's own storage does it, that can be ended on a full disk."""

from __future__ import annotations

import errno
import os
from collections.abc import Mapping
from pathlib import Path
from typing import IO, cast
from zlib import crc32

from mcap.writer import CompressionType, Writer

from blf_dsc_controller import __version__
from blf_dsc_controller.bags.metadata import (
    BagInformation,
    FileInformation,
    TopicInformation,
    quality_text,
)

COMPRESSIONS = {'none': CompressionType.NONE, 'zstd': CompressionType.ZSTD}
CHANNEL_RECORD = 'blf_dsc_controller channel '
"""Start of the name of a metadata record that repeats a topic outside of the chunks."""

CHUNK_SIZE = 1 << 20

_CHUNK_ENTRY = 100  # bytes that a chunk takes in the index at the end ...
_CHANNEL_ENTRY = 16  # ... and for each channel

_FULL = (errno.ENOSPC, errno.EDQUOT)
_STEP = 1 << 20  # bytes
_LARGEST_BUFFER = 1 << 20  # bytes


class McapFile:
    """A new file of messages in chunks (`none` or `zstd`), with an index of them all at the end.

    `information` is the entry of this file in metadata.yaml.
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

    def add_channel(self, topic: TopicInformation) -> int:
        """Add a topic and return its number within the file.

        It is stored in the chunk of its first message, in the index at the end, and in a record of
        its own, for a file that has lost both.
        """
        if topic.type not in self._schemas:
            text, _, encoding = topic.definition
            schema = self._writer.register_schema(topic.type, encoding, text.encode())
            self._schemas[topic.type] = schema
        metadata = {
            'offered_qos_profiles': quality_text(topic.offered),
            'topic_type_hash': topic.definition.hash,
        }
        metadata['checksum'] = channel_checksum(topic.name, topic.type, metadata)
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
        """Whether the disk is full: the file can still be closed, but should not grow."""
        return self._stream.is_full

    def flush(self) -> None:
        """End the current chunk and pass all of it to the operating system."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._stream.flush()
        self._index_size += _CHUNK_ENTRY + _CHANNEL_ENTRY * self._channels
        self._stream.reserve(self._index_size)

    def close(self) -> None:
        """Write the index and close the file."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._stream.close()


def channel_checksum(topic: str, type_name: str, metadata: Mapping[str, str]) -> str:
    """CRC-32 of a channel, which is repeated where no checksum of MCAP protects it."""
    qualities, type_hash = metadata.get('offered_qos_profiles'), metadata.get('topic_type_hash')
    parts = (topic, type_name, qualities, type_hash)
    return f'{crc32(repr(parts).encode()):08x}'


class ReservedFile:
    """A file, buffered until `flush`, that can still be ended when its disk is full.

    A second file of zeros reserves room for what is not written yet: the current chunk, the index,
    metadata.yaml. It is removed when the disk is full, `is_full`, and the file should be ended.

    Raises:
        OSError: the file cannot be made, or there is not even room for the reserve.
    """

    def __init__(self, path: Path) -> None:
        self.is_full = False
        self._file = path.open('xb', buffering=0)
        self._buffer = bytearray()
        self._written = 0
        self._reserve = path.with_name(f'.{path.name}.reserve')
        self._reserved = 0
        self.reserve(0)
        if self.is_full:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    def reserve(self, size: int) -> None:
        """Reserve room for `size` bytes beyond what is flushed, in whole steps."""
        if size + _STEP <= self._reserved or self.is_full:
            return
        reserved = (size // _STEP + 2) * _STEP
        try:
            with self._reserve.open('ab') as reserve:
                os.posix_fallocate(reserve.fileno(), 0, reserved)
        except OSError as error:
            if error.errno not in _FULL:
                raise
            self.is_full = True
        else:
            self._reserved = reserved

    def write(self, data: bytes) -> int:
        """Take bytes; OSError if they cannot be written for another reason than a full disk."""
        self._buffer += data
        if len(self._buffer) >= _LARGEST_BUFFER:
            self.flush()
        return len(data)

    def tell(self) -> int:
        """Bytes taken so far."""
        return self._written + len(self._buffer)

    def flush(self) -> None:
        """Pass all bytes to the operating system, at the cost of the reserve if need be."""
        waiting = memoryview(self._buffer)
        while waiting:
            try:
                count = self._file.write(waiting) or 0
            except OSError as error:
                if error.errno not in _FULL or not self._reserved:
                    raise
                self.is_full = True
                self._remove_reserve()
                continue
            self._written += count
            waiting = waiting[count:]
        waiting.release()
        self._buffer = bytearray()

    def close(self) -> None:
        """Flush and close the file; the reserve is free for metadata.yaml from here on."""
        self._remove_reserve()
        self.flush()
        self._file.close()

    def _remove_reserve(self) -> None:
        self._reserved = 0
        self._reserve.unlink(missing_ok=True)
