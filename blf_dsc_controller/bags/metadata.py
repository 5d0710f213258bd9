# SPDX-License-Identifier: Apache-2.0
"""What rosbag2 writes about a bag: metadata.yaml, version 9 (that of Jazzy)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import Any

import yaml

from blf_dsc_controller.messages.cdr import NANOSECONDS
from blf_dsc_controller.messages.topics import FOREVER, Quality
from blf_dsc_controller.messages.types import Definition

VERSION = 9
ROS_DISTRO = 'jazzy'

_DURATIONS = ('deadline', 'lifespan', 'liveliness_lease_duration')


@dataclass
class TopicInformation:
    """One topic of a bag."""

    name: str
    type: str
    offered: tuple[Quality, ...]
    definition: Definition
    message_count: int = 0


@dataclass
class FileInformation:
    """One file of a bag; times [ns], an empty file starts at the end of time."""

    path: str
    starting_time: int = FOREVER
    ending_time: int = 0
    message_count: int = 0


@dataclass
class BagInformation:
    """A whole bag."""

    topics: list[TopicInformation] = field(default_factory=list)
    files: list[FileInformation] = field(default_factory=list)
    custom_data: dict[str, str] = field(default_factory=dict)

    def record_text(self) -> str:
        """Text for the record `rosbag2` inside an MCAP file."""
        return _dump(self._tree())

    def file_text(self) -> str:
        """Text of metadata.yaml."""
        return _dump({'rosbag2_bagfile_information': self._tree()})

    def _tree(self) -> dict[str, Any]:
        """Plain data as rosbag2 arranges it.

        The compression fields are those of rosbag2's own compression of whole files.
        """
        topics = [
            {
                'topic_metadata': {
                    'name': topic.name,
                    'type': topic.type,
                    'serialization_format': 'cdr',
                    'offered_qos_profiles': _quality_trees(topic.offered),
                    'type_description_hash': topic.definition.hash,
                },
                'message_count': topic.message_count,
            }
            for topic in self.topics
        ]
        files = [
            {'path': file.path, **_period([file]), 'message_count': file.message_count}
            for file in self.files
        ]
        period = _period(self.files)
        return {
            'version': VERSION,
            'storage_identifier': 'mcap',
            'duration': period['duration'],
            'starting_time': period['starting_time'],
            'message_count': sum(file.message_count for file in self.files),
            'topics_with_message_count': topics,
            'compression_format': '',
            'compression_mode': '',
            'relative_file_paths': [file.path for file in self.files],
            'files': files,
            'custom_data': self.custom_data or None,
            'ros_distro': ROS_DISTRO,
        }


def quality_text(offered: Iterable[Quality]) -> str:
    """Text for the entry `offered_qos_profiles` of a channel."""
    return _dump(_quality_trees(offered))


def parse_qualities(text: str) -> tuple[Quality, ...]:
    """Qualities of service in such a text; none, if it is something else."""
    try:
        return tuple(
            Quality(**{one.name: _plain(tree[one.name]) for one in fields(Quality)})
            for tree in yaml.safe_load(text) or ()
        )
    except (yaml.YAMLError, KeyError, TypeError, AttributeError):
        return ()


def _plain(value: Any) -> Any:
    """A duration in ns; everything else as it is."""
    return value['sec'] * NANOSECONDS + value['nsec'] if isinstance(value, dict) else value


def _quality_trees(offered: Iterable[Quality]) -> list[dict[str, Any]]:
    trees = []
    for quality in offered:
        tree = {'history': quality.history, **asdict(quality)}  # in the order of rosbag2
        for name in _DURATIONS:
            seconds, nanoseconds = divmod(tree[name], NANOSECONDS)
            tree[name] = {'sec': seconds, 'nsec': nanoseconds}
        trees.append({**tree, 'avoid_ros_namespace_conventions': False})
    return trees


def _period(files: Sequence[FileInformation]) -> dict[str, dict[str, int]]:
    start = min((file.starting_time for file in files), default=FOREVER)
    end = max((file.ending_time for file in files), default=0)
    return {
        'starting_time': {'nanoseconds_since_epoch': start},
        'duration': {'nanoseconds': max(end - start, 0)},
    }


def _dump(tree: object) -> str:
    return str(yaml.safe_dump(tree, sort_keys=False, allow_unicode=True, width=2**20))
