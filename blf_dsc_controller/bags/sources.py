# SPDX-License-Identifier: Apache-2.0
"""All kinds of bags as topics and CDR messages.

MCAP files are read by `McapFile`; sqlite3, compressed files or messages, and ROS 1 by rosbags.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePath
from typing import NamedTuple, TypeAlias

import yaml
from mcap.records import Channel
from rosbags.highlevel import AnyReader
from zstandard import ZstdDecompressor

from blf_dsc_controller.bags.mcap_file import Allowance, McapFile, unpacked
from blf_dsc_controller.bags.metadata import parse_qualities, strongest_quality
from blf_dsc_controller.configuration.files import load_yaml, read_text
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.topics import Quality
from blf_dsc_controller.messages.types import typestore

METADATA = 'metadata.yaml'
RECORD = 'blf_dsc_controller'
"""Name of the metadata record with the facts."""

VERSION = 'package_version'
MESSAGES = 'messages '
"""Prefix of the names of facts that count the written and lost messages of a topic."""

_NEWEST = 9  # latest supported version of rosbag2's metadata.yaml
_NAMES_ONLY = 4  # paths of earlier versions begin with the folder's name
_STORAGES = ('mcap', 'sqlite3')
_FILES = ('.mcap', '.db3', '.bag')


class BagError(BlfDscError):
    """A bag that cannot be read or written."""


class BagMessage(NamedTuple):
    """A message in CDR, as recorded."""

    topic: str
    received: int  # ns
    raw: bytes
    sequence: int = 0  # assigned by its publisher; 0 if unknown


Messages: TypeAlias = Iterator[BagMessage]


class StoredTopic(NamedTuple):
    """One topic of a bag."""

    name: str
    type: str  # empty if it is unknown
    message_count: int
    offered: Quality  # by its publishers


class OpenBag:
    """An open bag.

    Attributes:
        held: name and type, empty where unknown, of each topic.
        counts: number of messages of each topic.
        offered: quality of service that the publishers of each topic offered.
        times: of the first message and after the last [ns].
    """

    def __init__(self, topics: Iterable[StoredTopic], times: tuple[int, int]) -> None:
        topics = list(topics)
        self.held = list(dict.fromkeys((one.name, one.type) for one in topics))
        self.counts: Counter[str] = Counter()
        for one in topics:
            self.counts[one.name] += one.message_count
        self.offered = {one.name: one.offered for one in topics}
        self.times = times

    @property
    def facts(self) -> dict[str, str]:
        """What a recorder of this package noted about the run; complete once all is read."""
        return {}

    def messages(self, topics: Collection[str], start: int = 0) -> Messages:
        """Yield the messages of `topics` from `start` [ns] on, nearly in order of reception.

        Raises:
            BagError: their number is not the one that the bag states.
        """
        found: Counter[str] = Counter()
        for one in self._read(topics, start):
            found[one.topic] += 1
            if one.received >= start:
                yield one
        for topic in topics if start == 0 else ():
            if found[topic] != self.counts[topic]:
                raise ValueError(
                    f'it holds {found[topic]} messages of {topic}, but counts {self.counts[topic]}'
                )

    def _read(self, topics: Collection[str], start: int) -> Messages:
        raise NotImplementedError


class _McapBag(OpenBag):
    """One or several MCAP files, of which a metadata.yaml may state the counts."""

    def __init__(self, paths: list[Path], stated: Mapping[str, int] | None = None) -> None:
        self._allowance = Allowance(paths)
        self._files = [McapFile(path, self._allowance) for path in paths]
        super().__init__(
            (topic for file in self._files for topic in _topics_of(file)),
            (
                min((one.statistics.message_start_time for one in self._files
                     if one.statistics and one.statistics.message_count), default=0),
                max((one.statistics.message_end_time + 1 for one in self._files
                     if one.statistics and one.statistics.message_count), default=0),
            ),
        )  # fmt: skip
        for topic, count in (stated or {}).items():
            if count != self.counts[topic]:
                raise ValueError(
                    f'its {METADATA} counts {count} messages of {topic}, its files '
                    f'{self.counts[topic]}'
                )

    @property
    def facts(self) -> dict[str, str]:
        """What a recorder of this package noted about the run; complete once all is read."""
        records = (file.metadata.get(RECORD, {}) for file in self._files)
        return {name: text for record in records for name, text in record.items()}

    def _read(self, topics: Collection[str], start: int) -> Messages:
        def wanted(channel: Channel) -> bool:
            return channel.topic in topics

        for file in self._files:
            for number, sequence, log_time, _, raw in file.messages(wanted, start):
                raw = unpacked(raw, self._allowance)  # noqa: PLW2901
                yield BagMessage(file.channels[number].topic, log_time, raw, sequence)


def _topics_of(file: McapFile) -> Iterator[StoredTopic]:
    for number, one in file.channels.items():
        type_ = file.schemas[one.schema_id].name if one.schema_id in file.schemas else ''
        offered = strongest_quality(parse_qualities(one.metadata.get('offered_qos_profiles')))
        yield StoredTopic(one.topic, type_, file.counts[number], offered)


class _OtherBag(OpenBag):
    """A bag that rosbags reads."""

    def __init__(self, reader: AnyReader, files: list[Path]) -> None:
        self._reader, self._allowance = reader, Allowance(files)
        topics = (
            StoredTopic(
                one.topic,
                one.msgtype,
                one.msgcount,
                strongest_quality(
                    parse_qualities(getattr(one.ext, 'offered_qos_profiles', ())),
                    is_latched=bool(getattr(one.ext, 'latching', 0)),
                ),
            )
            for one in reader.connections
        )
        super().__init__(topics, (reader.start_time, reader.end_time))

    def _read(self, topics: Collection[str], start: int) -> Messages:
        chosen = [one for one in self._reader.connections if one.topic in topics]
        for one, received, raw in self._reader.messages(chosen, start or None) if chosen else ():
            self._allowance.take(len(raw))
            raw = unpacked(bytes(raw), self._allowance)  # noqa: PLW2901
            if not self._reader.is2:
                # ROS 1 and 2 serialise the common types alike, except for padding and `seq`.
                raw = bytes(typestore().ros1_to_cdr(raw, one.msgtype))  # noqa: PLW2901
            yield BagMessage(one.topic, received, raw)


@contextmanager
def open_bag(path: Path) -> Iterator[OpenBag]:
    """Open a bag for reading: a folder, one of its storage files, or a ROS 1 `.bag`.

    Raises:
        BagError: there is no bag, or it is damaged; also raised while it is read.
        BlfDscError: it unpacks to more than the limit.
    """
    try:
        files, counts = (_described if path.is_dir() else _alone)(path)
        if counts is not None:
            yield _McapBag(files, counts)
            return
        with AnyReader([path], default_typestore=typestore()) as reader:
            yield _OtherBag(reader, files)
    except BlfDscError:
        raise
    except Exception as error:  # libraries raise nearly anything on damaged files
        raise BagError(f'{path} cannot be read as a bag: {_reason(path, error)}') from error


def _alone(path: Path) -> tuple[list[Path], dict[str, int] | None]:
    """Return a single file, and no counts for rosbags to read it."""
    if path.suffix not in _FILES:
        checked(path, [path])
        raise ValueError(f'it is neither a folder nor one of {", ".join(_FILES)}')
    return checked(path, [path]), {} if path.suffix == '.mcap' else None


def _described(path: Path) -> tuple[list[Path], dict[str, int] | None]:
    """Return files and counts of messages in a metadata.yaml; no counts for rosbags to read it.

    Raises:
        ValueError: it does not describe a supported bag.
    """
    (metadata,) = checked(path, [path / METADATA])
    try:
        tree = load_yaml(read_text(metadata))['rosbag2_bagfile_information']
        version, storage = int(tree['version']), str(tree['storage_identifier'])
        names = [PurePath(name) for name in tree['relative_file_paths']]
        compression = str(tree.get('compression_mode') or 'none').lower()
        counts: Counter[str] = Counter()
        for one in tree['topics_with_message_count']:
            counts[str(one['topic_metadata']['name'])] += int(one['message_count'])
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise ValueError(f'its {METADATA} does not describe a bag') from error
    except yaml.YAMLError as error:
        raise ValueError(
            f'its {METADATA} cannot be read: {" ".join(str(error).split())}'
        ) from error
    if version > _NEWEST:
        raise ValueError(
            f'its rosbag2 version is {version}, but only versions up to {_NEWEST} are supported'
        )
    if storage not in _STORAGES:
        raise ValueError(
            f'its storage is {storage!r}, but only {" and ".join(_STORAGES)} are supported'
        )
    files = checked(path, [path / (name.name if version < _NAMES_ONLY else name) for name in names])
    if compression == 'file':
        allowance = Allowance(files)
        for file in files:
            with file.open('rb') as stream:
                for part in ZstdDecompressor().read_to_iter(stream):
                    allowance.take(len(part))
    return files, counts if storage == 'mcap' and compression != 'file' else None


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


def _reason(path: Path, error: Exception) -> str:
    if not path.exists():
        return 'there is no such folder'
    text = str(error).rstrip('.') or type(error).__name__
    is_mcap = path.suffix == '.mcap'
    if path.is_dir():
        is_mcap = any(path.glob('*.mcap'))
        if not (path / METADATA).exists():
            if not is_mcap:
                within = sorted(path.glob(f'*/{METADATA}'))
                guess = f'; did you mean {within[0].parent}?' if within else ': it is not a bag'
                return f'the folder has no {METADATA}{guess}'
            return (
                f'the folder has no {METADATA}; was the recording interrupted? '
                f'Recover it: blf_dsc recover {path}'
            )
    is_damaged = is_mcap and not isinstance(error, OSError)
    return f'{text}; to save the undamaged part: blf_dsc recover {path}' if is_damaged else text
