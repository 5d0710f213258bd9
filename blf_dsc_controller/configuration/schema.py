# SPDX-License-Identifier: Apache-2.0
"""Configuration dataclasses as validated, described parameters."""

from __future__ import annotations

import array
import dataclasses
import difflib
import functools
import math
import typing
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from blf_dsc_controller.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

Value: TypeAlias = bool | int | float | str | tuple[float, ...] | tuple[str, ...]


class Kind(Enum):
    """The type of a parameter, in ROS's words."""

    BOOL = 'bool'
    INTEGER = 'integer'
    DOUBLE = 'double'
    STRING = 'string'
    DOUBLE_ARRAY = 'double array'
    STRING_ARRAY = 'string array'

    @property
    def is_array(self) -> bool:
        """Whether a value is a list."""
        return self in _ELEMENT

    @property
    def element(self) -> Kind:
        """The kind of one entry of an array; a scalar kind is its own element."""
        return _ELEMENT.get(self, self)


_ELEMENT = {Kind.DOUBLE_ARRAY: Kind.DOUBLE, Kind.STRING_ARRAY: Kind.STRING}


_PYTHON = {Kind.BOOL: bool, Kind.INTEGER: int, Kind.DOUBLE: float, Kind.STRING: str}


@dataclass(frozen=True)
class Rule:
    """What a parameter may hold, beside its type.

    `length` names the parameters whose lengths, multiplied, give the length of this array.
    `read_only` is the reason why the parameter is fixed once the node runs; empty: changeable.
    """

    description: str
    unit: str
    symbol: str
    at_least: float | None
    above: float | None
    at_most: float | None
    below: float | None
    choices: tuple[str, ...]
    length: tuple[str, ...]
    may_be_empty: bool
    read_only: str


def parameter(
    default: Value,
    description: str,
    *,
    unit: str = '',
    symbol: str = '',
    at_least: float | None = None,
    above: float | None = None,
    at_most: float | None = None,
    below: float | None = None,
    choices: tuple[str, ...] = (),
    length: tuple[str, ...] = (),
    may_be_empty: bool = False,
    read_only: str = '',
) -> Any:
    """Declare a field of a configuration dataclass; the arguments are those of `Rule`."""
    rule = Rule(
        description=description,
        unit=unit,
        symbol=symbol,
        at_least=at_least,
        above=above,
        at_most=at_most,
        below=below,
        choices=choices,
        length=length,
        may_be_empty=may_be_empty,
        read_only=read_only,
    )
    return dataclasses.field(default=default, metadata={'rule': rule})


@dataclass(frozen=True)
class Parameter:
    """One parameter of a node, under its full dotted name."""

    name: str
    kind: Kind
    default: Value
    rule: Rule

    def convert(self, given: object) -> Value:
        """Return `given` as this parameter holds it (lists become tuples).

        Raises ValueError with every complaint, a line each, in words that name the parameter.
        """
        complaints = list(self._type_complaints(given)) or list(self._value_complaints(given))
        if complaints:
            raise ValueError('\n'.join(f'{self.name}: {complaint}' for complaint in complaints))
        return tuple(_entries(given)) if self.kind.is_array else given  # type: ignore[return-value]

    @property
    def allowed(self) -> str:
        """The allowed values in words, empty where every value of the type will do."""
        rule = self.rule
        if rule.choices:
            return 'one of ' + ', '.join(rule.choices)
        limits = [
            f'{word} {limit:g}'
            for word, limit in (
                ('at least', rule.at_least),
                ('above', rule.above),
                ('at most', rule.at_most),
                ('below', rule.below),
            )
            if limit is not None
        ]
        return ' and '.join(limits)

    def _type_complaints(self, given: object) -> Iterator[str]:
        article = 'an' if self.kind is Kind.INTEGER else 'a'
        expected = f'{article} {self.kind.value} is expected'
        if not self.kind.is_array:
            if not _is(given, self.kind):
                yield f'got {_shown(given)}, but {expected}{_remedy([given], self.kind)}'
            return
        if not isinstance(given, (list, tuple, array.array)):
            yield f'got {_shown(given)}, but {expected}: write a list, like {_shown(self.default)}'
        elif not all(_is(entry, self.kind.element) for entry in given):
            yield f'got {_shown(given)}, but {expected}{_remedy(given, self.kind)}'

    def _value_complaints(self, given: object) -> Iterator[str]:
        entries = _entries(given) if self.kind.is_array else [given]
        if not entries and not self.rule.may_be_empty:
            yield 'got an empty list, but at least one entry is needed'
        for index, entry in enumerate(entries):
            place = f' at entry {index + 1} of {_shown(given)}' if self.kind.is_array else ''
            if isinstance(entry, float) and not math.isfinite(entry):
                yield f'got {_shown(entry)}{place}, but a finite number is needed'
            elif not self._allows(entry):
                yield f'got {_shown(entry)}{place}, but {self._demand()}'

    def _allows(self, entry: Any) -> bool:
        rule = self.rule
        if rule.choices and entry not in rule.choices:
            return False
        return (
            (rule.at_least is None or entry >= rule.at_least)
            and (rule.above is None or entry > rule.above)
            and (rule.at_most is None or entry <= rule.at_most)
            and (rule.below is None or entry < rule.below)
        )

    def _demand(self) -> str:
        unit = f' {self.rule.unit}' if self.rule.unit else ''
        return f'it must be {self.allowed}{"" if self.rule.choices else unit}'


def _is(value: object, kind: Kind) -> bool:
    return isinstance(value, _PYTHON[kind]) and (kind is Kind.BOOL or not isinstance(value, bool))


def _entries(given: object) -> list[Any]:
    return list(given) if isinstance(given, (list, tuple, array.array)) else []


def _shown(value: object) -> str:
    if isinstance(value, (list, tuple, array.array)):
        return '[' + ', '.join(_shown(entry) for entry in value) + ']'
    if isinstance(value, bool):
        return 'true' if value else 'false'
    return 'nothing' if value is None else repr(value)


def _remedy(entries: Any, kind: Kind) -> str:
    """Say how to write it, where that can be told: ROS takes no 1 for 1.0, nor the text '1.0'."""
    for entry in entries:
        if kind.element is Kind.DOUBLE and _is(entry, Kind.INTEGER):
            return f': write {float(entry)!r} instead of {entry}'
        if kind.element in (Kind.DOUBLE, Kind.INTEGER) and isinstance(entry, str):
            return ': write a number, without quotes'
        if kind.element is Kind.STRING and not isinstance(entry, str):
            return f": write '{entry}' in quotes"
    return ''


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
