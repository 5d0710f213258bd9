# SPDX-License-Identifier: Apache-2.0
"""The reference qr(t): a list of terms, each of which takes over from the one before.

    sinusoids   qr_i = offset_i + sum_k amplitude_ik cos(frequency_k t + phase_k)
    spline      qr_i = sum_j c_kij (t - knot_k)^j, j = 0 .. 5, from knot k to knot k + 1

The last piece of a spline extends without end; before the first knot, the spline rests
at its initial position.  From its `begin` on, over the time `fade`, a term is blended
into the one before:

    qr(t) = (1 - s) before(t) + s term(t),    s = 10 x^3 - 15 x^4 + 6 x^5,   x = (t - begin) / fade

s is the minimum-jerk step, so the acceleration is continuous at both ends of the blend,
and the blend exceeds the speed of its parts by at most s' times their distance.  From
begin + fade on, the reference equals the term bit for bit.

    vector = [n, number of terms, term, term, ...],   term = [code, size, begin, fade, content]

Splines pass through given points, with given derivatives there or of minimum jerk.  The
quintic with given position, velocity and acceleration at both ends minimises the
integrated squared jerk between them (Flash and Hogan, 1985).  Through several points,
the optimum is the spline of such pieces whose jerk and snap are also continuous.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.compiled.jit import inner, kernel
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.compiled.views import part, view
from blf_dsc_controller.numerics.algebra import product
from blf_dsc_controller.numerics.elementary import cos, sin

SINUSOIDS = 0
SPLINE = 1

_VECTOR_HEAD = 2
_HEAD = 4


class Term(NamedTuple):
    """One term of a reference: kind, content, and the start and duration [s] of its blend."""

    code: int
    content: Array
    begin: float = -inf
    fade: float = 0.0

    @property
    def settled(self) -> float:
        """Time [s] from which on the term is the reference."""
        return self.begin + self.fade


def sinusoids_term(
    offset: Sequence[float],
    amplitude: Sequence[float],
    frequency: Sequence[float],
    phase: Sequence[float],
) -> Term:
    """Return a sum of cosines.

    `offset` (n,) and `amplitude` (n * tones,) in rad, all tones of the first joint
    first; `frequency` (tones,) in rad/s, `phase` (tones,) in rad.
    """
    content = (len(frequency), *offset, *frequency, *phase, *amplitude)
    return Term(SINUSOIDS, np.array(content, dtype=np.float64))


def spline_term(knots: Array, coefficients: Array) -> Term:
    """Return the spline of increasing knots (pieces,) [s] and c_kij (pieces, n, 6) [rad/s^j]."""
    content = ([float(len(knots))], knots, np.ravel(coefficients))
    return Term(SPLINE, np.concatenate(content))


def pieces_of(term: Term, n: int) -> tuple[Array, Array]:
    """Return knots (pieces,) [s] and coefficients (pieces, n, 6) of a spline."""
    count = int(term.content[0])
    knots, coefficients = np.split(term.content[1:], [count])
    return knots, coefficients.reshape(count, n, 6)


def turning_times(term: Term, n: int) -> Array:
    """Return the times [s] between which the acceleration of each joint of a spline is monotonic.

    They are its knots, the last times before them, since the acceleration of cubics
    jumps there, and the zeros of its jerk, 6 c3 + 24 c4 x + 60 c5 x^2.
    """
    knots, coefficients = pieces_of(term, n)
    duration = np.append(np.diff(knots), 0.0)[:, np.newaxis]
    constant, linear, square = np.moveaxis(coefficients[:, :, 3:], -1, 0)
    linear = 4.0 * linear
    square = 10.0 * square
    with np.errstate(all='ignore'):  # a jerk without zeros has none that are finite
        root = np.sqrt(linear * linear - 4.0 * square * constant)
        half = -0.5 * (linear + np.copysign(root, linear))
        zeros = np.stack((half / square, constant / half))
        inside = (zeros > 0.0) & (zeros < duration)
    at = (knots[:, np.newaxis] + zeros)[inside]
    return np.concatenate((knots, np.nextafter(knots, -inf), at))


def pack(n: int, terms: Sequence[Term]) -> Array:
    """Return the vector of a reference for n joints; `unpack` is the inverse.

    Raises ValueError without terms: there would be nothing to evaluate.
    """
    if not terms:
        raise ValueError('a reference needs at least one term')
    packed = [
        np.concatenate(
            (
                (term.code, _HEAD + term.content.size, term.begin, term.fade),
                term.content,
            )
        )
        for term in terms
    ]
    return np.concatenate([np.array((n, len(terms)), dtype=np.float64), *packed])


def unpack(vector: Array) -> list[Term]:
    """Return the terms of a packed reference."""
    terms = []
    at = _VECTOR_HEAD
    for _ in range(int(vector[1])):
        size = int(vector[at + 1])
        content = vector[at + _HEAD : at + size].copy()
        terms.append(
            Term(int(vector[at]), content, float(vector[at + 2]), float(vector[at + 3]))
        )
        at += size
    return terms


def remaining(vector: Array, t: float) -> Array:
    """Return a packed reference without the terms that have no effect from time t [s] on."""
    terms = unpack(vector)
    in_force = max((k for k, term in enumerate(terms) if term.settled <= t), default=0)
    return pack(int(vector[0]), terms[in_force:])


@inner
def sinusoids(
    vector: Array, at: int, n: int, i: int, t: float
) -> tuple[float, float, float]:
    """Return q, q', q'' at t [s] of joint i of n, of sinusoids with content from entry `at` on."""
    tones = int(vector[at])
    offset = part(vector, at + 1, (n,))
    frequency = part(vector, at + 1 + n, (tones,))
    phase = part(vector, at + 1 + n + tones, (tones,))
    amplitude = part(vector, at + 1 + n + 2 * tones, (n, tones))
    position = offset[i]
    velocity = 0.0
    acceleration = 0.0
    for k in range(tones):
        if amplitude[i, k] == 0.0:  # a tone of other joints
            continue
        angle = frequency[k] * t + phase[k]
        rate = frequency[k] * amplitude[i, k]
        position += amplitude[i, k] * cos(angle)
        velocity -= rate * sin(angle)
        acceleration -= rate * frequency[k] * cos(angle)
    return position, velocity, acceleration


