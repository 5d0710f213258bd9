# SPDX-License-Identifier: Apache-2.0
"""What rosbag2 writes about a bag: metadata.yaml, version 9 (that of Jazzy)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import yaml

from blf_dsc_controller.messages.topics import FOREVER, Quality

VERSION = 9
ROS_DISTRO = 'jazzy'
NANOSECONDS = 1_000_000_000


@dataclass
class TopicInformation:
    """One topic of a bag."""

    name: str
    type: str
    offered: tuple[Quality, ...]
    type_hash: str
    message_count: int = 0

    def as_tree(self) -> dict[str, Any]:
        """Plain data as rosbag2 lays it out."""
        return {
            'topic_metadata': {
                'name': self.name,
                'type': self.type,
                'serialization_format': 'cdr',
                'offered_qos_profiles': [_quality_tree(quality) for quality in self.offered],
                'type_description_hash': self.type_hash,
            },
            'message_count': self.message_count,
        }


@dataclass
class FileInformation:
    """One file of a bag; times [ns], an empty file starts at the end of time."""

    path: str
    starting_time: int = FOREVER
    ending_time: int = 0
    message_count: int = 0

    def as_tree(self) -> dict[str, Any]:
        """Plain data as rosbag2 lays it out."""
        return {
            'path': self.path,
            'starting_time': {'nanoseconds_since_epoch': self.starting_time},
            'duration': {'nanoseconds': _duration(self.starting_time, self.ending_time)},
            'message_count': self.message_count,
        }


@dataclass
class BagInformation:
    """A whole bag."""

    topics: list[TopicInformation] = field(default_factory=list)
    files: list[FileInformation] = field(default_factory=list)
    custom_data: dict[str, str] = field(default_factory=dict)

    def as_tree(self) -> dict[str, Any]:
        """Plain data as rosbag2 lays it out.

        The compression fields are those of rosbag2's own whole-file compression; chunks that MCAP
        compresses itself leave them empty.
        """
        start = min((file.starting_time for file in self.files), default=FOREVER)
        end = max((file.ending_time for file in self.files), default=0)
        return {
            'version': VERSION,
            'storage_identifier': 'mcap',
            'duration': {'nanoseconds': _duration(start, end)},
            'starting_time': {'nanoseconds_since_epoch': start},
            'message_count': sum(file.message_count for file in self.files),
            'topics_with_message_count': [topic.as_tree() for topic in self.topics],
            'compression_format': '',
            'compression_mode': '',
            'relative_file_paths': [file.path for file in self.files],
            'files': [file.as_tree() for file in self.files],
            'custom_data': self.custom_data or None,
            'ros_distro': ROS_DISTRO,
        }

    def record_text(self) -> str:
        """Text for the record `rosbag2` inside an MCAP file."""
        return _dump(self.as_tree())

    def file_text(self) -> str:
        """Text of metadata.yaml."""
        return _dump({'rosbag2_bagfile_information': self.as_tree()})


def quality_text(offered: tuple[Quality, ...]) -> str:
    """Text for the entry `offered_qos_profiles` of a channel."""
    return _dump([_quality_tree(quality) for quality in offered])


def qualities(text: str) -> tuple[Quality, ...]:
    """Qualities of service that `quality_text` wrote; none, if the text is something else."""
    try:
        return tuple(_quality(tree) for tree in yaml.safe_load(text) or ())
    except (yaml.YAMLError, KeyError, TypeError, AttributeError):
        return ()


def _quality(tree: dict[str, Any]) -> Quality:
    durations = {
        name: tree[name]['sec'] * NANOSECONDS + tree[name]['nsec']
        for name in ('deadline', 'lifespan', 'liveliness_lease_duration')
    }
    words = {name: tree[name] for name in ('reliability', 'durability', 'history', 'liveliness')}
    return Quality(depth=tree['depth'], **words, **durations)


def _quality_tree(quality: Quality) -> dict[str, Any]:
    return {
        'history': quality.history,
        'depth': quality.depth,
        'reliability': quality.reliability,
        'durability': quality.durability,
        'deadline': _duration_tree(quality.deadline),
        'lifespan': _duration_tree(quality.lifespan),
        'liveliness': quality.liveliness,
        'liveliness_lease_duration': _duration_tree(quality.liveliness_lease_duration),
        'avoid_ros_namespace_conventions': False,
    }


def _duration_tree(duration: int) -> dict[str, int]:
    seconds, nanoseconds = divmod(duration, NANOSECONDS)
    return {'sec': seconds, 'nsec': nanoseconds}


def _duration(start: int, end: int) -> int:
    return max(end - start, 0)


def _dump(tree: object) -> str:
    return str(yaml.safe_dump(tree, sort_keys=False, allow_unicode=True, width=2**20))
