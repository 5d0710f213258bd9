# SPDX-License-Identifier: Apache-2.0
"""Distributions as a study file writes them, such as `uniform(0.4, 0.6)`.

A value is the inverse of the distribution function at a number u in [0, 1), so that a draw costs
exactly one random number whatever the distribution is.  The inverses are written out rather than
taken from scipy.stats: they are needed twenty times a run, and a call of `ppf` takes 0.1 ms.
"""

from __future__ import annotations

import math
import re
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
"""Distributions of a parameter of each kind."""

TAIL = 4.0
"""Deviations from the mean at which a normal distribution is cut off."""

_CALL = re.compile(r'\s*(\w+)\s*\((.*)\)\s*')
_NAMES = {Kind.DOUBLE: 'a number', Kind.INTEGER: 'an integer', Kind.STRING: 'a word'}
_NORMAL = NormalDist()


@dataclass(frozen=True)
class Distribution:
    """One distribution of values of one kind."""

    name: str
    arguments: tuple[Value, ...]

    def at(self, u: float) -> Value:
        """Value below which the fraction `u`, in [0, 1), of all draws lies."""
        if self.name == 'choice':
            return self.arguments[int(u * len(self.arguments))]
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
        """The lowest and the highest value, or all of a choice."""
        if self.name != 'normal':
            return self.arguments
        mean, deviation = cast('tuple[float, float]', self.arguments)
        return (mean - TAIL * deviation, mean + TAIL * deviation)

    def __str__(self) -> str:
        return f'{self.name}({", ".join(map(str, self.arguments))})'


def parse(text: object, kind: Kind) -> Distribution:
    """Read a distribution of values of a scalar kind; ValueError says what is expected."""
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
    if len(arguments) != 2:
        form = next(form for form in forms if form.startswith(f'{name}('))
        raise ValueError(f'got {text!r} with {len(arguments)} values, but {form} is expected')
    first, second = cast('tuple[float, float]', arguments)
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
