# SPDX-License-Identifier: Apache-2.0
"""Description of a bag as rosbag2 writes it: metadata.yaml, version 9 (that of Jazzy)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, TypeAlias

import yaml
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability

from blf_dsc_controller.configuration.files import load_yaml
from blf_dsc_controller.messages.cdr import NANOSECONDS
from blf_dsc_controller.messages.topics import FOREVER, HISTORY, STREAM, Quality
from blf_dsc_controller.messages.types import Definition

VERSION = 9
ROS_DISTRO = 'jazzy'

Profile: TypeAlias = dict[str, Any]
"""Quality of service of a publisher as rosbag2 writes it."""

_DURATIONS = ('deadline', 'lifespan', 'liveliness_lease_duration')
_POLICIES = {  # numbers in bags of earlier releases
    'history': QosHistory,
    'reliability': QosReliability,
    'durability': QosDurability,
    'liveliness': QosLiveliness,
}


@dataclass
class TopicInformation:
    """One topic of a bag."""

    name: str
    type: str
    offered: list[Profile]
    definition: Definition
    message_count: int = 0

    def offered_text(self) -> str:
        """Return the text for the entry `offered_qos_profiles` of a channel."""
        return _dump(self.offered)


@dataclass
class FileInformation:
    """One file of a bag; times in ns, with FOREVER as the start of an empty file."""

    path: str
    starting_time: int = FOREVER
    ending_time: int = 0
    message_count: int = 0


@dataclass
class BagInformation:
    """Description of a whole bag."""

    topics: list[TopicInformation] = field(default_factory=list)
    files: list[FileInformation] = field(default_factory=list)
    custom_data: dict[str, str] = field(default_factory=dict)

    def record_text(self) -> str:
        """Return the text for the record `rosbag2` inside an MCAP file."""
        return _dump(self._tree())

    def file_text(self) -> str:
        """Return the text of metadata.yaml."""
        return _dump({'rosbag2_bagfile_information': self._tree()})

    def _tree(self) -> dict[str, Any]:
        """Return plain data in rosbag2's layout.

        The compression fields are those of rosbag2's own compression of whole files.
        """
        topics = [
            {
                'topic_metadata': {
                    'name': topic.name,
                    'type': topic.type,
                    'serialization_format': 'cdr',
                    'offered_qos_profiles': topic.offered,
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


def profile_of(quality: Quality) -> Profile:
    """Return a quality of service as plain data, in the order of rosbag2."""
    profile = {'history': quality.history, **asdict(quality)}
    for name in _DURATIONS:
        seconds, nanoseconds = divmod(profile[name], NANOSECONDS)
        profile[name] = {'sec': seconds, 'nsec': nanoseconds}
    return {**profile, 'avoid_ros_namespace_conventions': False}


def parse_qualities(profiles: str | Sequence[Qos] | None) -> list[Quality]:
    """Return publishers' qualities of service, as in a channel of any rosbag2 or from rosbags.

    None if the text is something else.
    """
    try:
        entries = load_yaml(profiles) if isinstance(profiles, str) else profiles
        return [_quality(one if isinstance(one, dict) else one._asdict()) for one in entries or ()]
    except (yaml.YAMLError, KeyError, TypeError, ValueError, AttributeError):
        return []


def _quality(entry: dict[str, Any]) -> Quality:
    found: dict[str, Any] = {'depth': int(entry['depth'])}
    for name, policy in _POLICIES.items():
        value = entry[name]
        found[name] = value.lower() if isinstance(value, str) else policy(value).name.lower()
    for name in _DURATIONS:
        time = entry[name]
        sec, nsec = (time['sec'], time['nsec']) if isinstance(time, dict) else time
        found[name] = int(sec) * NANOSECONDS + int(nsec)
    return Quality(**found)


def strongest_quality(offered: Sequence[Quality], *, is_latched: bool = False) -> Quality:
    """Return a quality of service compatible with each subscriber that any publisher matched.

    A latched topic keeps its recorded depth; others get that of a stream, so that no message is
    lost in a burst.
    """
    is_latched |= any(one.durability == 'transient_local' for one in offered)
    depth = max((one.depth for one in offered if one.history == 'keep_last'), default=0)
    is_lossy = offered and all(one.reliability == 'best_effort' for one in offered)
    is_manual = any(one.liveliness == 'manual_by_topic' for one in offered)
    return replace(
        HISTORY if is_latched else STREAM,
        depth=depth if is_latched and depth else STREAM.depth,
        reliability='best_effort' if is_lossy else 'reliable',
        deadline=_shortest(one.deadline for one in offered),
        liveliness_lease_duration=_shortest(one.liveliness_lease_duration for one in offered),
        liveliness='manual_by_topic' if is_manual else 'automatic',
    )


def _shortest(times: Iterable[int]) -> int:
    """Return the shortest of the times [ns]; zero means unspecified."""
    return min((time for time in times if time), default=FOREVER)


def _period(files: Sequence[FileInformation]) -> dict[str, dict[str, int]]:
    start = min((file.starting_time for file in files), default=FOREVER)
    end = max((file.ending_time for file in files), default=0)
    return {
        'starting_time': {'nanoseconds_since_epoch': start},
        'duration': {'nanoseconds': max(end - start, 0)},
    }


def _dump(tree: object) -> str:
    return str(yaml.safe_dump(tree, sort_keys=False, allow_unicode=True, width=2**20))
