# SPDX-License-Identifier: Apache-2.0
"""Files of rosbag2's sqlite3 storage."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Iterator
from contextlib import closing
from pathlib import Path

from blf_dsc_controller.bags.folder import StoredTopic
from blf_dsc_controller.bags.metadata import strongest_quality
from blf_dsc_controller.bags.unpacking import Unpacker

_TABLES = """SELECT count(*) FROM sqlite_master
    WHERE type = 'table' AND name IN ('topics', 'messages')"""
_TOPICS = """SELECT topics.*, count(messages.id) AS number
    FROM topics LEFT JOIN messages ON messages.topic_id = topics.id GROUP BY topics.id"""
_TIMES = 'SELECT coalesce(min(timestamp), 0), coalesce(max(timestamp), -1) + 1 FROM messages'
_MESSAGES = """SELECT topics.name, messages.timestamp, messages.data
    FROM messages JOIN topics ON messages.topic_id = topics.id
    WHERE topics.name IN ({}) ORDER BY messages.timestamp"""


def topics_of(path: Path) -> tuple[list[StoredTopic], tuple[int, int]]:
    """Return topics, time of the first message, and time after the last [ns].

    Raises:
        sqlite3.Error, TypeError, ValueError: the file is damaged.
    """
    with closing(_open(path)) as database:
        begin, end = database.execute(_TIMES).fetchone()
        database.row_factory = sqlite3.Row
        rows = [dict(row) for row in database.execute(_TOPICS)]
    topics = [
        StoredTopic(
            str(row['name']),
            str(row['type']),
            int(row['number']),
            strongest_quality(row.get('offered_qos_profiles')),
        )
        for row in rows
    ]
    return topics, (int(begin), int(end))


def read_messages(
    path: Path, topics: Collection[str], unpacker: Unpacker
) -> Iterator[tuple[str, int, bytes]]:
    """Yield topic, time [ns] and content of each message, by time; errors as in `topics_of`.

    Each counts as unpacked data, because several can share the same bytes of a file.
    """
    places = ', '.join('?' * len(topics))
    with closing(_open(path)) as database:
        for name, received, raw in database.execute(_MESSAGES.format(places), (*topics,)):
            if not isinstance(received, int) or not isinstance(raw, bytes):
                raise TypeError(f'a row of {name} is not a message')
            unpacker.count(len(raw))
            yield name, received, raw


def _open(path: Path) -> sqlite3.Connection:
    database = sqlite3.connect(f'{path.resolve().as_uri()}?immutable=1', uri=True)
    if database.execute(_TABLES).fetchone() != (2,):  # a view can have endless rows
        database.close()
        raise ValueError('it lacks the tables of a bag')
    return database
