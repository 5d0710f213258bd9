# SPDX-License-Identifier: Apache-2.0
"""Plant parameters that vary from run to run, with distributions like `uniform(0.4, 0.6)`.

A value is the inverse of the distribution function at a number u in [0, 1), so each draw takes one
random number. The inverses are written out because `ppf` of scipy.stats takes 0.1 ms a call.

The start is relative to the reference: `initial.error` is the tracking error xi1(0) as a fraction
of the bound, `initial.velocity_error` is dq(0) - dqr(0). So may be the events: `events.gap` is the
time from the beginning of the event before, or from the start.
"""

from __future__ import annotations

import functools
import itertools
import math
import operator
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Annotated, cast

from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import (
    Kind,
    Parameter,
    parameter,
    parameters,
    unknown,
)

Value = float | int | str

FORMS = {
    Kind.DOUBLE: (
        'uniform(low, high)',
        'loguniform(low, high)',
        'normal(mean, deviation)',
        'maybe(probability, low, high)',
        'choice(a, b, ...)',
    ),
    Kind.INTEGER: ('integers(low, high)', 'choice(a, b, ...)'),
    Kind.STRING: ('choice(a, b, ...)',),
}
"""Distributions for each kind of parameter."""

TAIL = 4.0
"""Standard deviations from the mean at which a normal distribution is cut off."""

_CALL = re.compile(r'\s*(\w+)\s*\((.*)\)\s*')
_NAMES = {Kind.DOUBLE: 'a number', Kind.INTEGER: 'an integer', Kind.STRING: 'a word'}
_NORMAL = NormalDist()
_GROUPS = (
    'arm.',
    'truth.',
    'disturbance.',
    'sensor.',
    'actuator.',
    'load.',
    'wall.',
    'events.',
)
_REALTIME = ('actuator.command_timeout', 'actuator.without_command')


@dataclass(frozen=True)
class Distribution:
    """A distribution of values of one kind."""

    name: str
    arguments: tuple[Value, ...]

    def at(self, u: float) -> Value:
        """Return the value below which the fraction `u`, in [0, 1), of all draws lies."""
        if self.name == 'choice':
            return self.arguments[int(u * len(self.arguments))]
        if self.name == 'maybe':
            probability, low, high = cast('tuple[float, float, float]', self.arguments)
            return low + u / probability * (high - low) if u < probability else 0.0
        low, high = cast('tuple[float, float]', self.arguments)
        if self.name == 'uniform':
            return low + u * (high - low)
        if self.name == 'loguniform':
            return min(high, low * math.exp(u * math.log(high / low)))
        if self.name == 'integers':
            return low + min(int(u * (high - low + 1)), high - low)
        tail = _NORMAL.cdf(-TAIL)
        return low + high * _NORMAL.inv_cdf(tail + u * (1.0 - 2.0 * tail))

    @property
    def extremes(self) -> tuple[Value, ...]:
        """Lowest and highest value, or all values of a choice."""
        if self.name == 'maybe':
            return (0.0, *self.arguments[1:])
        if self.name != 'normal':
            return self.arguments
        mean, deviation = cast('tuple[float, float]', self.arguments)
        return (mean - TAIL * deviation, mean + TAIL * deviation)

    def __str__(self) -> str:
        return f'{self.name}({", ".join(map(str, self.arguments))})'


def parse(text: object, kind: Kind) -> Distribution:
    """Parse a distribution of a scalar kind; raises ValueError naming what is expected."""
    call = _CALL.fullmatch(text) if isinstance(text, str) else None
    forms = FORMS[kind]
    if call is None or call[1] not in (form.partition('(')[0] for form in forms):
        raise ValueError(f'got {text!r}, but one of these is expected: {", ".join(forms)}')
    name = call[1]
    try:
        arguments = tuple(_argument(word.strip(), kind) for word in call[2].split(','))
    except ValueError:
        raise ValueError(f'got {text!r}, but {_NAMES[kind]} is expected between commas') from None
    if name == 'choice':
        return Distribution(name, arguments)
    form = next(form for form in forms if form.startswith(f'{name}('))
    if len(arguments) != form.count(',') + 1:
        raise ValueError(f'got {text!r} with {len(arguments)} values, but {form} is expected')
    first, second = cast('tuple[float, float]', arguments[-2:])
    if name == 'maybe' and not 0.0 <= cast('float', arguments[0]) <= 1.0:
        raise ValueError(f'got {text!r}, but a probability is from 0 to 1')
    if name == 'normal' and second < 0.0:
        raise ValueError(f'got {text!r}, but a deviation cannot be below 0')
    if name != 'normal' and first > second:
        raise ValueError(f'got {text!r}, but the first value must not be above the second')
    if name == 'loguniform' and first <= 0.0:
        raise ValueError(f'got {text!r}, but a loguniform distribution begins above 0')
    return Distribution(name, arguments)


