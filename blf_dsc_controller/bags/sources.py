# SPDX-License-Identifier: Apache-2.0
"""Bags of any kind as topics and CDR messages: rosbag2 (MCAP, sqlite3) and ROS 1."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

import yaml
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2

from blf_dsc_controller.bags.errors import UnreadableBagError
from blf_dsc_controller.bags.mcap_reader import McapMessages
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.types import typestore

_TOLD = {'__schemaless__': ''}
_NEWEST = 9  # version of rosbag2's metadata.yaml that is known
_STORAGES = ('mcap', 'sqlite3')


class Source(Protocol):
    """An open bag.

    Attributes:
        held: name and type of each topic; the type is empty where the bag does not tell it.
        counts: number of messages of each topic.
    """

    held: list[tuple[str, str]]
    counts: dict[str, int]

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, bytes]]:
        """Topic, time of reception [ns] and content in CDR of every message of these topics.

        Those of one topic come nearly in the order of their reception.
        """


class _Bag2:
    def __init__(self, reader: Reader2, files: list[Path]) -> None:
        self._reader = reader
        self._files = files
        self.held = [(one.topic, _TOLD.get(one.msgtype, one.msgtype)) for one in reader.connections]
        self.counts = {one.topic: one.msgcount for one in reader.connections}

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, bytes]]:
        if self._files:
            for file in self._files:
                yield from McapMessages(file, topics).read()
            return
        chosen = [one for one in self._reader.connections if one.topic in topics]
        if chosen:  # none given would be all
            for connection, received, raw in self._reader.messages(chosen):
                yield connection.topic, received, bytes(raw)


class _Bag1:
    """The common types serialise alike in ROS 1 and 2 but for padding and `seq` of the header."""

    def __init__(self, reader: Reader1) -> None:
        self._reader = reader
        self.held = sorted({(one.topic, one.msgtype) for one in reader.connections})
        self.counts = {name: reader.topics[name].msgcount for name, _ in self.held}

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, bytes]]:
        chosen = [one for one in self._reader.connections if one.topic in topics]
        if chosen:
            for connection, received, raw in self._reader.messages(chosen):
                message = typestore().ros1_to_cdr(raw, connection.msgtype)
                yield connection.topic, received, bytes(message)


@contextmanager
def open_bag(path: Path) -> Iterator[Source]:
    """Open a bag for reading: a folder, one of its storage files, or a ROS 1 `.bag`.

    Raises:
        UnreadableBagError: there is no bag, or it is damaged; also while it is read.
    """
    try:
        if path.suffix == '.bag':
            with Reader1(path) as reader1:
                yield _Bag1(reader1)
        else:
            with Reader2(path) as reader2:
                yield _Bag2(reader2, _mcap_files(path))
    except BlfDscError:
        raise
    except Exception as error:  # a damaged file makes the library raise nearly anything
        raise UnreadableBagError(path, _reason(path, error)) from error


def _mcap_files(path: Path) -> list[Path]:
    """Files of a bag if all are plain MCAP, in their order; none if they are not."""
    files = [path]
    if path.is_dir():
        tree = yaml.safe_load((path / 'metadata.yaml').read_text(encoding='utf-8'))
        names = tree['rosbag2_bagfile_information']['relative_file_paths']
        files = [path / name for name in names]
    return files if all(file.suffix == '.mcap' for file in files) else []


def _reason(path: Path, error: Exception) -> str:
    if not path.exists():
        return 'there is no such folder'
    remedy = f'to save what is whole: bag_recover {path}'
    if not path.is_dir():
        return f'{_said(error)}; {remedy}' if path.suffix == '.mcap' else _said(error)
    has_mcap = any(path.glob('*.mcap'))
    if not (path / 'metadata.yaml').exists():
        if has_mcap:
            return (
                'the folder has no metadata.yaml; was the recording ended before it was complete? '
                f'Make a clean bag of it: bag_recover {path}'
            )
        return 'the folder has no metadata.yaml: it is no bag'
    reason = _other_format(path / 'metadata.yaml') or _said(error)
    return f'{reason}; {remedy}' if has_mcap else reason


def _said(error: Exception) -> str:
    return str(error).rstrip('.') or type(error).__name__


def _other_format(metadata: Path) -> str:
    """What a metadata.yaml says that is not known here, empty if that is not what is wrong."""
    try:
        told = yaml.safe_load(metadata.read_text(encoding='utf-8'))['rosbag2_bagfile_information']
        version, storage = told['version'], told['storage_identifier']
    except (OSError, ValueError, yaml.YAMLError, KeyError, TypeError):
        return 'its metadata.yaml does not describe a bag'
    if isinstance(version, int) and version > _NEWEST:
        return f'its format is version {version} of rosbag2, and up to {_NEWEST} is known here'
    if storage not in _STORAGES:
        return f'its storage is {storage!r}, and only {" and ".join(_STORAGES)} are known here'
    return ''
