# SPDX-License-Identifier: Apache-2.0
"""Files of a bag: regular files inside its folder, as named in its metadata.yaml."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path, PurePath
from typing import NamedTuple

import yaml

from blf_dsc_controller.bags.metadata import strongest_quality
from blf_dsc_controller.configuration.bounded_yaml import load_yaml
from blf_dsc_controller.configuration.share import read_text
from blf_dsc_controller.messages.topics import Quality

METADATA = 'metadata.yaml'
_NEWEST = 9  # latest supported version of rosbag2's metadata.yaml
_NAMES_ONLY = 4  # paths of earlier versions begin with the folder's name
_STORAGES = ('mcap', 'sqlite3')


class StoredTopic(NamedTuple):
    """One topic of a bag."""

    name: str
    type: str  # empty if it is unknown
    message_count: int
    offered: Quality  # by its publishers


class BagFolder(NamedTuple):
    """Description of a bag in its metadata.yaml."""

    storage: str  # mcap or sqlite3
    compression: str  # zstd, per `file` or `message`; empty: none but that of MCAP itself
    files: list[Path]
    topics: list[StoredTopic]
    times: tuple[int, int]  # of the first message, and after the last [ns]


def read_folder(path: Path) -> BagFolder:
    """Read the metadata.yaml of a bag.

    Raises:
        ValueError: it does not describe a supported bag.
        OSError: as in `checked`.
    """
    (metadata,) = checked(path, [path / METADATA])
    try:
        tree = load_yaml(read_text(metadata))['rosbag2_bagfile_information']
        version, storage = int(tree['version']), str(tree['storage_identifier'])
        names = [PurePath(name) for name in tree['relative_file_paths']]
        described = [(one['topic_metadata'], one) for one in tree['topics_with_message_count']]
        topics = [
            StoredTopic(
                str(topic['name']),
                str(topic['type']),
                int(one['message_count']),
                strongest_quality(topic.get('offered_qos_profiles')),
            )
            for topic, one in described
        ]
        begin = int(tree['starting_time']['nanoseconds_since_epoch'])
        end = begin + int(tree['duration']['nanoseconds']) + 1
        mode = str(tree.get('compression_mode') or '').lower()
        packing = str(tree.get('compression_format') or '')
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise ValueError('its metadata.yaml does not describe a bag') from error
    except yaml.YAMLError as error:
        raise ValueError(
            f'its metadata.yaml cannot be read: {" ".join(str(error).split())}'
        ) from error
    compression = '' if mode == 'none' else mode
    if version > _NEWEST:
        raise ValueError(
            f'its rosbag2 version is {version}, but only versions up to {_NEWEST} are supported'
        )
    if storage not in _STORAGES:
        raise ValueError(
            f'its storage is {storage!r}, but only {" and ".join(_STORAGES)} are supported'
        )
    if compression not in ('', 'file', 'message') or (compression and packing != 'zstd'):
        raise ValueError(
            f'its {mode} compression is {packing!r}; only zstd files or messages are supported'
        )
    files = [path / (name.name if version < _NAMES_ONLY else name) for name in names]
    return BagFolder(storage, compression, checked(path, files), topics, (begin, end))


def checked(path: Path, files: Iterable[Path]) -> list[Path]:
    """Check the files of the bag at `path`, a folder or the file itself, and return them.

    Raises:
        OSError: one of them is missing, not a regular file, or outside of the folder.
    """
    found = list(files)
    for file in found:
        if path.is_dir() and not file.resolve().is_relative_to(path.resolve()):
            raise OSError(
                f'its file {file} is {file.resolve()}, outside of the folder: if you trust it, '
                'copy it into the folder'
            )
        if not file.exists():
            raise OSError(f'its file {file} is missing')
        if not file.is_file():
            raise OSError(f'{file} is not a regular file')
    return found
