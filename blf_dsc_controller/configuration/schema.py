# SPDX-License-Identifier: Apache-2.0
"""Configurations: frozen dataclasses of validated and described ROS parameters.

Each field is declared with `parameter`, or is itself such a dataclass: a group, whose
parameters have dotted names (`arm.l1`). The method `problems()` of a configuration, if
it has one, checks parameters against each other; its class method `defaults(given)`
returns the defaults that follow from the given parameters, `variant(given)` a class
with further parameters.
"""

from __future__ import annotations

import array
import dataclasses
import difflib
import functools
import json
import math
import operator
import typing
from collections.abc import (
    Callable,
    Collection,
    Iterable,
    Iterator,
    Mapping,
    Sequence,
)
from dataclasses import dataclass
from typing import Annotated, Any, TypeAlias, TypeVar

import yaml

from blf_dsc_controller.configuration.files import DECIMAL_POINT, parse_scalar
from blf_dsc_controller.errors import (
    ArgumentTypeError,
    BlfDscError,
    ConfigurationError,
    check_type,
)

Config = TypeVar('Config')
Value: TypeAlias = bool | int | float | str | tuple[float, ...] | tuple[str, ...]


_NAMES = {bool: 'bool', int: 'integer', float: 'double', str: 'string'}
_ARRAYS = (list, tuple, array.array)  # rclpy gives array.array
_LONGEST = 200  # characters of a value in a message