def _argument(word: str, kind: Kind) -> Value:
    if kind is Kind.INTEGER:
        return int(word)
    value = float(word) if kind is Kind.DOUBLE else word
    if value == '' or (isinstance(value, float) and not math.isfinite(value)):
        raise ValueError
    return value


@dataclass(frozen=True)
class RelativeStart:
    """Start of a run relative to the reference."""

    error: Annotated[tuple[float, ...], 'joints'] = parameter(
        (), 'fraction of the bound', above=-1.0, below=1.0
    )
    velocity_error: Annotated[tuple[float, ...], 'joints'] = parameter(
        (), 'velocity error', unit='rad/s'
    )


@dataclass(frozen=True)
class RelativeEvents:
    """Events of a run, one after the other."""

    gap: Annotated[tuple[float, ...], 'events.begin'] = parameter(
        (), 'time since the event before began', unit='s', at_least=0.0
    )


@dataclass(frozen=True)
class Variation:
    """One number drawn for each run."""

    name: str  # of the parameter
    entry: int  # index in the list; -1: not a list
    column: str  # name in the results
    distribution: Distribution


@functools.cache
def variable_parameters() -> Mapping[str, Parameter]:
    """Return every parameter that may vary, by name."""
    found = [one for one in parameters(PlantConfig) if one.name.startswith(_GROUPS)]
    for group, relative in (('initial', RelativeStart), ('events', RelativeEvents)):
        found += [replace(one, name=f'{group}.{one.name}') for one in parameters(relative)]
    return {
        one.name: one for one in found if one.name not in _REALTIME and one.kind.element in FORMS
    }


def entries(one: Parameter, plant: PlantConfig) -> tuple[str, ...]:
    """Return the names of the entries of a list parameter, by joint or number; else ()."""
    if not one.kind.is_array:
        return ()
    if not one.length:
        return _numbers(len(operator.attrgetter(one.name)(plant)))
    each: list[Sequence[str]] = []
    for name in one.length:
        if name == 'joints':
            each.append(plant.joints)
        else:
            count = int(name) if name.isdigit() else len(operator.attrgetter(name)(plant))
            each.append(_numbers(count))
    return tuple('.'.join(names) for names in itertools.product(*each))


def _numbers(count: int) -> tuple[str, ...]:
    return tuple(f'{number}' for number in range(1, count + 1))


def read_variations(
    given: Mapping[str, object], plant: PlantConfig
) -> tuple[tuple[Variation, ...], list[str]]:
    """Return the variations in the order of the plant's parameters, and their problems.

    Each name has a distribution; a list parameter also takes a list of them.
    """
    known = variable_parameters()
    problems = [unknown(name, known) for name in given if name not in known]
    found: list[Variation] = []
    for name, one in known.items():
        if name in given:
            try:
                found += _variations_of(one, given[name], entries(one, plant))
            except ValueError as error:
                problems.append(f'{name}: {error}')
    return tuple(found), problems


def _variations_of(one: Parameter, given: object, names: tuple[str, ...]) -> list[Variation]:
    if not one.kind.is_array:
        return [Variation(one.name, -1, f'plant.{one.name}', _distribution(one, given))]
    if not names:
        raise ValueError('got a distribution, but there are no events: give events.begin')
    each = list(given) if isinstance(given, (list, tuple)) else [given] * len(names)
    if len(each) == len({name.rpartition('.')[2] for name in names}):
        each *= len(names) // len(each)  # the same row for each event
    if len(each) != len(names):
        raise ValueError(
            f'got {len(each)} distributions, but there are {len(names)} entries '
            f'({", ".join(names)}): give one for each, or a single one for all'
        )
    return [
        Variation(one.name, i, f'plant.{one.name}.{name}', _distribution(one, text))
        for i, (name, text) in enumerate(zip(names, each, strict=True))
    ]


def _distribution(one: Parameter, text: object) -> Distribution:
    """Parse a distribution and check that the parameter allows all of its values."""
    scalar = replace(one, kind=one.kind.element)
    distribution = parse(text, scalar.kind)
    for value in distribution.extremes:
        for problem in scalar.problems(value):
            reason = problem.removeprefix(f'{one.name}: ')
            raise ValueError(f'{distribution} can give values that are not allowed: {reason}')
    return distribution
