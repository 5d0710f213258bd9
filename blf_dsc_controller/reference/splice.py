# SPDX-License-Identifier: Apache-2.0
"""From what the arm does on to a reference, without a jump and within limits.

The reference is mixed into what there was (see `core.reference`), from t0 on in the time T.  That
is the shortest that keeps the mixture within the limits, of those on a scale of 10 % steps, and
refined.  Since a mixture is not faster than its parts but for their distance over T, there is such
a T wherever both parts keep strictly within the limits and stay at a finite distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.reference.errors import ApproachError, Excess, ReferenceLimitError
from blf_dsc_controller.reference.limits import Limits, excess, looks
from blf_dsc_controller.reference.polynomials import hermite
from blf_dsc_controller.reference.terms import Term, pack

_SHORTEST = 0.02  # s
_STEP = 1.1
_REFINEMENTS = 5
_BRAKE = 3.0
"""Braking from v in the time h takes 1.5 v / h at its most: twice as long leaves half the limit."""


class Motion(NamedTuple):
    """A packed reference, and the time [s] from which on it is no mixture."""

    vector: np.ndarray
    settled: float


@dataclass(frozen=True)
class Rules:
    """What a motion has to keep: limits, and how long [s] the way to the reference may take."""

    limits: Limits
    longest: float


def stop(t0: float, q: np.ndarray, dq: np.ndarray, limits: Limits) -> Term:
    """Come to rest from a state: q (n,) [rad] and dq (n,) [rad/s] at t0 [s]."""
    h = max(_SHORTEST, float(np.max(_BRAKE * np.abs(dq) / limits.acceleration)))
    points = np.zeros((3, 2, q.size))
    points[0] = q, q + 0.5 * h * dq
    points[1, 0] = dq
    return hermite(np.array([t0, t0 + h]), points)


def splice(before: Sequence[Term], main: Term, t0: float, rules: Rules) -> Motion:
    """Reference that goes over from `before` to `main`, beginning at t0 [s].

    Raises:
        ReferenceLimitError: `main` alone goes past a limit, within the longest duration.
        ApproachError: no way that is short enough keeps the limits.
    """
    n = len(rules.limits.joints)
    alone = pack(n, [main])
    too_much = excess(alone, looks(t0, t0 + rules.longest), rules.limits)
    if too_much is not None:
        raise ReferenceLimitError(too_much)

    def attempt(duration: float) -> np.ndarray:
        return pack(n, [*before, main._replace(begin=t0, fade=duration)])

    def fault(duration: float) -> Excess | None:
        return excess(attempt(duration), looks(t0, t0 + duration), rules.limits)

    too_short, duration = 0.0, min(_SHORTEST, rules.longest)
    least = None
    while (too_much := fault(duration)) is not None:
        if least is None or too_much.ratio < least.ratio:
            least = too_much
        if duration >= rules.longest:
            raise ApproachError(least, rules.longest)
        too_short, duration = duration, min(duration * _STEP, rules.longest)
    for _ in range(_REFINEMENTS):
        middle = 0.5 * (too_short + duration)
        if fault(middle) is None:
            duration = middle
        else:
            too_short = middle
    return Motion(attempt(duration), t0 + duration)