@dataclass(frozen=True)
class Parameter:
    """A parameter of a node: what it means and which values are valid.

    Ranges and choices apply to each entry of an array. `read_only` is the reason why
    the parameter cannot change while the node runs; empty: it can. An `omittable` array
    may be empty. `kept` converts a given value to the one that a configuration holds,
    or raises BlfDscError. `name` and what follows it are derived from the dataclass, as
    are the choices of a `Literal`: `length` names the parameters whose lengths multiply
    to the length of this array; a number is itself a length.
    """

    default: Value
    description: str
    unit: str = ''
    symbol: str = ''
    at_least: float | None = None
    above: float | None = None
    at_most: float | None = None
    below: float | None = None
    choices: tuple[str, ...] = ()
    omittable: bool = False
    read_only: str = ''
    kept: Callable[[Any], Any] = lambda given: given
    name: str = ''
    type: type = float
    is_array: bool = False
    length: tuple[str, ...] = ()

    @property
    def kind(self) -> str:
        """The type in words, such as `double array`."""
        return _NAMES[self.type] + (' array' if self.is_array else '')

    @property
    def ros_type(self) -> str:
        """The type as in `rclpy.parameter.Parameter.Type`, such as `DOUBLE_ARRAY`."""
        return self.kind.upper().replace(' ', '_')

    @property
    def allowed(self) -> str:
        """The valid range or choices, such as `above 0 and at most 1`; empty: any value."""
        if self.choices:
            return 'one of ' + ', '.join(self.choices)
        return ' and '.join(
            f'{words} {limit if isinstance(limit, int) else f"{limit:g}"}'
            for words, limit, _ in self._limits()
        )

    @property
    def constraints(self) -> str:
        """What is allowed, and the number of entries: `above 0; entries: joints`."""
        entries = f'entries: {" times ".join(self.length)}' if self.length else ''
        empty = 'may be empty' if self.omittable else ''
        return '; '.join(filter(None, (self.allowed, entries, empty)))

    def problems(self, given: Any) -> Iterator[str]:
        """Check a value.

        Each problem names the parameter, what it got, and what is expected.
        """
        if self.is_array and not isinstance(given, _ARRAYS):
            yield self._mistyped(given, self._as_list(given))
            return
        entries = list(given) if self.is_array else [given]
        if not all(_is(entry, self.type) for entry in entries):
            yield self._mistyped(given, self._of_type(entries))
            return
        if not (entries or self.omittable or self.length):
            yield f'{self.name}: got an empty list, but at least one entry is needed'
        yield from self._entry_problems(entries)

    def _mistyped(self, given: Any, remedy: str) -> str:
        """Return the problem of a value of another type."""
        article = 'an' if self.type is int and not self.is_array else 'a'
        shown = format_value(given)
        shown = f'{shown[:_LONGEST]} ...' if len(shown) > _LONGEST else shown
        return (
            f'{self.name}: got {shown}, but {article} {self.kind} is expected{remedy}'
        )

    def _as_list(self, given: Any) -> str:
        """Return the remedy for a single value in the place of a list."""
        default = self.default if isinstance(self.default, tuple) else ()
        example = (given,) if isinstance(given, self.type) else default[:1]
        unit = f' in {self.unit}' if self.unit and isinstance(given, str) else ''
        each = ', an entry for each' if self.length or not self.default else ''
        return f': write a list{unit}, like {format_value(example)}{each}'

    def _of_type(self, entries: Sequence[Any]) -> str:
        """Return the remedy for entries of another type, or nothing."""
        if self.is_array and any(isinstance(each, _ARRAYS) for each in entries):
            return ': write all entries as one list, row after row'
        has_text = any(isinstance(each, str) for each in entries)
        if self.type is str:
            return '' if has_text else ': write it in quotes'
        if has_text:
            return self._unquoted(entries)
        if self.type is float and all(_is(each, int | float) for each in entries):
            comma = f': {DECIMAL_POINT}' if _alternate(entries) else ''
            return f', with a decimal point{comma}'
        return ''

    def _entry_problems(self, entries: Sequence[Any]) -> Iterator[str]:
        """Yield what is wrong with values of the right type, each mistake once."""
        found: dict[str, list[int]] = {}
        for index, entry in enumerate(entries):
            if isinstance(entry, float) and not math.isfinite(entry):
                found.setdefault('a finite number is needed', []).append(index)
            elif not self._allows(entry):
                unit = f' {self.unit}' if self.unit and not self.choices else ''
                found.setdefault(f'it must be {self.allowed}{unit}', []).append(index)
        for expected, (first, *others) in found.items():
            place = (
                f' at entry {first + 1} of {format_value(entries)}'
                if self.is_array
                else ''
            )
            more = (
                f'; likewise entry {", ".join(str(i + 1) for i in others)}'
                if others
                else ''
            )
            yield f'{self.name}: got {format_value(entries[first])}{place}, but {expected}{more}'

    def _unquoted(self, entries: Sequence[Any]) -> str:
        """Return the remedy if quotes or a comma keep entries from this type, or empty."""
        given = [each for each in entries if isinstance(each, str)]
        if all(_is(parse_scalar(each), self.type) for each in given):
            return ': write it without quotes'
        with_points = [each.replace(',', '.', 1) for each in given]
        if all(_is(parse_scalar(each), self.type) for each in with_points):
            return f': write a decimal point, {", ".join(with_points)}'
        return ''

    def spelt(self, given: Any) -> Any:
        """Return a value as it was written.

        Of `on` and `off`, YAML makes true and false.
        """
        word = 'on' if given is True else 'off'
        return word if isinstance(given, bool) and word in self.choices else given

    def _allows(self, entry: Any) -> bool:
        within = all(compare(entry, limit) for _, limit, compare in self._limits())
        return within and (not self.choices or entry in self.choices)

    def _limits(self) -> Iterator[tuple[str, float, Callable[[Any, Any], bool]]]:
        for words, limit, compare in (
            ('at least', self.at_least, operator.ge),
            ('above', self.above, operator.gt),
            ('at most', self.at_most, operator.le),
            ('below', self.below, operator.lt),
        ):
            if limit is not None:
                yield words, limit, compare


def parameter(
    default: Value, description: str, unit: str = '', symbol: str = '', **options: Any
) -> Any:
    """Declare a field of a configuration; the arguments are those of `Parameter`.

    The length of an array is annotated: `Annotated[tuple[float, ...], 'joints']` has
    one entry for each entry of the parameter `joints`. A `Literal` annotation gives the
    choices.
    """
    declared = Parameter(default, description, unit, symbol, **options)
    return dataclasses.field(default=default, metadata={'parameter': declared})


positive = functools.partial(parameter, above=0.0)
non_negative = functools.partial(parameter, at_least=0.0)


def parameters(cls: Any) -> tuple[Parameter, ...]:
    """Return every parameter of a configuration, by dotted name.

    They are in the order of declaration.
    """
    return _parameters(cls)


@functools.cache
def _parameters(cls: Any) -> tuple[Parameter, ...]:
    return tuple(
        dataclasses.replace(
            each, name=f'{name}.{each.name}' if each is not param else name
        )
        for name, param in _fields(cls).items()
        for each in ([param] if isinstance(param, Parameter) else _parameters(param))
    )