@inner
def piece_at(knots: Array, t: float) -> int:
    """Return the last piece that has begun at time t; the first one before the first knot."""
    low = 0
    high = knots.size
    while high - low > 1:
        middle = (low + high) // 2
        if knots[middle] <= t:
            low = middle
        else:
            high = middle
    return low


@inner
def spline(
    vector: Array, at: int, n: int, i: int, t: float
) -> tuple[float, float, float]:
    """Return q, q', q'' at t [s] of joint i of n, of a spline with content from entry `at` on."""
    pieces = int(vector[at])
    knots = part(vector, at + 1, (pieces,))
    if t < knots[0]:
        return vector[at + 1 + pieces + 6 * i], 0.0, 0.0
    k = piece_at(knots, t)
    x = t - knots[k]
    c = part(vector, at + 1 + pieces + 6 * (k * n + i), (6,))
    position = c[5]
    velocity = 0.0
    curvature = 0.0
    for j in range(4, -1, -1):
        curvature = curvature * x + velocity
        velocity = velocity * x + position
        position = position * x + c[j]
    return position, velocity, 2.0 * curvature


@inner
def term_in_force(vector: Array, t: float) -> tuple[int, int]:
    """Return the first entry and the number of the last term that has taken over completely."""
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
def term_at(
    vector: Array, at: int, n: int, i: int, t: float
) -> tuple[float, float, float]:
    """Return q, q', q'' at time t [s] of joint i of n, of the term that starts at entry `at`."""
    if vector[at] == SPLINE:
        return spline(vector, at + _HEAD, n, i, t)
    return sinusoids(vector, at + _HEAD, n, i, t)


@inner
def evaluate(vector: Array, t: float, qr: Array, dqr: Array, ddqr: Array) -> None:
    """Write qr [rad], dqr [rad/s] and ddqr [rad/s^2] (n,) at time t [s]."""
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
def _sample(vector: Array, times: Array, out: Array) -> None:
    uncounted = view(vector)
    for k in range(times.size):
        evaluate(uncounted, times[k], out[k, 0], out[k, 1], out[k, 2])


def sampled(vector: Array, times: Array) -> Array:
    """Return qr, dqr and ddqr (k, 3, n) of a packed reference at times (k,) [s]."""
    out = np.zeros((len(times), 3, int(vector[0])))
    _sample(vector, np.asarray(times, dtype=np.float64), out)
    return out


