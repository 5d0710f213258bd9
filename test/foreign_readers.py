# SPDX-License-Identifier: Apache-2.0
"""Bags as readers see them that do not know this package."""

from __future__ import annotations

from mcap.stream_reader import StreamReader
from rosbags.rosbag2 import Reader


def read(path):
    """All messages of a bag as (topic, time, bytes)."""
    with Reader(path) as reader:
        return [(c.topic, at, bytes(raw)) for c, at, raw in reader.messages()]


def messages_on_disk(path):
    """Number of messages in a file that nobody has closed."""
    count = 0
    try:
        with path.open('rb') as stream:
            for record in StreamReader(stream, record_size_limit=None).records:
                count += type(record).__name__ == 'Message'
    except Exception:  # noqa: BLE001 - what follows the last whole record is not of interest
        return count
    return count
