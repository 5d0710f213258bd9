# SPDX-License-Identifier: Apache-2.0
"""ROS 2 parameter files, read as rcl reads them, without ROS."""

from __future__ import annotations

import difflib
import math
import re
import sys
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast

import yaml

from blf_dsc_controller.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Iterator

_TRUE = ('Y', 'y', 'yes', 'Yes', 'YES', 'true', 'True', 'TRUE', 'on', 'On', 'ON')


_FALSE = ('N', 'n', 'no', 'No', 'NO', 'false', 'False', 'FALSE', 'off', 'Off', 'OFF')


_INTEGER = re.compile(r'[+-]?(?:0[xX](?P<hex>[0-9a-fA-F]+)|(?P<octal>0[0-7]*)|[1-9][0-9]*)')


_DECIMAL = re.compile(r'[+-]?(?P<digits>[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?')


_HEXADECIMAL = re.compile(
    r'[+-]?0[xX](?:[0-9a-fA-F]+\.?[0-9a-fA-F]*|\.[0-9a-fA-F]+)(?:[pP][+-]?[0-9]+)?'
)


_SPECIAL = re.compile(r'[+-]?(?:inf|infinity|nan)', re.IGNORECASE)


_DOTTED = re.compile(r'[+-]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)')


_LARGEST_INTEGER = 2**63 - 1


def parse_scalar(word: str) -> bool | int | float | str:
    """The value that ROS reads in a word written without quotes."""
    if word in _TRUE or word in _FALSE:
        return word in _TRUE
    integer = _integer(word)
    if integer is not None:
        return integer
    number = _double(word)
    return word if number is None else number


def _integer(word: str) -> int | None:
    match = _INTEGER.fullmatch(word)
    if match is None:
        return None
    base = 16 if match['hex'] else 8 if match['octal'] else 10
    value = int(word, base)
    return value if -_LARGEST_INTEGER - 1 <= value <= _LARGEST_INTEGER else None


def _double(word: str) -> float | None:
    if _SPECIAL.fullmatch(word) or _DOTTED.fullmatch(word):
        return float(word.replace('.', ''))
    if _HEXADECIMAL.fullmatch(word):
        return float.fromhex(word)
    match = _DECIMAL.fullmatch(word)
    if match is None:
        return None
    value = float(word)
    underflow = abs(value) < sys.float_info.min and match['digits'].strip('0.') != ''
    return None if math.isinf(value) or underflow else value


_PARAMETERS = 'ros__parameters'


_UNTAGGED = '?'


_PART = re.compile(r'\*|\*\*|[A-Za-z_][A-Za-z0-9_]*')


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

    Raises ConfigurationError, with the line, if the text is no YAML or no parameter file.
    """
    try:
        root = _Composer(text).get_single_node()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f'line {mark.line + 1}: ' if mark else ''
        raise ConfigurationError([f'{line}no valid YAML: {error.problem}']) from error
    except yaml.YAMLError as error:
        raise ConfigurationError([f'no valid YAML: {error}']) from error
    if root is None:
        raise _error(1, 'the file is empty: expected node names with ros__parameters')
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
            raise _error(_line(event), f'ROS does not support the reference *{event.anchor}')
        return super().compose_node(parent, index)


def _sections(node: yaml.Node, name: str) -> Iterator[Section]:
    if not isinstance(node, yaml.MappingNode):
        where = f'under {name}' if name else 'at the top'
        raise _error(_line(node), f'expected node names or {_PARAMETERS} {where}')
    keys = dict(_pairs(node))
    if _PARAMETERS in keys and len(keys) > 1:
        other = next(key for key in keys if key != _PARAMETERS)
        raise _error(_line(keys[other]), f'{other} cannot stand beside {_PARAMETERS} of {name}')
    for key, value in keys.items():
        if key == _PARAMETERS:
            yield _section(value, name)
        elif difflib.get_close_matches(key, [_PARAMETERS], cutoff=0.8):
            raise _error(_line(value), f'{key} should be {_PARAMETERS} (two underscores)')
        elif isinstance(value, yaml.MappingNode):
            yield from _sections(value, f'{name}/{key.removeprefix("/") if not name else key}')
        else:
            raise _error(_line(value), f'{key} has a value, but stands outside of {_PARAMETERS}')


def _section(node: yaml.Node, name: str) -> Section:
    if not all(_PART.fullmatch(part) for part in name.split('/')[1:]):
        raise _error(_line(node), f'{name or "nothing"} is not a name that a node can have')
    if not isinstance(node, yaml.MappingNode):
        raise _error(_line(node), f'{_PARAMETERS} of {name} holds no parameters')
    section = Section(name, _line(node))
    for key, entry in _entries(node, ''):
        if key in section.entries:
            first = section.entries[key].line
            raise _error(entry.line, f'{key} was given before, on line {first}')
        section.entries[key] = entry
    return section


def _entries(node: yaml.MappingNode, prefix: str) -> Iterator[tuple[str, Entry]]:
    for key, value in _pairs(node):
        if isinstance(value, yaml.MappingNode):
            if not value.value:
                raise _error(_line(value), f'{prefix}{key} holds no parameters')
            yield from _entries(value, f'{prefix}{key}.')
        elif isinstance(value, yaml.SequenceNode):
            yield prefix + key, Entry(_sequence(value, prefix + key), _line(value))
        else:
            yield prefix + key, Entry(_scalar(value, prefix + key), _line(value))


def _pairs(node: yaml.MappingNode) -> Iterator[tuple[str, yaml.Node]]:
    seen: dict[str, int] = {}
    for key, value in node.value:
        if not isinstance(key, yaml.ScalarNode) or not key.value:
            raise _error(_line(key), 'expected a name before the colon')
        if key.value in seen:
            raise _error(_line(key), f'{key.value} was given before, on line {seen[key.value]}')
        seen[key.value] = _line(key)
        yield key.value, value


def _sequence(node: yaml.SequenceNode, name: str) -> list[object]:
    values = [_scalar(entry, name) for entry in node.value]
    if len({type(value) for value in values}) > 1:
        raise _error(
            _line(node),
            f'{name} mixes types, which ROS does not read: write all entries alike (1.0, not 1)',
        )
    return values


def _scalar(node: yaml.Node, name: str) -> object:
    if not isinstance(node, yaml.ScalarNode):
        raise _error(_line(node), f'{name} holds a list in a list, which ROS does not read')
    if node.style in ('"', "'") or node.tag == 'tag:yaml.org,2002:str':
        return node.value
    if not node.value:
        raise _error(_line(node), f'{name} has no value')
    return parse_scalar(node.value)


def _line(mark: Any) -> int:
    return cast('int', mark.start_mark.line) + 1


def _error(line: int, what: str) -> ConfigurationError:
    return ConfigurationError([f'line {line}: {what}'])
