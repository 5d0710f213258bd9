# SPDX-License-Identifier: Apache-2.0
"""Distributions as a configuration writes them, such as `uniform(0.4, 0.6)`.

A value is the inverse of the distribution function at a number u in [0, 1), so that a draw costs
exactly one random number whatever the distribution is.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from statistics import NormalDist
from typing import cast

from blf_dsc_controller.configuration.schema import Kind

Value = float | int | str

FORMS = {
    Kind.DOUBLE: (
        'uniform(low, high)',
        'loguniform(low, high)',
        'normal(mean, deviation)',
        'choice(a, b, ...)',
    ),
    Kind.INTEGER: ('integers(low, high)', 'choice(a, b, ...)'),
    Kind.STRING: ('choice(a, b, ...)',),
}
"""What can be drawn for a parameter of each kind."""

TAIL = 4.0
"""Deviations from the mean at which a normal distribution is cut off."""

_CALL = re.compile(r'\s*(\w+)\s*\((.*)\)\s*')
_NAMES = {Kind.DOUBLE: 'a number', Kind.INTEGER: 'an integer', Kind.STRING: 'a word'}


@dataclass(frozen=True)
class Distribution:
    """One distribution of values of one kind."""

    name: str
    arguments: tuple[Value, ...]

    def at(self, u: float) -> Value:
        """Value below which the share `u`, in [0, 1), of all draws lies."""
        return _INVERSES[self.name](u, self.arguments)

    @property
    def extremes(self) -> tuple[Value, ...]:
        """The lowest and the highest value, or all of a choice."""
        if self.name != 'normal':
            return self.arguments
        mean, deviation = cast('tuple[float, float]', self.arguments)
        return (mean - TAIL * deviation, mean + TAIL * deviation)

    def __str__(self) -> str:
        return f'{self.name}({", ".join(map(str, self.arguments))})'


def parse(text: object, kind: Kind) -> Distribution:
    """Read a distribution of values of a scalar kind.

    Raises ValueError in words that say what was got and what is expected.
    """
    call = _CALL.fullmatch(text) if isinstance(text, str) else None
    forms = FORMS[kind]
    if call is None or call[1] not in (form.partition('(')[0] for form in forms):
        raise ValueError(f'got {text!r}, but one of these is expected: {", ".join(forms)}')
    name = call[1]
    try:
        arguments = tuple(_argument(word.strip(), kind) for word in call[2].split(','))
    except ValueError:
        raise ValueError(f'got {text!r}, but {_NAMES[kind]} is expected between commas') from None
    if name != 'choice' and len(arguments) != 2:
        form = next(form for form in forms if form.startswith(f'{name}('))
        raise ValueError(f'got {text!r} with {len(arguments)} values, but {form} is expected')
    _judge(text, name, arguments)
    return Distribution(name, arguments)


def _argument(word: str, kind: Kind) -> Value:
    if kind is Kind.DOUBLE:
        if not math.isfinite(float(word)):
            raise ValueError
        return float(word)
    if kind is Kind.INTEGER:
        return int(word)
    if not word:
        raise ValueError
    return word


def _judge(text: object, name: str, arguments: tuple[Value, ...]) -> None:
    if name == 'choice':
        return
    first, second = cast('tuple[float, float]', arguments)
    if name == 'normal':
        if second < 0.0:
            raise ValueError(f'got {text!r}, but a deviation cannot be below 0')
    elif first > second:
        raise ValueError(f'got {text!r}, but the first value must not be above the second')
    if name == 'loguniform' and first <= 0.0:
        raise ValueError(f'got {text!r}, but a loguniform distribution begins above 0')


def _uniform(u: float, arguments: tuple[Value, ...]) -> Value:
    low, high = cast('tuple[float, float]', arguments)
    return low + u * (high - low)


def _loguniform(u: float, arguments: tuple[Value, ...]) -> Value:
    low, high = cast('tuple[float, float]', arguments)
    return min(high, low * math.exp(u * math.log(high / low)))


def _normal(u: float, arguments: tuple[Value, ...]) -> Value:
    mean, deviation = cast('tuple[float, float]', arguments)
    standard = NormalDist()
    tail = standard.cdf(-TAIL)
    return mean + deviation * standard.inv_cdf(tail + u * (1.0 - 2.0 * tail))


def _integers(u: float, arguments: tuple[Value, ...]) -> Value:
    low, high = cast('tuple[int, int]', arguments)
    return low + min(int(u * (high - low + 1)), high - low)


def _choice(u: float, arguments: tuple[Value, ...]) -> Value:
    return arguments[int(u * len(arguments))]


_INVERSES: dict[str, Callable[[float, tuple[Value, ...]], Value]] = {
    'uniform': _uniform,
    'loguniform': _loguniform,
    'normal': _normal,
    'integers': _integers,
    'choice': _choice,
}
