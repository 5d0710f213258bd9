# SPDX-License-Identifier: Apache-2.0
"""Context of a recorded run besides its messages: version, configuration, lost messages.

The configuration is a ROS 2 parameter file of all nodes, stored as an MCAP attachment; the main
facts are also stored in a metadata record and in the custom data of metadata.yaml.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.records import Metadata

from blf_dsc_controller import __version__
from blf_dsc_controller.bags.folder import checked
from blf_dsc_controller.bags.mcap_index import context_records
from blf_dsc_controller.bags.mcap_reader import MalformedRecordError, mcap_files
from blf_dsc_controller.bags.sources import BagError, open_bag
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import is_builtin
from blf_dsc_controller.configuration.ros_yaml import parse
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.errors import ConfigurationError
from blf_dsc_controller.messages.topics import TOPICS

RECORD = 'blf_dsc_controller'
"""Name of the metadata record."""

ATTACHMENT = 'configuration.yaml'
VERSION = 'package_version'
MESSAGES = 'messages '
"""Prefix of the names of facts that count the written and lost messages of a topic."""

_NOTHING_MISSED = '0 missed'
_FACTS = {'law': 'law', 'model': 'model', 'seed': 'seed', 'mode': 'clock'}
_KEPT = frozenset(topic.leaf for topic in TOPICS if topic.offered.depth > 1)
_OF_CONTROLLER = frozenset(('law', 'model', 'barrier.bound', 'learning.window'))


class Losses:
    """Counter of one topic's published but unrecorded messages, by sequence number.

    Each publisher numbers its own messages: losses of a topic that ever had several are unknown.
    """

    def __init__(self, publishers: int) -> None:
        self.missed: int | None = 0  # between recorded ones; None if unknown
        self.before = 0  # sent by a publisher before its first recorded one
        self._last = 0
        self.publishers_seen(publishers)

    def publishers_seen(self, publishers: int) -> None:
        """Update the number of publishers."""
        if publishers > 1:
            self.missed, self.before = None, 0

    def count(self, sequence: int) -> None:
        """Count a message; a number that is not higher than the last means a new publisher."""
        if self.missed is not None:
            if self._last and sequence > self._last:
                self.missed += sequence - self._last - 1
            else:
                self.before += max(sequence - 1, 0)
        self._last = sequence

    def text(self) -> str:
        """Return the text that follows the number of recorded messages."""
        if self.missed is None:
            return ''
        earlier = f', {self.before} sent before the recorder connected' if self.before else ''
        return f', {self.missed} missed{earlier}'


def statistics(written: Mapping[str, int], losses: Mapping[str, Losses]) -> dict[str, str]:
    """Return facts that state how many messages of each topic were written and lost."""
    return {
        f'{MESSAGES}{topic}': f'{count} written{losses[topic].text()}'
        for topic, count in written.items()
    }


@dataclass(frozen=True)
class Context:
    """Recorded context of a run; empty if another recorder made the bag.

    Each configuration, a time of storage [ns] and the text of a parameter file, covers the nodes
    known by then. Facts are `package_version`, `law`, `model`, `seed`, `clock` and others.
    """

    path: Path
    configurations: tuple[tuple[int, str], ...] = ()
    facts: Mapping[str, str] = field(default_factory=dict)

    @property
    def version(self) -> str:
        """Version of this package that recorded the bag, empty for another recorder."""
        return self.facts.get(VERSION, '')

    @property
    def configuration(self) -> str:
        """Text of a parameter file of all nodes, empty if there is none."""
        return self.configurations[-1][1] if self.configurations else ''

    def missed(self, topic: str) -> int:
        """Return the number of messages of a topic that the recorder knows it missed."""
        found = re.search(r'(\d+) missed', self.facts.get(f'{MESSAGES}{topic}', ''))
        return int(found[1]) if found else 0

    @property
    def losses(self) -> dict[str, str]:
        """Recorder's notes on the messages it missed, by topic.

        Topics that keep only their last message are left out.
        """
        texts = {
            name.removeprefix(MESSAGES): text.partition(', ')[2]
            for name, text in self.facts.items()
            if name.startswith(MESSAGES) and name.rsplit('/', 1)[-1] in _KEPT
        }
        return {topic: text for topic, text in texts.items() if text not in ('', _NOTHING_MISSED)}

    def controller_config(self) -> ControllerConfig:
        """Return the configuration of the controller as first recorded.

        Raises:
            BagError: there is no bag, it is damaged, or it holds no configuration.
            ConfigurationError: this version of the package cannot run the configuration.
        """
        damage = ''
        for _, text in self.configurations:
            try:
                sections = parse(text)
            except ConfigurationError as error:
                damage = error.problems[0].partition('\n')[0]
                continue
            for section in sections:
                if section.entries.keys() >= _OF_CONTROLLER:
                    values = {
                        name: entry.value
                        for name, entry in section.entries.items()
                        if not is_builtin(name)
                    }
                    return self.build_config(values, ATTACHMENT)
        reason = (
            f'{self.path} holds a configuration that cannot be read ({damage})'
            if damage
            else f'{self.path} does not hold the configuration of a controller: it was recorded by '
            'something else, or without the controller'
        )
        with open_bag(self.path):  # raises if there is no bag
            raise BagError(f'{reason}; pass one, as in --config recommended')

    def build_config(self, values: Mapping[str, Any], place: str) -> ControllerConfig:
        """Build the controller's configuration from parameters recorded at this place of the bag.

        Raises:
            ConfigurationError: this version of the package cannot run the configuration.
        """
        source = f'{self.path}, {place}'
        if self.version != __version__:
            source += f' by version {self.version or "unknown"}, not {__version__}'
        return build(ControllerConfig, values, source)


def facts_of(configuration: str) -> dict[str, str]:
    """Return the version of the package and the main facts of a configuration."""
    facts = {VERSION: __version__}
    try:
        sections = parse(configuration)
    except ConfigurationError:  # a node has parameters that no file can hold
        return facts
    for section in sections:
        for name, fact in _FACTS.items():
            if name in section.entries:
                facts[fact] = str(section.entries[name].value)
    return facts


def read_context(path: Path) -> Context:
    """Read the context from all MCAP files of a bag (folder or file); empty without any.

    A split recording may hold its configuration in a later file only, and its losses in the last.
    Damaged files are skipped: reading the messages reports the damage.
    """
    facts: dict[str, str] = {}
    texts: dict[tuple[int, str], None] = {}
    for file in mcap_files(path):
        with suppress(MalformedRecordError, OSError):
            for one in context_records(*checked(path, [file])):
                if isinstance(one, Metadata):
                    facts.update(one.metadata if one.name == RECORD else {})
                elif one.name == ATTACHMENT:
                    texts[one.log_time, one.data.decode(errors='replace')] = None
    return Context(path, tuple(texts), facts)