def flatten(config: object) -> dict[str, Value]:
    """Return the values of a configuration by dotted name, as `build` takes them."""
    return {
        param.name: operator.attrgetter(param.name)(config)
        for param in parameters(type(config))
    }


def differences(before: object, after: object) -> dict[str, Value]:
    """Return the values of `after` that differ from `before`, by dotted name."""
    old = flatten(before)
    return {name: value for name, value in flatten(after).items() if value != old[name]}


def build(cls: type[Config], given: Mapping[str, Any], source: str = '') -> Config:
    """Make a configuration from values by dotted name; missing ones keep their defaults.

    Raises ConfigurationError with all problems: unknown names, types and ranges, and,
    if each value is valid by itself, lengths and conflicts between parameters.
    """
    try:
        cls = variant_of(cls, given)
    except BlfDscError as error:
        raise ConfigurationError([str(error)], source) from error
    known = {param.name: param for param in parameters(cls)}
    problems = list(unknown_names(given, known))
    valid, invalid = _checked(known, given)
    problems += invalid
    if invalid:
        raise ConfigurationError(problems, source)
    fitting = {
        name: value for name, value in valid.items() if _fits(known[name], value)
    }
    try:
        derived: Mapping[str, Value] = getattr(cls, 'defaults', lambda _: {})(fitting)
    except ConfigurationError as error:
        raise ConfigurationError([*problems, *error.problems], source) from error
    values = (
        {name: param.default for name, param in known.items()} | {**derived} | valid
    )
    lengths = [
        problem
        for param in known.values()
        for problem in length_problems(param, values)
    ]
    problems += lengths
    if not lengths:
        config: Config = _assemble(cls, values)
        problems += getattr(config, 'problems', list)()
        if not problems:
            return config
    raise ConfigurationError(problems, source)


def _checked(
    known: Mapping[str, Parameter], given: Mapping[str, Any]
) -> tuple[dict[str, Any], list[str]]:
    """Return those given values of known parameters that are valid, and what is wrong with others.

    Each value is checked by itself.
    """
    valid: dict[str, Any] = {}
    problems: list[str] = []
    for name, param in known.items():
        if name not in given:
            continue
        value = param.spelt(_plain(given[name]))
        found = list(param.problems(value))
        try:
            if not found:
                valid[name] = tuple(value) if param.is_array else param.kept(value)
        except BlfDscError as error:
            found = [f'{name}: {error}']
        problems += found
    return valid, problems


def variant_of(cls: type[Config], given: Mapping[str, Any]) -> type[Config]:
    """Return the configuration with those parameters that depend on the given ones.

    Its class method `variant(given)` chooses it; without one, there is only `cls`.
    """
    variant: Callable[[Mapping[str, Any]], type[Config]] | None
    variant = getattr(cls, 'variant', None)
    return variant(given) if variant else cls


def _plain(value: Any) -> Any:
    """Return a value without the types of numpy, which scripts compute with."""
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return value.tolist() if hasattr(value, 'tolist') else value


def change(config: Config, given: Mapping[str, object], source: str = '') -> Config:
    """Return a configuration with some parameters changed, validated as a whole.

    Raises ArgumentTypeError if it is none, as all of `load_loop`.
    """
    if not dataclasses.is_dataclass(config):
        raise ArgumentTypeError(
            f'config: got {type(config).__name__}, expected ControllerConfig or PlantConfig: give '
            'the .controller or .plant of load_loop'
        )
    check_type(
        'given', given, Mapping, "give parameters by name, such as {'law': 'paper'}"
    )
    return build(type(config), {**flatten(config), **given}, source)


def unknown_names(given: Iterable[str], known: Collection[str]) -> Iterator[str]:
    """Yield the problem of each name that is unknown."""
    for name in given:
        if name not in known:
            yield unknown(name, known)


_ELSEWHERE = {
    'kp': 'feedback.joint_stiffness',
    'kd': 'feedback.joint_damping',
    'end_effector': 'robot.tip',
    'ee_link': 'robot.tip',
    'tip_link': 'robot.tip',
    'base_link': 'robot.base',
    'urdf': 'robot.urdf',
    'robot_description': 'robot.urdf',
    'effort_limits': 'torque.limit',
    'update_rate': 'sample_time',
    'rate': 'sample_time',
}
"""What other packages call a parameter, by the last part of its name there."""


