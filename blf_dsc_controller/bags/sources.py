# SPDX-License-Identifier: Apache-2.0
"""All kinds of bags as topics and CDR messages.

The library rosbags opens them. It also reads the messages of sqlite3, ROS 1 and compressed ones;
those of plain MCAP files are read by `mcap_file`, which is faster and checks every chunk.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from rosbags.interfaces import QosDurability
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import Reader

from blf_dsc_controller.bags.mcap_file import Allowance, McapFile
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.topics import HISTORY, STREAM, Quality
from blf_dsc_controller.messages.types import typestore

METADATA = 'metadata.yaml'
RECORD = 'blf_dsc_controller'
"""Name of the metadata record with the facts."""

VERSION = 'package_version'
MESSAGES = 'messages '
"""Prefix of the names of facts that count the written and lost messages of a topic."""


class BagError(BlfDscError):
    """A bag that cannot be read or written."""


class BagMessage(NamedTuple):
    """A message in CDR, as recorded."""

    topic: str
    received: int  # ns
    raw: bytes
    sequence: int = 0  # assigned by its publisher; 0 if unknown


Messages: TypeAlias = Iterator[BagMessage]


class OpenBag:
    """An open bag.

    Attributes:
        held: name and type, empty where unknown, of each topic.
        counts: number of messages of each topic.
        offered: quality of service to publish each topic with.
        times: of the first message and after the last [ns].
        facts: what a recorder of this package noted about the run; complete once all is read.
    """

    def __init__(self, reader: Any, path: Path) -> None:
        self._reader = reader
        every = reader.connections
        types = ((one.topic, one.msgtype.replace('__schemaless__', '')) for one in every)
        self.held = list(dict.fromkeys(types))
        self.counts: Counter[str] = Counter()
        for one in every:
            self.counts[one.topic] += one.msgcount
        self.offered = {one.topic: _quality(one.ext) for one in every}
        self.times: tuple[int, int] = reader.start_time, reader.end_time
        self.facts: dict[str, str] = {}
        self._allowance = Allowance(path)
        self._files: list[McapFile] = []
        if isinstance(reader, Reader) and reader.compression_mode != 'message':
            storage: Any = reader.storage
            parts: list[Any] = storage.storages if path.is_dir() else [storage]
            paths = [part.path for part in parts if part.path.suffix == '.mcap']
            self._files = [McapFile(one, self._allowance) for one in paths]

    def messages(self, topics: Collection[str], start: int = 0) -> Messages:
        """Yield the messages of `topics` from `start` [ns] on, nearly in order of reception.

        Raises:
            BagError: their number is not the one that the bag states.
        """
        found: Counter[str] = Counter()
        for one in (self._of_files if self._files else self._of_library)(topics, start):
            found[one.topic] += 1
            if one.received >= start:
                yield one
        for file in self._files:
            self.facts |= file.metadata.get(RECORD, {})
            for number, count in file.found.items():
                if file.channels[number].topic not in topics:
                    found[file.channels[number].topic] += count
        for topic in (found | self.counts if self._files else topics) if start == 0 else ():
            if found[topic] != self.counts[topic]:
                raise ValueError(
                    f'it holds {found[topic]} messages of {topic}, but counts {self.counts[topic]}'
                )

    def _of_files(self, topics: Collection[str], start: int) -> Messages:
        for file in self._files:
            for number, sequence, log_time, _, raw in file.messages(topics, start):
                yield BagMessage(file.channels[number].topic, log_time, raw, sequence)

    def _of_library(self, topics: Collection[str], start: int) -> Messages:
        chosen = [one for one in self._reader.connections if one.topic in topics]
        for one, received, raw in self._reader.messages(chosen, start or None) if chosen else ():
            self._allowance.take(len(raw))
            if isinstance(self._reader, Ros1Reader):
                # ROS 1 and 2 serialise the common types alike, except for padding and `seq`.
                raw = typestore().ros1_to_cdr(raw, one.msgtype)  # noqa: PLW2901
            yield BagMessage(one.topic, received, bytes(raw))


def _quality(ext: Any) -> Quality:
    """Return a reliable quality of service, latched as deep as the recorded publishers were."""
    offered = getattr(ext, 'offered_qos_profiles', ())
    latched = [one.depth for one in offered if one.durability is QosDurability.TRANSIENT_LOCAL]
    if bool(latched) or bool(getattr(ext, 'latching', 0)):
        return replace(HISTORY, depth=max(latched, default=0) or HISTORY.depth)
    return STREAM


@contextmanager
def open_bag(path: Path) -> Iterator[OpenBag]:
    """Open a bag for reading: a folder, one of its storage files, or a ROS 1 `.bag`.

    Raises:
        BagError: there is no bag, or it is damaged; also raised while it is read.
        BlfDscError: it unpacks to more than the limit.
    """
    try:
        checked_files(path)
        reader: Any = Ros1Reader(path) if path.suffix == '.bag' else Reader(path)
        with reader:
            yield OpenBag(reader, path)
    except BlfDscError:
        raise
    except Exception as error:  # libraries raise nearly anything on damaged files
        raise BagError(f'{path} cannot be read as a bag: {_reason(path, error)}') from error


def checked_files(path: Path) -> list[Path]:
    """Return the files of a folder, or the one file; OSError for a pipe or a link out of it."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    for file in files:
        if path.is_dir() and not file.resolve().is_relative_to(path.resolve()):
            raise OSError(f'its file {file} is outside of the folder: copy it if you trust it')
        if file.exists() and not (file.is_file() or file.is_dir()):
            raise OSError(f'{file} is not a regular file')
    return files


def _reason(path: Path, error: Exception) -> str:
    if not path.exists():
        return 'there is no such folder'
    text = ' '.join(f'{error}'.split()).rstrip('.') or type(error).__name__
    is_mcap = any(path.glob('*.mcap')) if path.is_dir() else path.suffix == '.mcap'
    if path.is_dir() and not (path / METADATA).exists():
        within = sorted(path.glob(f'*/{METADATA}'))
        if is_mcap:
            text = f'the folder has no {METADATA}; was the recording interrupted?'
            return f'{text} Recover it: blf_dsc recover {path}'
        guess = f'; did you mean {within[0].parent}?' if within else ': it is not a bag'
        return f'the folder has no {METADATA}{guess}'
    is_damaged = is_mcap and not isinstance(error, OSError)
    return f'{text}; to save the undamaged part: blf_dsc recover {path}' if is_damaged else text
