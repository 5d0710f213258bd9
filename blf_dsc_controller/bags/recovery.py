# SPDX-License-Identifier: Apache-2.0
"""Recovery of a damaged bag, which is only read, as a clean one.

Every chunk whose checksum matches is kept. After a record that cannot be read, the next
chunk is where the index at the end of the file says; without that index, as after a
kill, the rest is lost.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from io import SEEK_END
from pathlib import Path
from struct import Struct
from typing import Any, BinaryIO, NamedTuple
from zlib import crc32

import yaml
from mcap import records
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, DataEnd, Schema, Statistics
from mcap.summary import Summary
from zstandard import FRAME_HEADER, ZstdError

from blf_dsc_controller.bags.sources import (
    CDR,
    MAGIC_SIZE,
    METADATA,
    NOTHING_RECORDED,
    BagError,
    check_regular,
    near,
    next_record,
    records_in,
)
from blf_dsc_controller.bags.unpacking import unpacked
from blf_dsc_controller.bags.writer import BagWriter
from blf_dsc_controller.configuration.files import load_yaml
from blf_dsc_controller.messages.codecs import Definition
from blf_dsc_controller.writing import writing

# in the footer: begin of the summary and its offsets, and their checksum
_END = Struct('<QQI')
_KINDS: dict[int, Any] = {
    opcode: getattr(records, opcode.name.title().replace('_', ''))
    for opcode in Opcode
    if opcode != Opcode.MESSAGE
}


class Recovery(NamedTuple):
    """Result of a recovery."""

    messages: dict[str, int]  # in the clean bag, by topic
    losses: list[str]


def recover(path: Path, out: Path) -> Recovery:
    """Write what a damaged folder or MCAP file still holds to a clean bag `out`.

    Raises:
        BagError: there is no MCAP file, or nothing in any; or `out` exists already.
        BlfDscError: `out` cannot be written; nothing of it is left.
    """
    files = _files_of(path)
    with (
        writing(out) as part,
        BagWriter(part, name=out.name, flush_interval=None) as bag,
    ):
        losses = [
            f'{file.name}: {loss}' for file in files for loss in _copied(file, bag)
        ]
    return Recovery(bag.message_counts, losses)


def _files_of(path: Path) -> list[Path]:
    """Return the MCAP files of a bag, in order.

    Raises BagError if there is none, or nothing in any.
    """
    check_regular(path)
    if not path.exists():
        problem = f'there is none{near(path)}'
    elif path.is_file() and path.suffix != '.mcap':
        problem = 'give its folder, or its file in .mcap: only these are recovered'
    else:
        candidates = path.glob('*.mcap') if path.is_dir() else [path]
        files = [file for file in candidates if file.is_file()]
        if any(file.stat().st_size for file in files):
            # bag_10 after bag_9
            return sorted(files, key=lambda file: (len(file.name), file.name))
        problem = NOTHING_RECORDED if files else _no_file(path)
    raise BagError(f'{path} cannot be read as a bag: {problem}')


def _no_file(folder: Path) -> str:
    """Return what a folder without MCAP files lacks, and what to do."""
    if databases := sorted(folder.glob('*.db3')):
        return (
            'it has no file in .mcap, and only these are recovered. sqlite3 recovers its own: '
            f'`sqlite3 {databases[0]} .recover | sqlite3 recovered.db3`'
        )
    if (folder / METADATA).exists():
        return (
            f'there is no file in .mcap beside its {METADATA}: the messages were in that file. '
            'Copy it there from where the bag was recorded; without it, nothing can be recovered'
        )
    return 'there is no file in .mcap: give the folder that has one, or the file'


def _copied(path: Path, bag: BagWriter) -> Iterator[str]:
    """Copy what a damaged file holds to a clean bag, and yield its losses."""
    is_closed = False
    last = -1  # latest time of a message copied [ns]
    found = Counter[int]()  # messages of each channel
    lost = Counter[str]()  # messages that are not copied, by what they are
    handles: dict[int, int] = {}  # by number of the channel; 0 where it is unknown
    with path.open('rb') as stream:
        size = stream.seek(0, SEEK_END)
        summary = _summary(stream, size)
        for record in _records(stream, size, summary):
            if isinstance(record, tuple):
                number, sequence, received, published, raw = record
                found[number] += 1
                if not handles.get(number):  # its topic may have become known
                    handles[number] = _handle(bag, summary, number)
                plain = _plain(raw, summary.channels.get(number), handles[number])
                if isinstance(plain, str):
                    lost[plain] += 1
                else:
                    last = max(last, received)
                    bag.write(handles[number], plain, received, published, sequence)
            elif not isinstance(record, str):
                _note(record, summary)
            elif not is_closed:
                after = '' if last < 0 else f', after {last * 1e-9:.6f} s'
                yield record + after
            is_closed |= isinstance(record, DataEnd)
    if not is_closed:
        ends = 'nothing in it could be read'
        if last >= 0:
            ends = f'it ends at {last * 1e-9:.6f} s'
        yield (
            f'the recording was not closed; {ends}. Later messages are lost: usually the last '
            '0.1 s before a kill, more if the computer was overloaded or lost power'
        )
    for kind, count in lost.items():
        yield f'{count} {kind}'
    yield from _missing(summary, found)


def _plain(raw: bytes, channel: Channel | None, handle: int) -> bytes | str:
    """Return a message, decompressed if needed; if it cannot be copied, what it is."""
    if channel and channel.message_encoding != CDR:
        encoding = channel.message_encoding or 'unknown'
        return f'messages of {channel.topic}: they are {encoding}, not CDR'
    if not handle:
        return 'messages of topics whose name or type is unknown'
    if not raw.startswith(FRAME_HEADER):  # CDR never begins like that
        return raw
    try:
        return unpacked(raw, 'zstd')
    except (ValueError, ZstdError):
        return 'compressed messages that cannot be unpacked'


def _note(record: Any, summary: Summary) -> None:
    """Note a type, a topic, numbers of messages, or the place of a chunk."""
    if isinstance(record, Schema):
        summary.schemas[record.id] = record
    elif isinstance(record, Channel):
        summary.channels[record.id] = record
    elif isinstance(record, Statistics):
        summary.statistics = record
    elif isinstance(record, ChunkIndex):
        summary.chunk_indexes.append(record)


def _missing(summary: Summary, found: Counter[int]) -> Iterator[str]:
    """Yield how many messages are missing of those stated at the end of a file."""
    stated = Counter(
        summary.statistics.channel_message_counts if summary.statistics else ()
    )
    for number, count in (stated - found).items():
        topic = (
            summary.channels[number].topic
            if number in summary.channels
            else f'{number}'
        )
        yield f'{count} of {stated[number]} messages of {topic}'


def _handle(bag: BagWriter, summary: Summary, number: int) -> int:
    """Return the handle of a channel in the clean bag, 0 if it is unknown or not CDR."""
    channel = summary.channels.get(number)
    schema = summary.schemas.get(channel.schema_id) if channel else None
    if channel is None or schema is None or channel.message_encoding != CDR:
        return 0
    earlier = [*bag.message_counts]  # from other files
    if channel.topic in earlier:
        return 1 + earlier.index(channel.topic)
    hash_ = channel.metadata.get('topic_type_hash', '')
    offered = None
    definition = Definition(
        schema.data.decode(errors='replace'), hash_, schema.encoding
    )
    with suppress(yaml.YAMLError):
        offered = load_yaml(channel.metadata.get('offered_qos_profiles', ''))
    profiles = offered if isinstance(offered, list) else []
    return bag.add_topic(channel.topic, schema.name, profiles, definition)


def _summary(stream: BinaryIO, size: int) -> Summary:
    """Return topics and index at the end of a file, if they match a checksum.

    Only there are the topics known if the first chunk is damaged.
    """
    summary = Summary()
    with suppress(Exception):  # anything, if the bytes are arbitrary
        stream.seek(size - MAGIC_SIZE - _END.size)
        start, _, checksum = _END.unpack(stream.read(_END.size))
        stream.seek(start)
        if checksum in (0, crc32(stream.read(size - MAGIC_SIZE - 4 - start))):
            stream.seek(start)
            while stream.tell() < size - MAGIC_SIZE:
                _note(next_record(stream, size, _KINDS), summary)
    return summary


def _records(stream: BinaryIO, size: int, summary: Summary) -> Iterator[Any]:
    """Yield each record, also those in chunks, and where and why something is none."""
    starts = [index.chunk_start_offset for index in summary.chunk_indexes]
    at, chunks = MAGIC_SIZE, set[int]()
    while at < size:
        stream.seek(at)
        end = 0
        try:
            record = next_record(stream, size, _KINDS)
            if record is None or ((starts or chunks) and isinstance(record, tuple)):
                raise ValueError('no such record belongs here')  # noqa: TRY301
            end = stream.tell()
            if not isinstance(record, Chunk):
                yield record
            elif hash(record.data) in chunks:
                yield f'{end - at} bytes at byte {at} (a chunk that the file holds twice)'
            else:
                chunks.add(hash(record.data))
                yield from records_in(record)
        except Exception as error:  # noqa: BLE001 - anything, if the bytes are arbitrary
            end = end or min((start for start in starts if start > at), default=size)
            yield f'{end - at} bytes at byte {at} ({f"{error}" or type(error).__name__})'
        at = end
