# SPDX-License-Identifier: Apache-2.0
"""Configuration dataclasses as flat lists of parameters, and flat mappings as configurations.

A configuration is a frozen dataclass whose fields are made by `parameter` or are themselves such
dataclasses; a nested one is a dotted group (`arm.l1`). Its method `problems()`, if it has one,
returns in words what is wrong between several parameters.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import math
import typing
from typing import TYPE_CHECKING, Any, TypeVar

from blf_dsc_controller.configuration.parameter import Kind, Parameter, Value
from blf_dsc_controller.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

Config = TypeVar('Config')

_KINDS = {
    bool: Kind.BOOL,
    int: Kind.INTEGER,
    float: Kind.DOUBLE,
    str: Kind.STRING,
    tuple[float, ...]: Kind.DOUBLE_ARRAY,
    tuple[str, ...]: Kind.STRING_ARRAY,
}


def parameters(cls: type[Any]) -> list[Parameter]:
    """Every parameter of the configuration `cls`, in the order written, under dotted names."""
    return list(_listed(cls))  # type: ignore[arg-type] # mypy takes no type to be hashable


def flatten(config: object) -> dict[str, Value]:
    """Return the values of a configuration under dotted names; `build` makes it whole again."""
    return {one.name: _value(config, one.name) for one in parameters(type(config))}


def build(cls: type[Config], given: Mapping[str, object], source: str = '') -> Config:
    """Make a configuration from dotted names; what is not given keeps its default.

    Raises ConfigurationError with all that is wrong: unknown names, types, lengths, ranges. What
    concerns several parameters (`problems()`) is judged once each value is right by itself.
    """
    known = {one.name: one for one in parameters(cls)}
    problems = [unknown(name, known) for name in given if name not in known]
    values: dict[str, Value] = {}
    for name, one in known.items():
        try:
            values[name] = one.convert(given[name]) if name in given else one.default
        except ValueError as error:
            problems += str(error).splitlines()
    lengths = [problem for one in known.values() for problem in _length_problems(one, values)]
    problems += lengths
    if len(values) == len(known) and not lengths:
        config = _assemble(cls, values, '')
        problems += getattr(config, 'problems', list)()
        if not problems:
            return config
    raise ConfigurationError(problems, source)


def change(config: Config, given: Mapping[str, object], source: str = '') -> Config:
    """Return a copy of a configuration with some parameters changed, validated as a whole."""
    return build(type(config), {**flatten(config), **given}, source)


def unknown(name: str, known: Iterable[str]) -> str:
    """Say that no parameter has this name, and which name is closest."""
    close = difflib.get_close_matches(name, known, n=1)
    if not close:
        close = [other for other in known if other.rsplit('.', 1)[-1] == name.rsplit('.', 1)[-1]]
    hint = f': did you mean {close[0]}?' if close else ''
    return f'{name}: there is no parameter of this name{hint}'


@functools.cache
def _listed(cls: type[Any]) -> tuple[Parameter, ...]:
    return tuple(_walk(cls, ''))


def _walk(cls: type[Any], prefix: str) -> Iterator[Parameter]:
    types = typing.get_type_hints(cls)
    for field in dataclasses.fields(cls):
        if 'rule' in field.metadata:
            kind = _KINDS[types[field.name]]
            default = typing.cast('Value', field.default)
            yield Parameter(prefix + field.name, kind, default, field.metadata['rule'])
        else:
            yield from _walk(types[field.name], f'{prefix}{field.name}.')


def _assemble(cls: type[Config], values: Mapping[str, Value], prefix: str) -> Config:
    types = typing.get_type_hints(cls)
    content = {
        field.name: values[prefix + field.name]
        if 'rule' in field.metadata
        else _assemble(types[field.name], values, f'{prefix}{field.name}.')
        for field in dataclasses.fields(cls)  # type: ignore[arg-type]
    }
    return cls(**content)


def _value(config: object, name: str) -> Value:
    for part in name.split('.'):
        config = getattr(config, part)
    return typing.cast('Value', config)


def _length_problems(one: Parameter, values: Mapping[str, Value]) -> Iterator[str]:
    if not one.rule.length or any(name not in values for name in (one.name, *one.rule.length)):
        return
    counts = [len(typing.cast('tuple[str, ...]', values[name])) for name in one.rule.length]
    length = len(typing.cast('tuple[float, ...]', values[one.name]))
    if length != math.prod(counts):
        of_each = ' times '.join(
            f'{count} of {name}' for count, name in zip(counts, one.rule.length, strict=True)
        )
        yield (
            f'{one.name}: got {length} {"entry" if length == 1 else "entries"}, '
            f'but {math.prod(counts)} are needed ({of_each})'
        )
