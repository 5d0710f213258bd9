# SPDX-License-Identifier: Apache-2.0
"""The messages of whole MCAP files, chunk by chunk: three times as fast as a general reader."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path

from blf_dsc_controller.bags.mcap_records import (
    CHANNEL,
    CHUNK,
    DATA_END,
    HEAD,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    Buffer,
    MalformedRecordError,
    channel_of,
    chunk_of,
    head,
)


class McapMessages:
    """Messages of some topics of one file.

    Args:
        path: of the file.
        topics: wanted.
    """

    def __init__(self, path: Path, topics: Collection[str]) -> None:
        self._path = path
        self._topics = topics
        self._wanted: dict[int, str] = {}

    def read(self) -> Iterator[tuple[str, int, bytes]]:
        """Topic, log time [ns] and content of every message, in the order of the file.

        Raises:
            MalformedRecordError: the file is damaged.
        """
        data = memoryview(self._path.read_bytes())
        at, opcode = len(MAGIC), 0
        while opcode != DATA_END:
            opcode, end = head(data, at)
            if opcode == CHUNK:
                yield from self._records(self._unpack(data[at + HEAD.size : end], at))
            elif opcode in (CHANNEL, MESSAGE):
                yield from self._records(bytes(data[at:end]))
            at = end

    def _unpack(self, content: Buffer, at: int) -> bytes:
        try:
            return chunk_of(content).unpack()
        except MalformedRecordError as error:
            raise MalformedRecordError(f'the chunk at byte {at} is damaged: {error}') from error

    def _records(self, records: bytes) -> Iterator[tuple[str, int, bytes]]:
        at, size = 0, len(records)
        wanted = self._wanted
        unpack, before_content = MESSAGE_HEAD.unpack_from, MESSAGE_HEAD.size
        last = size - before_content
        while at < size:
            if at <= last and records[at] == MESSAGE:
                _, length, number, _, log_time, _ = unpack(records, at)
                end = at + HEAD.size + length
                if end > size or end < at + before_content:
                    raise MalformedRecordError('a message does not fit its length')
                if number in wanted:
                    yield wanted[number], log_time, records[at + before_content : end]
                at = end
                continue
            opcode, end = head(records, at)
            if opcode == CHANNEL:
                channel = channel_of(records[at + HEAD.size : end])
                if channel.topic in self._topics:
                    wanted[channel.id] = channel.topic
            at = end
