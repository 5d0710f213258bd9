# SPDX-License-Identifier: Apache-2.0
"""Distributions of parameters, as a file writes them: `uniform(0.4, 0.6)`.

A value is the inverse of the distribution function at a number u in [0, 1), so each
draw takes one random number.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

Drawn = float | int | str

_INVERSES: dict[str, Callable[..., Drawn]] = {
    'uniform(low, high)': lambda u, low, high: low + u * (high - low),
    'loguniform(low, high)': lambda u, low, high: min(
        high, low * math.exp(u * math.log(high / low))
    ),
    'maybe(probability, low, high)': lambda u, probability, low, high: (
        low + u / probability * (high - low) if u < probability else 0.0
    ),
    'integers(low, high)': lambda u, low, high: (
        low + min(int(u * (high - low + 1)), high - low)
    ),
    'choice(a, b, ...)': lambda u, *values: values[int(u * len(values))],
}
_UNIFORM, _LOGUNIFORM, _MAYBE, _INTEGERS, _CHOICE = _INVERSES
EXPECTED = {
    float: ('a number', (_UNIFORM, _LOGUNIFORM, _MAYBE, _CHOICE)),
    int: ('an integer', (_INTEGERS, _CHOICE)),
    str: ('a word', (_CHOICE,)),
}
"""What arguments are, and the distributions, for each kind of parameter."""

_CALL = re.compile(r'\s*(\w+)\s*\((.*)\)\s*')


@dataclass(frozen=True)
class Distribution:
    """A distribution of values of one kind."""

    written: str  # a key of _INVERSES
    arguments: tuple[Drawn, ...]

    def at(self, u: float) -> Drawn:
        """Return the value below which the fraction `u` of all draws lies."""
        return _INVERSES[self.written](u, *self.arguments)

    @property
    def extremes(self) -> tuple[Drawn, ...]:
        """Lowest and highest value, or all values of a choice."""
        return (0.0, *self.arguments[1:]) if self.written == _MAYBE else self.arguments

    def __str__(self) -> str:
        return (
            f'{self.written.partition("(")[0]}({", ".join(map(str, self.arguments))})'
        )


def parse(text: object, type_: type) -> Distribution:
    """Parse a distribution; raise ValueError naming what is expected."""
    call = _CALL.fullmatch(text) if isinstance(text, str) else None
    argument, known = EXPECTED[type_]
    written = next(
        (each for each in known if call and each.startswith(f'{call[1]}(')), None
    )
    if call is None or written is None:
        raise ValueError(
            f'got {text!r}, but one of these is expected: {", ".join(known)}'
        )
    try:
        arguments = tuple(type_(word.strip()) for word in call[2].split(','))
    except ValueError:
        raise ValueError(
            f'got {text!r}, but {argument} is expected between commas'
        ) from None
    if written != _CHOICE:
        if len(arguments) != written.count(',') + 1:
            raise ValueError(
                f'got {text!r} with {len(arguments)} values, but {written} is expected'
            )
        if problem := _problem(written, cast('tuple[float, ...]', arguments)):
            raise ValueError(f'got {text!r}, but {problem}')
    return Distribution(written, arguments)


def _problem(written: str, arguments: tuple[float, ...]) -> str:
    first, second = arguments[-2:]
    if written == _MAYBE and not 0.0 <= arguments[0] <= 1.0:
        return 'a probability is from 0 to 1'
    if not first <= second:
        return 'the first value must not be above the second'
    if written == _LOGUNIFORM and first <= 0.0:
        return 'a loguniform distribution begins above 0'
    return ''