def unknown(name: str, known: Iterable[str]) -> str:
    """Return the problem for an unknown name, suggesting the closest known one."""
    known = [*known]
    last = name.rpartition('.')[2].lower()
    ours = _ELSEWHERE.get(last, last)
    if ours in known:
        return f'{name}: unknown parameter, did you mean {ours}?'
    of_group = [each for each in known if each.startswith(f'{name}.')]
    if of_group:
        return f'{name}: a group, no parameter: give those in it by name, such as {of_group[0]}'
    return f'{name}: unknown parameter{suggestion(name, known)}'


def format_value(value: object) -> str:
    """Return a value as YAML that ROS and YAML libraries read as the same type."""
    if isinstance(value, _ARRAYS):
        return '[' + ', '.join(map(format_value, value)) + ']'
    if isinstance(value, float):  # 1.0e-05, since 1e-05 is a string to many libraries
        return str(yaml.safe_dump(float(value)).split()[0])
    return json.dumps(value, ensure_ascii=False, default=str)


def suggestion(name: str, known: Iterable[str], cutoff: float = 0.6) -> str:
    """Return `, did you mean X?` with the known name most like this one, or ''."""
    close = difflib.get_close_matches(name, known, n=1, cutoff=cutoff)
    return f', did you mean {close[0]}?' if close else ''


@functools.cache
def _fields(cls: Any) -> dict[str, Any]:
    """Return, for each field, the declared parameter or the class of the group."""
    types = typing.get_type_hints(cls)
    annotated = typing.get_type_hints(cls, include_extras=True)
    found: dict[str, Any] = {}
    for field in dataclasses.fields(cls):
        hint = types[field.name]
        param = field.metadata.get('parameter')
        if param is None:
            found[field.name] = hint
            continue
        if typing.get_origin(hint) is typing.Literal:
            param = dataclasses.replace(param, choices=typing.get_args(hint))
            hint = str
        length = getattr(annotated[field.name], '__metadata__', ())
        is_array = typing.get_origin(hint) is tuple
        type_ = typing.get_args(hint)[0] if is_array else hint
        found[field.name] = dataclasses.replace(
            param, type=type_, is_array=is_array, length=length
        )
    return found


def _assemble(cls: Any, values: Mapping[str, Value], prefix: str = '') -> Any:
    content = {
        name: values[prefix + name]
        if isinstance(param, Parameter)
        else _assemble(param, values, f'{prefix}{name}.')
        for name, param in _fields(cls).items()
    }
    return cls(**content)


def _fits(param: Parameter, value: Any) -> bool:
    """Whether a value has its length, where that depends on no other parameter."""
    is_fixed = all(each.isdigit() for each in param.length)
    return not (is_fixed and any(length_problems(param, {param.name: value})))


def length_problems(param: Parameter, values: Mapping[str, Any]) -> Iterator[str]:
    """Yield why a list has another length than `values` by name ask for."""
    if not param.length:
        return
    counts = [
        int(name) if name.isdigit() else len(values[name]) for name in param.length
    ]
    length = len(values[param.name])
    needed = math.prod(counts)
    if length != needed and not (param.omittable and length == 0):
        factors = ' times '.join(
            name if name.isdigit() else f'{count} of {name}'
            for count, name in zip(counts, param.length, strict=True)
        )
        entries = 'entry is' if needed == 1 else 'entries are'
        yield f'{param.name}: got {length}, but {needed} {entries} needed ({factors})'


def _alternate(entries: Sequence[float]) -> bool:
    """Whether entries may be the parts of numbers with a decimal comma: 0, 35, 0, 35."""
    whole, parts = entries[::2], entries[1::2]
    if not len(whole) == len(parts) > 1:
        return False
    repeats = len({*whole}) == len({*parts}) == 1 and whole[0] != parts[0]
    return repeats or (not any(whole) and all(parts))


def _is(value: object, type_: Any) -> bool:
    return isinstance(value, type_) and (type_ is bool or not isinstance(value, bool))


PerJoint: TypeAlias = Annotated[tuple[float, ...], 'joints']
"""Array with one entry per joint."""

Vector: TypeAlias = Annotated[tuple[float, ...], '3']
