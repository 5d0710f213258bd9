# SPDX-License-Identifier: Apache-2.0
"""Bags as seen by readers that do not know this package."""

from __future__ import annotations

from mcap.stream_reader import StreamReader
from rosbags.rosbag2 import Reader


def read(path):
    """Return all messages of a bag as (topic, time, bytes)."""
    with Reader(path) as reader:
        return [(c.topic, at, bytes(raw)) for c, at, raw in reader.messages()]


def raw_records(data):
    """Yield the records of an intact MCAP file as bytes, with their offsets."""
    at = 8
    while at < len(data) - 8:
        end = at + 9 + int.from_bytes(data[at + 1 : at + 9], 'little')
        yield at, data[at:end]
        at = end


def messages_on_disk(path):
    """Return the number of messages in a file that was not closed."""
    count = 0
    try:
        with path.open('rb') as stream:
            for record in StreamReader(stream, record_size_limit=None).records:
                count += type(record).__name__ == 'Message'
    except Exception:  # noqa: BLE001 - what follows the last whole record does not matter
        return count
    return count