def quintics(h: Array, begin: Array, end: Array) -> Array:
    """Return coefficients (pieces, n, 6) of quintics of durations h (pieces,) [s].

    `begin` and `end` are the positions, velocities and accelerations (3, pieces, n) at
    the ends.
    """
    h = np.asarray(h, dtype=np.float64)[:, np.newaxis]
    # not h**3: powers are rounded otherwise on other processors
    square, cube = h * h, h * h * h
    p, v, a = begin
    dp = end[0] - p - v * h - 0.5 * a * square
    dv = (end[1] - v - a * h) * h
    da = 0.5 * (end[2] - a) * square
    c3 = (10.0 * dp - 4.0 * dv + da) / cube
    c4 = (-15.0 * dp + 7.0 * dv - 2.0 * da) / (square * square)
    c5 = (6.0 * dp - 3.0 * dv + da) / (square * cube)
    return np.stack((p, v, 0.5 * a, c3, c4, c5), axis=-1)


def cubics(h: Array, begin: Array, end: Array) -> Array:
    """Return coefficients (pieces, n, 6) of cubics of durations h (pieces,) [s].

    `begin` and `end` are the positions and velocities (2, pieces, n) at the ends.
    """
    h = np.asarray(h, dtype=np.float64)[:, np.newaxis]
    mean = (end[0] - begin[0]) / h
    c2 = (3.0 * mean - 2.0 * begin[1] - end[1]) / h
    c3 = (begin[1] + end[1] - 2.0 * mean) / (h * h)
    zero = np.zeros_like(mean)
    return np.stack((begin[0], begin[1], c2, c3, zero, zero), axis=-1)


def ending_at_rest(knots: Array, coefficients: Array, position: Array) -> Term:
    """Return the spline of pieces between knots (k,) [s] that then stays at `position` (n,)."""
    rest = np.zeros((1, len(position), 6))
    rest[0, :, 0] = position
    return spline_term(knots, np.concatenate((coefficients, rest)))


def hermite(times: Array, points: Array) -> Term:
    """Return quintics through positions, velocities, accelerations (3, k, n) at times (k,) [s]."""
    pieces = quintics(np.diff(times), points[:, :-1], points[:, 1:])
    return ending_at_rest(times, pieces, points[0, -1])


def minimum_jerk(
    times: Array, positions: Array, start: Array | float = 0.0, end: Array | float = 0.0
) -> Term:
    """Return the minimum jerk through positions (k, n) [rad] at increasing times (k,) [s].

    `start` and `end` are velocity and acceleration (2, n) at the ends, by default at
    rest.
    """
    points = np.zeros((3, *positions.shape))
    points[0] = positions
    points[1:, 0] = start
    points[1:, -1] = end
    if len(times) > 2:
        _solve_inner_points(np.diff(times), points)
    return hermite(times, points)


def _solve_inner_points(h: Array, points: Array) -> None:
    """Fill in the velocities and accelerations that make jerk and snap continuous.

    This is a block tridiagonal system with two equations per inner point, solved by
    elimination.
    """
    rise = np.diff(points[0], axis=0)
    inner = range(1, len(h))
    upper, right = [np.zeros((2, 2))], [points[1:, 0]]
    for k in inner:
        l, r = 1.0 / h[k - 1], 1.0 / h[k]
        l2 = l * l
        r2 = r * r
        l3 = l * l * l
        r3 = r * r * r
        before = np.array([[-24.0 * l2, -3.0 * l], [-168.0 * l3, -24.0 * l2]])
        after = np.array([[24.0 * r2, -3.0 * r], [-168.0 * r3, 24.0 * r2]])
        here = np.array(
            [
                [36.0 * (r2 - l2), 9.0 * (l + r)],
                [-192.0 * (l3 + r3), 36.0 * (l2 - r2)],
            ]
        )
        jerk = 60.0 * (rise[k] * r3 - rise[k - 1] * l3)
        snap = -360.0 * (rise[k] * (r2 * r2) + rise[k - 1] * (l2 * l2))
        (a, b), (c, d) = here - product(before, upper[-1])
        solved = np.array([[d, -b], [-c, a]]) / (a * d - b * c)  # the inverse
        upper.append(product(solved, after))
        right.append(
            product(solved, np.stack((jerk, snap)) - product(before, right[-1]))
        )
    for k in reversed(inner):
        points[1:, k] = right[k] - product(upper[k], points[1:, k + 1])
