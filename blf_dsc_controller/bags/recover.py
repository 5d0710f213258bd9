# SPDX-License-Identifier: Apache-2.0
"""Recovery of a clean bag from a damaged one, which is only read."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field
from mmap import ACCESS_READ, mmap
from pathlib import Path

from mcap.records import Channel
from zstandard import FRAME_HEADER, ZstdError

from blf_dsc_controller.bags.context import ATTACHMENT, MESSAGES, RECORD, Losses, statistics
from blf_dsc_controller.bags.folder import checked
from blf_dsc_controller.bags.mcap_reader import StoredMessage, mcap_files
from blf_dsc_controller.bags.metadata import parse_profiles
from blf_dsc_controller.bags.salvage import Loss, Salvage
from blf_dsc_controller.bags.sources import BagError
from blf_dsc_controller.bags.unpacking import Unpacker
from blf_dsc_controller.bags.writer import BagWriter
from blf_dsc_controller.messages.types import Definition, UnknownTypeError, definition


@dataclass
class Recovery:
    """Result of a recovery."""

    path: Path  # of the clean bag
    messages: dict[str, int] = field(default_factory=dict)  # recovered, by topic
    missing: dict[str, Losses] = field(default_factory=dict)  # from sequence numbers, by topic
    losses: list[Loss] = field(default_factory=list)
    unfinished: list[tuple[str, int | None]] = field(default_factory=list)  # file, last time [ns]
    unknown: int = 0  # messages of topics whose name or type is lost

    @property
    def is_whole(self) -> bool:
        """Whether no loss is known."""
        return not (self.losses or self.unfinished or self.unknown)

    @property
    def is_empty(self) -> bool:
        """Whether everything is lost."""
        return not (self.is_whole or any(self.messages.values()))


def recover(path: Path, out: Path) -> Recovery:
    """Write what a damaged folder or MCAP file still holds to a clean bag `out`.

    Raises:
        BagError: there is no MCAP file, or `out` exists already.
        BlfDscError: it unpacks to more than the limit.
        OSError: a file is not a regular file, or is outside of the folder.
    """
    files = [file for file in mcap_files(path) if file.exists()]
    if not files:
        raise BagError(f'{path} cannot be read as a bag: there is no MCAP file to recover')
    unpacker = Unpacker(checked(path, files))
    recovery = Recovery(out)
    with BagWriter(out, flush_interval=None) as bag:
        transfer = _Transfer(bag, recovery.missing, unpacker)
        for file in files:
            salvage = Salvage(file, unpacker)
            recovery.unknown += transfer.copy(salvage)
            recovery.losses += salvage.losses
            if not salvage.is_complete:
                recovery.unfinished.append((file.name, salvage.last))
        recovery.messages = bag.message_counts
        bag.note({'recovered_from': str(path)} | statistics(bag.message_counts, recovery.missing))
    return recovery


@dataclass
class _Transfer:
    """Transfer of the content of damaged files to a clean bag."""

    bag: BagWriter
    missing: dict[str, Losses]
    unpacker: Unpacker
    handles: dict[str, int] = field(default_factory=dict)

    def copy(self, salvage: Salvage) -> int:
        """Copy a file and return the number of messages whose topic is lost."""
        with salvage.path.open('rb') as stream:
            is_empty = salvage.path.stat().st_size == 0
            data = b'' if is_empty else mmap(stream.fileno(), 0, access=ACCESS_READ)
        # The index at the end, or another record, may still name the topic of a message.
        early = [one for one in salvage.messages(data) if not self._write(salvage, one)]
        unknown = sum(not self._write(salvage, one) for one in early)
        for one in salvage.attachments:
            if one.name == ATTACHMENT:
                self.bag.configure(one.data.decode(errors='replace'), one.log_time)
        facts = salvage.metadata.get(RECORD, {})
        self.bag.note({k: v for k, v in facts.items() if not k.startswith(MESSAGES)})
        return unknown

    def _write(self, salvage: Salvage, message: StoredMessage) -> bool:
        number, sequence, log_time, publish_time, raw = message
        channel = salvage.channel(number)
        if channel is None:
            return False
        handle = self.handles.get(channel.topic) or self._add_topic(salvage, channel)
        if handle is None:
            return False
        self.missing[channel.topic].count(sequence)
        if raw.startswith(FRAME_HEADER):  # compressed per message, as metadata.yaml would state
            with suppress(ZstdError, ValueError):
                raw = self.unpacker.unpack(raw, 'zstd')
        self.bag.write(handle, raw, log_time, publish_time, sequence)
        return True

    def _add_topic(self, salvage: Salvage, channel: Channel) -> int | None:
        schema = salvage.schemas.get(channel.schema_id)
        type_name = salvage.type_of(channel)
        if not type_name:
            return None
        try:
            known = definition(type_name)
        except UnknownTypeError:
            known = Definition('', '')
        if schema is not None and schema.data:
            text = schema.data.decode(errors='replace')
            known = known._replace(text=text, encoding=schema.encoding)
        if channel.metadata.get('topic_type_hash'):
            known = known._replace(hash=channel.metadata['topic_type_hash'])
        offered = parse_profiles(channel.metadata.get('offered_qos_profiles', ''))
        handle = self.bag.add_topic(channel.topic, type_name, offered, known)
        self.handles[channel.topic] = handle
        self.missing[channel.topic] = Losses(len(offered))
        return handle
