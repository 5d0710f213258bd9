# SPDX-License-Identifier: Apache-2.0
"""Bags of any kind as topics and CDR messages: rosbag2 (MCAP, sqlite3) and ROS 1."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.rosbag2.storage_mcap import McapReader

from blf_dsc_controller.bags.mcap_reader import read_messages
from blf_dsc_controller.bags.metadata import strongest_quality
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.types import typestore

_NEWEST = 9  # version of rosbag2's metadata.yaml that is known
_STORAGES = ('mcap', 'sqlite3')


class BagError(BlfDscError):
    """A bag that cannot be read or written."""


class OpenBag:
    """An open bag. rosbags' AnyReader would reject bags with one bad type definition.

    `held` is name and type, empty where unknown, of each topic; `counts` its number of messages,
    `offered` the quality of service that its publishers offered. `times` [ns] are those of the
    first message and after the last.
    """

    def __init__(self, reader: Reader1 | Reader2) -> None:
        self._reader = reader
        held = dict.fromkeys((one.topic, one.msgtype) for one in reader.connections)
        self.held = [(name, kind.replace('__schemaless__', '')) for name, kind in held]
        self.counts = {name: reader.topics[name].msgcount for name, _ in self.held}
        self.offered = {
            name: strongest_quality([one.ext for one in reader.topics[name].connections])
            for name, _ in self.held
        }
        self.times = (reader.start_time, reader.end_time)

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, bytes]]:
        """Topic, time of reception [ns] and content in CDR of every message of `topics`.

        Those of one topic come nearly in the order of their reception.
        """
        files = _mcap_files(self._reader)
        if files:
            for file in files:
                yield from read_messages(file, topics)
        else:
            yield from self.in_order(topics)

    def in_order(
        self, topics: Collection[str], start: int | None = None, stop: int | None = None
    ) -> Iterator[tuple[str, int, bytes]]:
        """The same from `start` on and before `stop` [ns], in the order of reception.

        Slower by half, but only a few chunks of the bag are in memory at a time.
        """
        is_ros1 = isinstance(self._reader, Reader1)
        # The common types serialise alike in ROS 1 and 2 but for padding and `seq` of the header.
        chosen = [one for one in self._reader.connections if one.topic in topics]
        for connection, received, raw in (
            self._reader.messages(chosen, start, stop) if chosen else ()
        ):
            cdr = typestore().ros1_to_cdr(raw, connection.msgtype) if is_ros1 else raw
            yield connection.topic, received, bytes(cdr)


@contextmanager
def open_bag(path: Path) -> Iterator[OpenBag]:
    """Open a bag for reading: a folder, one of its storage files, or a ROS 1 `.bag`.

    Raises:
        BagError: there is no bag, or it is damaged; also while it is read.
    """
    try:
        if path.suffix == '.bag':
            with Reader1(path) as reader1:
                yield OpenBag(reader1)
        else:
            with Reader2(path) as reader2:
                yield OpenBag(reader2)
    except BlfDscError:
        raise
    except Exception as error:  # a damaged file makes the library raise nearly anything
        raise BagError(f'{path} cannot be read as a bag: {_reason(path, error)}') from error


def _mcap_files(reader: Reader1 | Reader2) -> list[Path]:
    """Files of a bag in their order, if all are plain MCAP; else none."""
    if isinstance(reader, Reader1) or reader.compression_mode:
        return []
    storages: list[Any] = getattr(reader.storage, 'storages', [reader.storage])
    return [Path(str(one.path)) for one in storages if isinstance(one, McapReader)]


def _reason(path: Path, error: Exception) -> str:
    if not path.exists():
        return 'there is no such folder'
    text = str(error).rstrip('.') or type(error).__name__
    metadata = path / 'metadata.yaml'
    is_mcap = path.suffix == '.mcap'
    if path.is_dir():
        is_mcap = any(path.glob('*.mcap'))
        if not metadata.exists():
            if not is_mcap:
                return 'the folder has no metadata.yaml: it is not a bag'
            return (
                'the folder has no metadata.yaml; was the recording interrupted? '
                f'Recover it: bag_recover {path}'
            )
        text = _other_format(metadata) or text
    return f'{text}; to save the undamaged part: bag_recover {path}' if is_mcap else text


def _other_format(metadata: Path) -> str:
    """Why a metadata.yaml is not understood; empty if it is."""
    try:
        tree = yaml.safe_load(metadata.read_text(encoding='utf-8'))['rosbag2_bagfile_information']
        version, storage = tree['version'], tree['storage_identifier']
    except (OSError, ValueError, yaml.YAMLError, KeyError, TypeError):
        return 'its metadata.yaml does not describe a bag'
    if isinstance(version, int) and version > _NEWEST:
        return f'its rosbag2 version is {version}, but only versions up to {_NEWEST} are supported'
    if storage not in _STORAGES:
        return f'its storage is {storage!r}, but only {" and ".join(_STORAGES)} are supported'
    return ''
