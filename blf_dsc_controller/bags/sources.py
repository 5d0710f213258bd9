# SPDX-License-Identifier: Apache-2.0
"""All kinds of bags as topics and CDR messages, of which none is lost without an error.

The library rosbags opens them. It also reads the messages of sqlite3, ROS 1 and
compressed ones. Plain MCAP files are read here, which is faster, from begin to end,
with each chunk's checksum. What no checksum covers, such as a chunk whose opcode has
flipped, shows in the number of messages.
"""

from __future__ import annotations

import difflib
import errno
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from io import SEEK_CUR, SEEK_END, BytesIO
from pathlib import Path
from struct import Struct
from tempfile import gettempdir
from typing import Any, BinaryIO, NamedTuple
from zlib import crc32

import yaml
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema

from blf_dsc_controller.bags.unpacking import LARGEST, unpacked
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.codecs import typestore

METADATA = 'metadata.yaml'
_ROS1 = '.bag'
FILES = {'.mcap', '.db3', '.bag'}
"""Suffixes of the files of a bag."""
NOTHING_RECORDED = (
    'it is empty: nothing was recorded, as on a full disk: give another bag'
)
CDR = 'cdr'
_MAGIC = b'\x89MCAP0\r\n'
MAGIC_SIZE = len(_MAGIC)
HEAD = Struct('<BQ')  # opcode and content length, at the start of each record
_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_MESSAGE = Struct('<HIQQ')
_MESSAGE_CODE = int(Opcode.MESSAGE)  # compared for each message: an enumeration is slow
_KINDS: dict[int, Any] = {
    Opcode.CHUNK: Chunk,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
}


class BagError(BlfDscError):
    """A bag that cannot be read or written."""


class BagExistsError(BagError):
    """The folder of a new bag exists already."""


class BagMessage(NamedTuple):
    """A message in CDR, as recorded."""

    topic: str
    received: int  # ns
    raw: bytes
    sequence: int = 0  # assigned by its publisher; 0 if unknown


class OpenBag:
    """An open bag.

    Attributes:
        held: name and type, empty where unknown, of each topic.
        counts: number of messages of each topic.
    """

    def __init__(self, reader: Any, path: Path) -> None:
        self._reader, self._files = reader, list[Path]()
        self._is_ros1 = path.suffix == _ROS1
        self.held: dict[str, str] = {}
        self.counts: Counter[str] = Counter()
        for each in reader.connections:
            self.held[each.topic] = each.msgtype.replace('__schemaless__', '')
            self.counts[each.topic] += each.msgcount
        if not self._is_ros1 and reader.compression_mode != 'message':
            storage: Any = reader.storage
            parts: list[Any] = storage.storages if path.is_dir() else [storage]
            self._files = [part.path for part in parts if part.path.suffix == '.mcap']

    def messages(self, topics: Collection[str]) -> Iterator[BagMessage]:
        """Yield the messages of `topics`, nearly in order of reception.

        Raises:
            ValueError: the number of messages of any topic is not the one that the bag states.
        """
        found: Counter[str] = Counter()
        for message in self._of_files() if self._files else self._of_library(topics):
            found[message.topic] += 1
            if message.topic in topics:
                yield message
        for topic in (*topics, *self.held, *found):
            if found[topic] != self.counts[topic]:
                raise ValueError(
                    f'it holds {found[topic]} messages of {topic}, but counts {self.counts[topic]}'
                )

    def _of_files(self) -> Iterator[BagMessage]:
        for path in self._files:
            names: dict[int, str] = {}
            with path.open('rb') as stream:
                for record in _records(stream):
                    if isinstance(record, tuple):
                        number, sequence, received, _, raw = record
                        yield BagMessage(names[number], received, raw, sequence)
                    elif isinstance(record, Channel):
                        names[record.id] = record.topic

    def _of_library(self, topics: Collection[str]) -> Iterator[BagMessage]:
        for each, received, raw in self._reader.messages():
            if self._is_ros1 and each.topic in topics:
                # ROS 1 and 2 serialise the common types alike, except for padding and
                # `seq`.
                raw = typestore().ros1_to_cdr(raw, each.msgtype)  # noqa: PLW2901
            yield BagMessage(each.topic, received, bytes(raw))


