# SPDX-License-Identifier: Apache-2.0
"""Rules of what a configuration may be: rows, and the one place that goes through them.

Rows are beside what they check: here conflicts and implausible values, in `warnings` what needs
the gains of the law, in `supervision.retuning` what needs its state.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from enum import Enum, Flag, auto
from typing import Any, NamedTuple, TypeAlias

import numpy as np


class When(Flag):
    """When a rule is looked at."""

    LOAD = auto()  # when a configuration is built
    START = auto()  # before a law runs
    ROBOT = auto()  # before it moves a robot, and not a simulated arm
    LIVE = auto()  # before other gains of a running law, beside its loop
    NOW = auto()  # likewise, between two samples of the loop


class Severity(Enum):
    """What follows from a finding."""

    REFUSE = auto()
    WARN = auto()


class Excess(NamedTuple):
    """A limit, and how much of it is used: more than 1 is too much."""

    subject: str  # begins with a parameter
    use: float
    text: str  # goes on after the subject

    def __str__(self) -> str:
        return f'{self.subject} {self.text}'


Finding: TypeAlias = str | Excess
"""Sentence that begins with the parameter to change first, and says what to do."""


def _always(case: Any) -> bool:  # noqa: ARG001 - as other conditions
    return True


class Rule(NamedTuple):
    """A row: what is looked at when, and what follows.

    `find` takes what is known then: of a rule at `LOAD` the configuration, of others a case of
    their module.
    """

    parameter: str
    when: When
    severity: Severity
    find: Callable[[Any], Iterable[Finding]]
    applies: Callable[[Any], bool] = _always
    can_insist: bool = False  # by listing the parameter in `insist`


def findings(
    rules: Iterable[Rule],
    case: Any,
    when: When,
    severity: Severity,
    insist: Sequence[str] = (),
) -> Iterator[Finding]:
    """Yield what rules find that are looked at at one of these times."""
    for rule in rules:
        is_meant = rule.can_insist and rule.parameter in insist
        if is_meant or not rule.when & when or rule.severity is not severity:
            continue
        if rule.applies(case):
            # a limit of next to nothing is exceeded infinitely
            with np.errstate(over='ignore'):
                found = list(rule.find(case))
            yield from (
                each for each in found if isinstance(each, str) or each.use > 1.0
            )
