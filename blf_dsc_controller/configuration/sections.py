# SPDX-License-Identifier: Apache-2.0
"""The sections of a ROS 2 parameter file, and which of them speak to a node.

Read as rcl does: node names nest or are joined by `/`, `*` stands for one part of a name, `**` for
any number; of all sections that match a node the later one wins, whichever is more specific.
"""

from __future__ import annotations

import difflib
import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast

import yaml

from blf_dsc_controller.configuration.scalars import meaning

if TYPE_CHECKING:
    from collections.abc import Iterator

_PARAMETERS = 'ros__parameters'
_UNTAGGED = '?'
_PART = re.compile(r'\*|\*\*|[A-Za-z_][A-Za-z0-9_]*')


class SectionError(ValueError):
    """A parameter file that ROS could not read either, or not as meant; names the line."""

    def __init__(self, line: int, what: str) -> None:
        super().__init__(f'line {line}: {what}')


@dataclass(frozen=True)
class Entry:
    """A value and the line it was written on."""

    value: object
    line: int


@dataclass(frozen=True)
class Section:
    """The parameters under one `ros__parameters`, for all nodes that `pattern` matches."""

    pattern: str
    line: int
    entries: dict[str, Entry] = field(default_factory=dict)

    @property
    def is_wildcard(self) -> bool:
        """Whether the section may speak to nodes of several names."""
        return '*' in self.pattern.rsplit('/', 1)[-1]

    def matches(self, node: str) -> bool:
        """Whether the section speaks to the node of this fully qualified name."""
        expression = self.pattern.replace('/**', r'(?:/\w+)#').replace('/*', r'/\w+')
        return re.fullmatch(expression.replace('#', '*'), node) is not None


def parse(text: str) -> list[Section]:
    """Read the sections of a parameter file in the order they are written.

    Raises SectionError for what is no parameter file, and yaml.YAMLError for what is no YAML.
    """
    root = _Composer(text).get_single_node()
    if root is None:
        raise SectionError(1, 'the file is empty: expected node names with ros__parameters')
    return list(_sections(root, ''))


class _Composer(yaml.BaseLoader):
    """Keeps each word as written, and refuses the references that rcl refuses."""

    def resolve(self, kind: Any, value: Any, implicit: Any) -> str:
        """Give no type to what carries no tag: see `scalars`."""
        if kind is yaml.ScalarNode:
            return _UNTAGGED
        tag: str = super().resolve(kind, value, implicit)  # type: ignore[no-untyped-call]
        return tag

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Compose a node of the tree, which must not be a reference to another one."""
        if self.check_event(yaml.AliasEvent):
            event: Any = self.get_event()  # type: ignore[no-untyped-call]
            raise SectionError(_line(event), f'ROS does not support the reference *{event.anchor}')
        return super().compose_node(parent, index)


def _sections(node: yaml.Node, name: str) -> Iterator[Section]:
    if not isinstance(node, yaml.MappingNode):
        where = f'under {name}' if name else 'at the top'
        raise SectionError(_line(node), f'expected node names or {_PARAMETERS} {where}')
    keys = dict(_pairs(node))
    if _PARAMETERS in keys and len(keys) > 1:
        other = next(key for key in keys if key != _PARAMETERS)
        raise SectionError(
            _line(keys[other]), f'{other} cannot stand beside {_PARAMETERS} of {name}'
        )
    for key, value in keys.items():
        if key == _PARAMETERS:
            yield _section(value, name)
        elif difflib.get_close_matches(key, [_PARAMETERS], cutoff=0.8):
            raise SectionError(_line(value), f'{key} should be {_PARAMETERS} (two underscores)')
        elif isinstance(value, yaml.MappingNode):
            yield from _sections(value, f'{name}/{key.removeprefix("/") if not name else key}')
        else:
            raise SectionError(
                _line(value), f'{key} has a value, but stands outside of {_PARAMETERS}'
            )


def _section(node: yaml.Node, name: str) -> Section:
    if not all(_PART.fullmatch(part) for part in name.split('/')[1:]):
        raise SectionError(_line(node), f'{name or "nothing"} is not a name that a node can have')
    if not isinstance(node, yaml.MappingNode):
        raise SectionError(_line(node), f'{_PARAMETERS} of {name} holds no parameters')
    section = Section(name, _line(node))
    for key, entry in _entries(node, ''):
        if key in section.entries:
            first = section.entries[key].line
            raise SectionError(entry.line, f'{key} was given before, on line {first}')
        section.entries[key] = entry
    return section


def _entries(node: yaml.MappingNode, prefix: str) -> Iterator[tuple[str, Entry]]:
    for key, value in _pairs(node):
        if isinstance(value, yaml.MappingNode):
            if not value.value:
                raise SectionError(_line(value), f'{prefix}{key} holds no parameters')
            yield from _entries(value, f'{prefix}{key}.')
        elif isinstance(value, yaml.SequenceNode):
            yield prefix + key, Entry(_sequence(value, prefix + key), _line(value))
        else:
            yield prefix + key, Entry(_scalar(value, prefix + key), _line(value))


def _pairs(node: yaml.MappingNode) -> Iterator[tuple[str, yaml.Node]]:
    seen: dict[str, int] = {}
    for key, value in node.value:
        if not isinstance(key, yaml.ScalarNode) or not key.value:
            raise SectionError(_line(key), 'expected a name before the colon')
        if key.value in seen:
            raise SectionError(
                _line(key), f'{key.value} was given before, on line {seen[key.value]}'
            )
        seen[key.value] = _line(key)
        yield key.value, value


def _sequence(node: yaml.SequenceNode, name: str) -> list[object]:
    values = [_scalar(entry, name) for entry in node.value]
    if len({type(value) for value in values}) > 1:
        raise SectionError(
            _line(node),
            f'{name} mixes types, which ROS does not read: write all entries alike (1.0, not 1)',
        )
    return values


def _scalar(node: yaml.Node, name: str) -> object:
    if not isinstance(node, yaml.ScalarNode):
        raise SectionError(_line(node), f'{name} holds a list in a list, which ROS does not read')
    if node.style in ('"', "'") or node.tag == 'tag:yaml.org,2002:str':
        return node.value
    if not node.value:
        raise SectionError(_line(node), f'{name} has no value')
    return meaning(node.value)


def _line(mark: Any) -> int:
    return cast('int', mark.start_mark.line) + 1