def _records(stream: BinaryIO) -> Iterator[Any]:
    """Yield the records of a file; None for those that are not needed."""
    size = stream.seek(0, SEEK_END)
    stream.seek(MAGIC_SIZE)
    while stream.tell() < size - MAGIC_SIZE:
        record = next_record(stream, size, _KINDS)
        yield from records_in(record) if isinstance(record, Chunk) else [record]


def next_record(stream: BinaryIO, size: int, kinds: Mapping[int, Any]) -> Any:
    """Return the next record of a file of `size` bytes, None if it is of another kind.

    Raises any error if it does not match its length.
    """
    head = stream.read(HEAD.size).ljust(HEAD.size, b'\xff')
    opcode, length = HEAD.unpack(head)
    if stream.tell() + length > size:
        raise ValueError('cut off')
    if opcode == 0:  # of a hole in the file: each is a record without content
        raise ValueError('zeros instead of a record')
    if length > LARGEST and (opcode == Opcode.MESSAGE or opcode in kinds):
        raise ValueError(f'a record has {length} bytes')
    if opcode == Opcode.MESSAGE:
        content = stream.read(length)
        return *_MESSAGE.unpack_from(content), content[_MESSAGE.size :]
    if opcode not in kinds:
        stream.seek(length, SEEK_CUR)
        return None
    fields = ReadDataStream(BytesIO(stream.read(length)))
    record = kinds[opcode].read(fields)
    if fields.count != length:
        raise ValueError('a record does not match its length')
    return record


def records_in(chunk: Chunk) -> Iterator[Any]:
    """Yield the content of a chunk; ValueError if it differs from what was written.

    A message is a tuple: channel number, sequence number, log time and publish time
    [ns], content.
    """
    size = chunk.uncompressed_size
    if size > LARGEST:
        raise ValueError(f'a chunk would unpack to {size} bytes')
    records = unpacked(chunk.data, chunk.compression, size)
    if len(records) != size:
        raise ValueError(f'a chunk of {size} bytes unpacks to {len(records)}')
    if chunk.uncompressed_crc not in (0, crc32(records)):
        raise ValueError('a chunk does not match its checksum')
    at = 0
    message = _MESSAGE.unpack_from
    while at < size:
        opcode, length = HEAD.unpack_from(records, at)
        begin = at + HEAD.size
        at = at + HEAD.size + length
        if at > size:
            raise ValueError('a record does not match its length')
        if opcode == _MESSAGE_CODE:
            yield *message(records, begin), records[begin + _MESSAGE.size : at]
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            yield _KINDS[opcode].read(ReadDataStream(BytesIO(records[begin:at])))
        else:
            raise ValueError(f'unknown record type {opcode} in a chunk')


@contextmanager
def open_bag(path: Path) -> Iterator[OpenBag]:
    """Open a bag for reading: a folder, one of its storage files, or a ROS 1 `.bag`.

    Raises:
        BagError: there is no bag, or it is damaged; also raised while it is read.
    """
    from rosbags import rosbag1, rosbag2  # a recorder needs neither

    check_regular(path)
    opened = _only_file(path) or path
    try:
        reader: Any = (rosbag1 if path.suffix == _ROS1 else rosbag2).Reader(opened)
        with reader:
            yield OpenBag(reader, opened)
    except BlfDscError:
        raise
    except Exception as error:  # libraries raise nearly anything on damaged files
        raise BagError(
            f'{path} cannot be read as a bag: '
            f'{_no_room(error) or _missing(path) or _reason(path, error)}'
        ) from error


def _only_file(path: Path) -> Path | None:
    """Return the only database of a folder without metadata; None otherwise.

    An MCAP without metadata is of an interrupted recording, which is to be recovered.
    """
    if not path.is_dir() or (path / METADATA).exists():
        return None
    files = list(path.glob('*.db3'))
    return files[0] if len(files) == 1 else None


def check_regular(path: Path) -> None:
    """Raise BagError if a file of the bag is a pipe or a device."""
    files = path.iterdir() if path.is_dir() else [path]
    for file in files:
        if file.exists() and not (file.is_file() or file.is_dir()):
            raise BagError(f'{file} is not a regular file, so it is no file of a bag')


