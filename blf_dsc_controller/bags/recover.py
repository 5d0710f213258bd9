# SPDX-License-Identifier: Apache-2.0
"""A clean bag of all that a damaged one still holds; the damaged one is only read."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from mmap import ACCESS_READ, mmap
from pathlib import Path

from blf_dsc_controller.bags.context import ATTACHMENT, MESSAGES, RECORD
from blf_dsc_controller.bags.damage import Loss
from blf_dsc_controller.bags.errors import UnreadableBagError
from blf_dsc_controller.bags.losses import Losses
from blf_dsc_controller.bags.mcap_records import Channel, Message
from blf_dsc_controller.bags.mcap_writer import CHANNEL_RECORD
from blf_dsc_controller.bags.metadata import qualities
from blf_dsc_controller.bags.salvage import Salvage
from blf_dsc_controller.bags.scan import Data
from blf_dsc_controller.bags.writer import BagWriter
from blf_dsc_controller.messages.errors import UnknownTypeError
from blf_dsc_controller.messages.types import definition


@dataclass
class Recovery:
    """What was recovered, and what was not.

    Attributes:
        path: of the clean bag.
        messages: recovered, by topic.
        missed: numbers missing between recovered messages, by topic; None if not numbered.
        before: numbers missing before the first one, by topic.
        losses: pieces of the files that could not be read.
        unfinished: files that were not ended properly, and the time of their last message [ns].
        unknown: messages of topics whose name or type is not told any more.
    """

    path: Path
    messages: dict[str, int] = field(default_factory=dict)
    missed: dict[str, int | None] = field(default_factory=dict)
    before: dict[str, int] = field(default_factory=dict)
    losses: list[Loss] = field(default_factory=list)
    unfinished: list[tuple[str, int | None]] = field(default_factory=list)
    unknown: int = 0

    @property
    def is_whole(self) -> bool:
        """Whether nothing was lost that the files tell of."""
        return not (self.losses or self.unfinished or self.unknown)


def recover(path: Path, out: Path) -> Recovery:
    """Make a clean bag.

    Args:
        path: folder of the damaged bag, or one of its MCAP files.
        out: folder of the clean bag, which must not exist yet.

    Raises:
        UnreadableBagError: there is no MCAP file.
        BagExistsError: `out` is there already.
    """
    files = sorted(path.glob('*.mcap'), key=_number) if path.is_dir() else [path]
    files = [file for file in files if file.is_file() and file.suffix == '.mcap']
    if not files:
        raise UnreadableBagError(path, 'there is no MCAP file to recover')
    recovery = Recovery(out)
    with BagWriter(out, flush_interval=None) as bag:
        transfer = _Transfer(bag, recovery)
        for file in files:
            transfer.file(file)
        bag.note({'recovered_from': str(path), **transfer.statistics()})
    recovery.messages = bag.message_counts
    recovery.missed = {topic: one.missed for topic, one in transfer.losses.items()}
    recovery.before = {topic: one.before for topic, one in transfer.losses.items()}
    return recovery


class _Transfer:
    """From damaged files into a clean bag."""

    def __init__(self, bag: BagWriter, recovery: Recovery) -> None:
        self._bag = bag
        self._recovery = recovery
        self._handles: dict[str, int] = {}
        self.losses: dict[str, Losses] = {}

    def file(self, path: Path) -> None:
        salvage = Salvage(path)
        with _mapped(path) as data:
            orphans = [one for one in salvage.messages(data) if not self._write(salvage, one)]
        for message in orphans:  # the index at the end, or another record, may have told
            self._recovery.unknown += not self._write(salvage, message)
        self._describe(salvage)
        self._recovery.losses += salvage.losses
        if not salvage.is_complete:
            self._recovery.unfinished.append((path.name, salvage.last))

    def _write(self, salvage: Salvage, message: Message) -> bool:
        channel = salvage.channels.get(message.channel) or _repeated(salvage, message.channel)
        if channel is None:
            return False
        handle = self._handles.get(channel.topic)
        if handle is None:
            handle = self._announce(salvage, channel)
            if handle is None:
                return False
        self.losses[channel.topic].count(message.sequence)
        self._bag.write(
            handle, message.raw, message.log_time, message.publish_time, message.sequence
        )
        return True

    def _announce(self, salvage: Salvage, channel: Channel) -> int | None:
        schema = salvage.schemas.get(channel.schema)
        type_ = channel.metadata.get('topic_type', '') if schema is None else schema.name
        if not type_:
            return None
        told = '' if schema is None else schema.text
        known_text, known_hash = _known(type_)
        offered = qualities(channel.metadata.get('offered_qos_profiles', ''))
        handle = self._bag.add_topic(
            channel.topic,
            type_,
            offered,
            text=told or known_text,
            hash_=channel.metadata.get('topic_type_hash') or known_hash,
            encoding=schema.encoding if schema is not None and told else 'ros2msg',
        )
        self._handles[channel.topic] = handle
        self.losses[channel.topic] = Losses(len(offered))
        return handle

    def _describe(self, salvage: Salvage) -> None:
        for one in salvage.attachments:
            if one.name == ATTACHMENT:
                self._bag.configure(one.text, one.log_time)
        facts = salvage.metadata.get(RECORD, {})
        self._bag.note({k: v for k, v in facts.items() if not k.startswith(MESSAGES)})

    def statistics(self) -> dict[str, str]:
        """What the clean bag holds of each topic and what it lacks, in the recorder's words."""
        return {
            f'{MESSAGES}{topic}': f'{count} written{self.losses[topic].text()}'
            for topic, count in self._bag.message_counts.items()
        }


def _repeated(salvage: Salvage, number: int) -> Channel | None:
    entries = salvage.metadata.get(f'{CHANNEL_RECORD}{number}')
    if entries is None or 'topic' not in entries:
        return None
    return Channel(number, 0, entries['topic'], 'cdr', entries)


def _known(type_name: str) -> tuple[str, str]:
    """Definition and hash of a type, empty if it is not known."""
    try:
        return definition(type_name)
    except UnknownTypeError:
        return '', ''


def _number(path: Path) -> tuple[int, str]:
    """Order of the files of a bag: bag_10.mcap after bag_9.mcap."""
    number = path.stem.rsplit('_', 1)[-1]
    return (int(number) if number.isdecimal() else -1, path.name)


@contextmanager
def _mapped(path: Path) -> Iterator[Data]:
    with path.open('rb') as stream:
        if path.stat().st_size == 0:
            yield b''
        else:
            with mmap(stream.fileno(), 0, access=ACCESS_READ) as data:
                yield data
