# SPDX-License-Identifier: Apache-2.0
"""Reader of all kinds of bags as topics and CDR messages: rosbag2 (MCAP, sqlite3), ROS 1."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeAlias

from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag1.reader import decompressors
from zstandard import FRAME_HEADER

from blf_dsc_controller.bags import mcap_index, mcap_reader, sqlite_reader
from blf_dsc_controller.bags.folder import METADATA, BagFolder, StoredTopic, checked, read_folder
from blf_dsc_controller.bags.metadata import strongest_quality
from blf_dsc_controller.bags.unpacking import Unpacker
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.topics import FOREVER
from blf_dsc_controller.messages.types import typestore

Messages: TypeAlias = Iterator[tuple[str, int, bytes]]
"""Topic, time of reception [ns] and content in CDR."""

_FILES = {'.mcap': ('mcap', mcap_index.topics_of), '.db3': ('sqlite3', sqlite_reader.topics_of)}


Read: TypeAlias = Callable[[Collection[str], 'tuple[int, int] | None'], Messages]
"""Messages of these topics: all, or those of a time span [ns], ordered by time."""


class BagError(BlfDscError):
    """A bag that cannot be read or written."""


class OpenBag:
    """An open bag.

    Attributes:
        held: name and type, empty where unknown, of each topic.
        counts: number of messages of each topic.
        offered: quality of service that the publishers of each topic offered.
        times: of the first message and after the last [ns].
    """

    def __init__(self, topics: Iterable[StoredTopic], times: tuple[int, int], read: Read) -> None:
        self.held = list(dict.fromkeys((one.name, one.type) for one in topics))
        self.counts: Counter[str] = Counter()
        for one in topics:
            self.counts[one.name] += one.message_count
        self.offered = {one.name: one.offered for one in topics}
        self.times = times
        self._read = read

    def messages(self, topics: Collection[str]) -> Messages:
        """Return all messages of `topics`; those of one topic nearly in order of reception."""
        return self._read(topics, None)

    def in_order(self, topics: Collection[str], start: int = 0, stop: int = FOREVER) -> Messages:
        """Return the messages from `start` to before `stop` [ns], in order of reception.

        This takes half as long again, but only a few chunks of the bag are in memory at a time.
        """
        return self._read(topics, (start, stop))


@contextmanager
def open_bag(path: Path) -> Iterator[OpenBag]:
    """Open a bag for reading: a folder, one of its storage files, or a ROS 1 `.bag`.

    Raises:
        BagError: there is no bag, or it is damaged; also raised while it is read.
        BlfDscError: it unpacks to more than the limit.
    """
    try:
        if path.suffix == '.bag' and not path.is_dir():
            with Reader1(checked(path, [path])[0]) as reader1:
                yield _ros1_bag(path, reader1)
            return
        bag = _described(path)
        temporary = TemporaryDirectory() if bag.compression == 'file' else nullcontext('')
        with temporary as folder:
            yield _ros2_bag(bag, Path(folder))
    except BlfDscError:
        raise
    except Exception as error:  # libraries raise nearly anything on damaged files
        raise BagError(f'{path} cannot be read as a bag: {_reason(path, error)}') from error


def _described(path: Path) -> BagFolder:
    """Return files and topics of a folder, or of a single storage file."""
    if path.is_dir():
        return read_folder(path)
    (file,) = checked(path, [path])
    if file.suffix not in _FILES:
        raise ValueError(f'it is neither a folder nor one of {", ".join([*_FILES, ".bag"])}')
    storage, topics_of = _FILES[file.suffix]
    return BagFolder(storage, '', [file], *topics_of(file))


def _ros2_bag(bag: BagFolder, temporary: Path) -> OpenBag:
    """Open the files of a bag; those compressed as a whole are first unpacked to `temporary`."""
    files = bag.files
    if bag.compression == 'file':
        files = [temporary / f'{k}' for k in range(len(files))]
        unpacker = Unpacker(bag.files)
        for packed, file in zip(bag.files, files, strict=True):
            with packed.open('rb') as source, file.open('xb') as target:
                unpacker.unpack_file(source, target)

    def read(topics: Collection[str], span: tuple[int, int] | None) -> Messages:
        unpacker = Unpacker(bag.files)
        for file in files:
            if bag.storage == 'sqlite3':
                found = sqlite_reader.read_messages(file, topics, unpacker)
            elif span is None:
                found = mcap_reader.read_messages(file, topics, unpacker)
            else:
                found = mcap_index.read_in_order(file, topics, *span)
            for topic, received, raw in found:
                if span is None or span[0] <= received < span[1]:
                    is_packed = raw.startswith(FRAME_HEADER)  # per message; CDR never does
                    yield topic, received, unpacker.unpack(raw, 'zstd') if is_packed else raw

    return OpenBag(bag.topics, bag.times, read)


def _ros1_bag(path: Path, reader: Reader1) -> OpenBag:
    unpacker = Unpacker([path])
    names = {function: name for name, function in decompressors.items()}
    for at, chunk in reader.chunks.items():
        unpack = partial(unpacker.unpack, compression=names[chunk.decompressor])
        reader.chunks[at] = chunk._replace(decompressor=unpack)
    topics = [
        StoredTopic(
            one.topic,
            one.msgtype,
            one.msgcount,
            strongest_quality('', is_latched=bool(getattr(one.ext, 'latching', 0))),
        )
        for one in reader.connections
    ]

    def read(topics: Collection[str], span: tuple[int, int] | None) -> Messages:
        # ROS 1 and 2 serialise the common types alike, except for padding and the header's `seq`.
        chosen = [one for one in reader.connections if one.topic in topics]
        for one, received, raw in reader.messages(chosen, *(span or ())) if chosen else ():
            yield one.topic, received, bytes(typestore().ros1_to_cdr(raw, one.msgtype))

    return OpenBag(topics, (reader.start_time, reader.end_time), read)


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
                return f'the folder has no metadata.yaml{guess}'
            return (
                'the folder has no metadata.yaml; was the recording interrupted? '
                f'Recover it: bag_recover {path}'
            )
    is_damaged = is_mcap and not isinstance(error, OSError)
    return f'{text}; to save the undamaged part: bag_recover {path}' if is_damaged else text