def _no_room(error: Exception) -> str:
    if isinstance(error, OSError) and error.errno in _FULL:
        return (
            f'{gettempdir()} has no room for temporary data ({error.strerror}): free some, or set '
            'TMPDIR to another folder'
        )
    return ''


def _reason(path: Path, error: Exception) -> str:
    from blf_dsc_controller.tables.table_files import TABLES  # a recorder needs none

    if not path.exists():
        return f'there is none{near(path)}'
    if path.suffix in TABLES:
        return 'it is a table, which only blf_dsc identify reads: give a bag'
    files = sorted(path.glob('*.mcap')) if path.is_dir() else [path]
    is_mcap = bool(files) and files[0].suffix == '.mcap'
    if path.is_dir() and not (path / METADATA).exists():
        text = f'the folder has no {METADATA}'
        if not is_mcap:
            return text + _instead_of(path)
        return _reason_of_mcap(
            files, f'{text}, as after an interrupted recording', path
        )
    text = ' '.join(f'{error}'.split()).rstrip('.') or type(error).__name__
    if is_mcap and not isinstance(error, OSError):
        return _reason_of_mcap(files, text, path)
    is_other = path.is_file() and path.suffix not in FILES
    return 'a bag is a folder, or a file in .mcap, .db3 or .bag' if is_other else text


def _reason_of_mcap(files: Sequence[Path], text: str, path: Path) -> str:
    """Return why the files of a bag cannot be read, which `text` says if they are MCAP."""
    for file in files:
        encoding = other_encoding(file)
        if encoding:
            return f'its messages are {encoding}, not CDR of ROS 2: {_remedy(encoding)}'
    if not any(file.stat().st_size for file in files):
        return NOTHING_RECORDED
    if not any(map(_has_magic, files)):
        return 'it is no MCAP file: give a bag'
    return f'{text}; to save the undamaged part: blf_dsc recover {path}'


def _missing(folder: Path) -> str:
    """Return which files a folder lacks that its metadata names, and what to do."""
    names: list[str] = []
    # where the metadata is of another kind or damaged, the library says so
    with suppress(OSError, ValueError, LookupError, TypeError, yaml.YAMLError):
        stated = yaml.safe_load((folder / METADATA).read_text())
        files = stated['rosbag2_bagfile_information']['relative_file_paths']
        names = [Path(each).name for each in files]
    lost = [name for name in names if not (folder / name).exists()]
    if not lost:
        return ''
    text = (
        f'its {METADATA} names {", ".join(lost)}, which the folder lacks: copy it there'
    )
    if any(folder.glob('*.mcap')):
        text += f'; to save what its other files hold: blf_dsc recover {folder}'
    return text


def _has_magic(file: Path) -> bool:
    """Whether a file begins or ends as one in MCAP does, also if it was damaged."""
    with file.open('rb') as stream:
        begin = stream.read(MAGIC_SIZE)
        stream.seek(-min(MAGIC_SIZE, file.stat().st_size), SEEK_END)
        return _MAGIC in (begin, stream.read())


def near(path: Path) -> str:
    """Return what may be meant by a path at which there is nothing."""
    folder = path.parent
    names = [each.name for each in folder.iterdir()] if folder.is_dir() else []
    close = difflib.get_close_matches(path.name, names, n=1)
    if close:
        return f', did you mean {folder / close[0]}?'
    return ': give the folder of a bag, such as out/demo/bag'


def _instead_of(path: Path) -> str:
    """Return what may be meant by a folder without metadata or MCAP files."""
    databases = sorted(path.glob('*.db3'))
    if databases:
        return f': give one of its {len(databases)} files, as {databases[0]}'
    within = [f'; did you mean {each.parent}?' for each in path.glob(f'*/{METADATA}')]
    return min(within, default=': it is not a bag')


def other_encoding(path: Path) -> str:
    """Return the encoding of the messages in an MCAP file if it is not CDR, else nothing."""
    with suppress(Exception), path.open('rb') as stream:  # anything, if it is damaged
        for record in _records(stream):
            if isinstance(record, Channel) and record.message_encoding != CDR:
                return record.message_encoding or 'of an unknown encoding'
    return ''


def _remedy(encoding: str) -> str:
    if encoding == 'ros1':
        return 'give the .bag of ROS 1 from which it was converted'
    return 'export its joint states as CSV, which `blf_dsc identify` reads'
