# SPDX-License-Identifier: Apache-2.0
"""What a bag says of its run beside the messages: by which version, and under which configuration.

The configuration is a ROS 2 parameter file of every node that took part, as an MCAP attachment; the
facts that one looks for first are also a metadata record, and custom data of metadata.yaml.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from mcap.reader import make_reader

from blf_dsc_controller import __version__
from blf_dsc_controller.bags.errors import NoConfigurationError, OtherVersionError
from blf_dsc_controller.bags.losses import NOTHING_MISSED
from blf_dsc_controller.bags.sources import open_bag
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import is_builtin
from blf_dsc_controller.configuration.ros_yaml import Section, parse
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.errors import ConfigurationError
from blf_dsc_controller.messages.topics import TOPICS

if TYPE_CHECKING:
    from collections.abc import Mapping

RECORD = 'blf_dsc_controller'
"""Name of the metadata record."""

ATTACHMENT = 'configuration.yaml'
MEDIA_TYPE = 'application/yaml'
VERSION = 'package_version'
MESSAGES = 'messages '
"""Start of the name of a fact that tells of a topic what was written and what was lost."""

_FACTS = {'law': 'law', 'model': 'model', 'seed': 'seed', 'mode': 'clock'}
_KEPT = frozenset(topic.leaf for topic in TOPICS if topic.offered.depth > 1)
_OF_CONTROLLER = frozenset(('law', 'model', 'barrier.bound', 'learning.window'))


@dataclass(frozen=True)
class Recorded:
    """A controller as the bag tells of it.

    Attributes:
        node: its full name.
        config: its configuration.
        known_at: when the recorder learned it [ns].
    """

    node: str
    config: ControllerConfig
    known_at: int


@dataclass(frozen=True)
class Context:
    """What a bag tells; nothing, if it was recorded by something else.

    Attributes:
        path: of the bag.
        configurations: when it was stored [ns] and the text of each parameter file, in turn; each
            holds the nodes known by then.
        facts: by name, such as `package_version`, `law`, `model`, `seed`, `clock`.
    """

    path: Path
    configurations: tuple[tuple[int, str], ...] = ()
    facts: Mapping[str, str] = field(default_factory=dict)

    @property
    def version(self) -> str:
        """Version of this package that recorded the bag, empty if it was another recorder."""
        return self.facts.get(VERSION, '')

    @property
    def configuration(self) -> str:
        """Text of a parameter file of all nodes, empty if there is none."""
        return self.configurations[-1][1] if self.configurations else ''

    def missed(self, topic: str) -> int:
        """Messages of a topic that the recorder knows it missed."""
        found = re.search(r'(\d+) missed', self.facts.get(f'{MESSAGES}{topic}', ''))
        return int(found[1]) if found else 0

    @property
    def losses(self) -> dict[str, str]:
        """What the recorder did not get of each topic, in its words, where there is anything.

        Of a topic that keeps its last message alone, earlier ones are not counted as lost.
        """
        told = {
            name.removeprefix(MESSAGES): text.partition(', ')[2]
            for name, text in self.facts.items()
            if name.startswith(MESSAGES) and name.rsplit('/', 1)[-1] in _KEPT
        }
        return {topic: text for topic, text in told.items() if text not in ('', NOTHING_MISSED)}

    def controller(self) -> Recorded:
        """Tell which controller ran, and how it was configured.

        Raises:
            UnreadableBagError: there is no bag, or it is damaged.
            NoConfigurationError: the bag does not tell.
            OtherVersionError: it tells of a configuration that this version cannot run.
        """
        damage = ''
        for stored, text in self.configurations:
            try:
                sections = parse(text)
            except ConfigurationError as error:
                damage = error.problems[0].partition('\n')[0]
                continue
            for section in sections:
                if section.entries.keys() >= _OF_CONTROLLER:
                    return Recorded(section.pattern, self._config(section), stored)
        with open_bag(self.path):  # if it is no bag, that is what is to be told
            raise NoConfigurationError(self.path, damage)

    def _config(self, section: Section) -> ControllerConfig:
        values = {
            name: entry.value for name, entry in section.entries.items() if not is_builtin(name)
        }
        try:
            return build(ControllerConfig, values, f'{self.path}, {ATTACHMENT}')
        except ConfigurationError as error:
            if self.version != __version__:
                raise OtherVersionError(self.path, self.version, __version__, error) from error
            raise


def facts_of(configuration: str) -> dict[str, str]:
    """Facts to look for first, of a configuration and of this version."""
    facts = {VERSION: __version__}
    try:
        sections = parse(configuration)
    except ConfigurationError:  # of a node with parameters that no file can hold
        return facts
    for section in sections:
        for name, fact in _FACTS.items():
            if name in section.entries:
                facts[fact] = str(section.entries[name].value)
    return facts


def read_context(path: Path) -> Context:
    """Read what the first MCAP file of a bag tells; a bag without any tells nothing.

    Args:
        path: folder of the bag, or one of its storage files.
    """
    files = sorted(path.glob('*.mcap')) if path.is_dir() else [path]
    if not files or files[0].suffix != '.mcap':
        return Context(path)
    try:
        with files[0].open('rb') as stream:
            reader = make_reader(stream)
            facts: dict[str, str] = {}
            for record in reader.iter_metadata():
                facts = record.metadata if record.name == RECORD else facts
            texts = tuple(
                (one.log_time, one.data.decode(errors='replace'))
                for one in reader.iter_attachments()
                if one.name == ATTACHMENT
            )
    except Exception:  # noqa: BLE001 - damage is told by who reads the messages
        return Context(path)
    return Context(path, texts, facts)
