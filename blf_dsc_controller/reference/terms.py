# SPDX-License-Identifier: Apache-2.0
"""The reference qr(t): terms of which each takes over from the one before.

From its `begin` on, for the time `fade`, a term is mixed into what there was before it:

    qr(t) = (1 - s) before(t) + s term(t),    s = 10 x^3 - 15 x^4 + 6 x^5,   x = (t - begin) / fade

s is the minimum-jerk step: the sum leaves and arrives with continuous acceleration, whatever is
mixed, and a mixture of two motions is never faster than they are but for s' times their distance.
From begin + fade on the reference is the term, to the last bit.

    vector = [n, number of terms, term, term, ...],   term = [code, size, begin, fade, content]
"""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from blf_dsc_controller.compiled.jit import inner, kernel
from blf_dsc_controller.compiled.views import borrowed
from blf_dsc_controller.reference.sinusoids import sinusoids, sinusoids_content
from blf_dsc_controller.reference.spline import spline, spline_content

if TYPE_CHECKING:
    from collections.abc import Sequence

SINUSOIDS = 0
SPLINE = 1

_VECTOR_HEAD = 2
_HEAD = 4


class Term(NamedTuple):
    """One term of a reference: what it is, when it takes over [s], and in what time [s]."""

    code: int
    content: np.ndarray
    begin: float = -inf
    fade: float = 0.0

    @property
    def settled(self) -> float:
        """Time [s] from which on it is the reference."""
        return self.begin + self.fade


def sinusoids_term(
    offset: Sequence[float],
    amplitude: Sequence[float],
    frequency: Sequence[float],
    phase: Sequence[float],
) -> Term:
    """Sum of cosines; arguments as in `sinusoids_content`."""
    return Term(SINUSOIDS, sinusoids_content(offset, amplitude, frequency, phase))


def spline_term(knots: np.ndarray, coefficients: np.ndarray) -> Term:
    """Piecewise quintic; arguments as in `spline_content`."""
    return Term(SPLINE, spline_content(knots, coefficients))


def pack(n: int, terms: Sequence[Term]) -> np.ndarray:
    """Vector of a reference for n joints; `unpack` is the inverse."""
    packed = [
        np.array((term.code, _HEAD + term.content.size, term.begin, term.fade, *term.content))
        for term in terms
    ]
    return np.concatenate([np.array((n, len(terms)), dtype=np.float64), *packed])


def unpack(vector: np.ndarray) -> list[Term]:
    """Terms of a packed reference."""
    terms = []
    at = _VECTOR_HEAD
    for _ in range(int(vector[1])):
        size = int(vector[at + 1])
        content = vector[at + _HEAD : at + size].copy()
        terms.append(Term(int(vector[at]), content, float(vector[at + 2]), float(vector[at + 3])))
        at += size
    return terms


def sinusoids_vector(
    offset: Sequence[float],
    amplitude: Sequence[float],
    frequency: Sequence[float],
    phase: Sequence[float],
) -> np.ndarray:
    """Reference that is a sum of cosines; arguments as in `sinusoids_content`."""
    return pack(len(offset), [sinusoids_term(offset, amplitude, frequency, phase)])


@inner
def term_in_force(vector: np.ndarray, t: float) -> tuple[int, int]:
    """Entry at which the last term starts that has taken over wholly, and its number."""
    found = _VECTOR_HEAD
    number = 0
    at = _VECTOR_HEAD
    for k in range(int(vector[1])):
        if vector[at + 2] + vector[at + 3] <= t:
            found = at
            number = k
        at += int(vector[at + 1])
    return found, number


@inner
def term_at(vector: np.ndarray, at: int, n: int, i: int, t: float) -> tuple[float, float, float]:
    """Joint i of the term that starts at entry `at`: q, q', q'' at time t [s]."""
    if vector[at] == SPLINE:
        return spline(vector, at + _HEAD, n, i, t)
    return sinusoids(vector, at + _HEAD, n, i, t)


@inner
def evaluate(
    vector: np.ndarray, t: float, qr: np.ndarray, dqr: np.ndarray, ddqr: np.ndarray
) -> None:
    """Leave qr [rad], dqr [rad/s] and ddqr [rad/s^2] (n,) of time t [s] in the last arguments."""
    n = qr.size
    at, first = term_in_force(vector, t)
    for i in range(n):
        qr[i], dqr[i], ddqr[i] = term_at(vector, at, n, i, t)
    for _ in range(first + 1, int(vector[1])):
        at += int(vector[at + 1])
        begin = vector[at + 2]
        if begin > t:
            continue
        fade = vector[at + 3]
        x = (t - begin) / fade
        s = x * x * x * (10.0 - x * (15.0 - 6.0 * x))
        ds = 30.0 * (x * (1.0 - x)) ** 2 / fade
        dds = 60.0 * x * (1.0 - x) * (1.0 - 2.0 * x) / fade**2
        for i in range(n):
            p, v, a = term_at(vector, at, n, i, t)
            ahead = p - qr[i]
            faster = v - dqr[i]
            ddqr[i] += s * (a - ddqr[i]) + 2.0 * ds * faster + dds * ahead
            dqr[i] += s * faster + ds * ahead
            qr[i] += s * ahead


@kernel
def _sample(vector: np.ndarray, times: np.ndarray, out: np.ndarray) -> None:
    unshared = borrowed(vector)
    for k in range(times.size):
        evaluate(unshared, times[k], out[k, 0], out[k, 1], out[k, 2])


def sampled(vector: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Reference at many times at once.

    Args:
        vector: packed reference.
        times: (k,) [s].

    Returns:
        (k, 3, n): qr, dqr and ddqr at each time.
    """
    out = np.zeros((len(times), 3, int(vector[0])))
    _sample(vector, np.asarray(times, dtype=np.float64), out)
    return out
