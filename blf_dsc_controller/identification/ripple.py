# SPDX-License-Identifier: Apache-2.0
"""Torque ripple of gears and motors, in what model and friction leave of the torques.

A ripple with N periods per turn leaves a torque of the joint's own position,

    a sin(N q) + b cos(N q)                                                        [N m]

which `law/columns.py` compensates.  N is searched on a grid by least squares (the periodogram of
Lomb, Least-squares frequency analysis of unequally spaced data, 1976, over position instead of
time).  Both sides pass windows of 0.05 s: at a speed v, these leave a share G(N v) of it.

What is left is correlated, and friction depends on the direction.  So a ripple must be about the
same in four parts of the motion, both directions in both halves of the recording, and stand out
of its neighbours.  Its deviation is that of the parts.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.arms.serial_chain import SerialChain
from blf_dsc_controller.identification.recording import Indices
from blf_dsc_controller.identification.selection import repeats
from blf_dsc_controller.identification.windows import STILL, Rows, shortened
from blf_dsc_controller.numerics.intervals import TWO_SIDED
from blf_dsc_controller.run import Floats

_SHORT = 0.05  # s, length of the windows
_SAMPLES = 6  # of a window, at least
_PER_HOP = 4  # windows, from one of the fit to the next; fewer in long recordings
_ENOUGH = 20_000  # windows
_LARGEST = 300.0  # N that is searched
_PERIODS = 2.5  # of a ripple in the range of the joint, at least
_GRID = 1500  # lobes that are searched, at most
_PER_LOBE = 4.0  # N that are tried in each
_ROWS = 30  # of each part, at least
_LIKE = 0.5  # of a ripple, most that a part of the motion may differ by
_ABOVE = 6.0  # times the median power of its neighbours, at least
_NEAR, _FAR = 1.5, 8.0  # lobes, from and to which there are neighbours
_MOST = 3  # ripples of a joint, and N that are listed
_FELT = 0.35  # of the rms torque that is left without it, least amplitude that is told
_TINY = 1e-12


class Ripple(NamedTuple):
    """A ripple of one joint."""

    cycles: float  # N, periods per turn; of a sliding joint rad/m
    cycles_deviation: float
    amplitude: float  # N m or N
    amplitude_deviation: float


class Ripples(NamedTuple):
    """What is found of one joint."""

    found: tuple[Ripple, ...]  # the strongest first
    # N that can be found; infinite and 0 if the joint moved too little for any
    seen: tuple[float, float]
    least: float  # amplitude that would have been found for most N, N m or N
    torque: float  # rms of what model and friction leave, N m or N
    # whether the motion repeats: then any error that repeats looks like a ripple
    repeats: bool = False

    @property
    def is_known(self) -> bool:
        """Whether the motion shows ripples."""
        return self.seen[0] < self.seen[1]


NOTHING = Ripples((), (np.inf, 0.0), np.inf, 0.0)
"""What is found of a joint that moved too little."""


def ripples_of(
    rows: Rows, windows: Indices, model: SerialChain, distances: Floats, theta: Floats
) -> tuple[Ripples, ...]:
    """Return the ripples of each joint in the torques that a fit leaves in some windows.

    `distances` (n,) are those of its contacts, and `theta` (m + 1,) its unknowns and delay.
    """
    length = max(_SHORT, _SAMPLES * rows.period)
    in_each = max(1, min(_PER_HOP, _ENOUGH // windows.size))
    short = shortened(rows, windows, model, distances, length, in_each)
    short = short.with_load(theta)
    left = short.u(theta[-1]) - short.torques(np.arange(short.time.size), theta)
    again = repeats(rows, windows)
    dq = short.columns['viscous']
    found = []
    for i in range(short.speed.size):
        moves = np.flatnonzero(~short.clipped[:, i] & (np.abs(dq[:, i]) > STILL))
        if moves.size < 2:
            found.append(NOTHING)
            continue
        joint = _Joint.of(short, moves, short.postures[moves, i], dq[moves, i])
        found.append(_of_joint(joint, left[moves, i]) if joint.is_enough else NOTHING)
    return tuple(each._replace(repeats=again) for each in found)


def listed_cycles(ripples: Sequence[Ripples]) -> tuple[float, ...]:
    """Return the N of `learning.ripple_cycles`: of all joints, the few that disturb most.

    Ripples of two joints that look alike in the motion of either are one: that of the first.
    """
    found = [
        ((each.amplitude / own.torque) ** 2, each, 0.5 * own.seen[0] / _PERIODS)
        for own in ripples
        for each in own.found
    ]
    listed: list[tuple[float, Ripple, float]] = []
    for worth, each, lobe in sorted(found, reverse=True):
        for k, (sum_of_worths, first, own) in enumerate(listed):
            if abs(first.cycles - each.cycles) < max(lobe, own):
                listed[k] = sum_of_worths + worth, first, own
                break
        else:
            listed.append((worth, each, lobe))
    return tuple(_rounded(first) for _, first, _ in sorted(listed)[-_MOST:][::-1])


def _rounded(ripple: Ripple) -> float:
    """Return N with no more digits than are known: 30.0 for 29.98 +- 0.03."""
    half = TWO_SIDED * ripple.cycles_deviation
    by_digits = (round(ripple.cycles, digits) for digits in range(2))
    return next(
        (each for each in by_digits if abs(each - ripple.cycles) < half),
        round(ripple.cycles, 2),
    )


class _Joint(NamedTuple):
    """The rows (K,) of one joint in which it moves."""

    q: Floats
    dq: Floats
    passes: Indices  # of each row: the pass in one direction that it belongs to, from 0
    parts: Indices  # of each row: direction and half of the recording, 0 to 3
    frequency: Floats  # rad/s, evenly spaced from 0
    share: Floats  # of a sine of these that passes a window
    travel: float  # from one end of its range to the other, rad

    @classmethod
    def of(cls, short: Rows, moves: Indices, q: Floats, dq: Floats) -> _Joint:
        """Return the joint with `q` and `dq` (K,) in the windows `moves`."""
        time = short.time[moves]
        step = np.diff(time)
        is_new = (np.diff(np.sign(dq)) != 0) | (step > 1.5 * np.median(step))
        passes = np.concatenate(([0], np.cumsum(is_new)))
        parts = 2 * (dq > 0.0) + (time > np.median(time))
        at = short.period * (np.arange(short.g.size) - 0.5 * (short.g.size - 1))
        frequency = np.linspace(0.0, np.pi / short.period, 4096)
        share = np.cos(np.multiply.outer(frequency, at)) @ short.g
        low, high = np.percentile(q, (1.0, 99.0))
        return cls(q, dq, passes, parts, frequency, share, float(high - low))

    @property
    def lobe(self) -> float:
        """The N within which ripples look alike."""
        return 2.0 * np.pi / self.travel

    @property
    def seen(self) -> tuple[float, float]:
        """The N that are searched, from, to."""
        first = _PERIODS * self.lobe
        half = float(
            self.frequency[np.argmax(self.share < 0.5)]
        )  # of which half passes
        fastest = half / float(np.median(np.abs(self.dq)))
        return first, min(_LARGEST, fastest, first + _GRID * self.lobe)

    @property
    def is_enough(self) -> bool:
        """Whether each part has rows enough, and the joint moves far enough."""
        first, last = self.seen
        return np.bincount(self.parts, minlength=4).min() >= _ROWS and (
            last >= first + self.lobe
        )

    def centred(self, values: Floats) -> Floats:
        """Return values (K,) without their mean of each pass."""
        mean = np.bincount(self.passes, values) / np.bincount(self.passes)
        return np.asarray(values - mean[self.passes])

    def columns(self, cycles: float) -> Floats:
        """Return sine and cosine (K, 2) of N, as they pass the windows."""
        angle = cycles * self.q
        nearest = np.abs(cycles * self.dq) / self.frequency[1] + 0.5
        passed = np.take(self.share, nearest.astype(np.intp), mode='clip')
        sine, cosine = passed * np.sin(angle), passed * np.cos(angle)
        return np.column_stack((self.centred(sine), self.centred(cosine)))

    def coefficients(self, cycles: float, left: Floats) -> tuple[Floats, Floats, float]:
        """Return (2,) by all rows and (4, 2) by each part, and the square that they explain."""
        columns = self.columns(cycles).T
        products = [
            [np.bincount(self.parts, one * other) for other in (*columns, left)]
            for one in columns
        ]
        sums = np.moveaxis(np.array(products), 2, 0)
        A, b = sums[:, :, :2] + _TINY * np.eye(2), sums[:, :, 2]
        c = np.asarray(np.linalg.solve(A.sum(axis=0), b.sum(axis=0)))
        parts = np.asarray(np.linalg.solve(A, b[:, :, None])[:, :, 0])
        return c, parts, float(c @ b.sum(axis=0))

    def without(self, cycles: Sequence[float], left: Floats) -> Floats:
        """Return what ripples with these N leave together."""
        if not cycles:
            return left
        H = np.hstack([self.columns(N) for N in cycles])
        return np.asarray(left - H @ np.linalg.lstsq(H, left, rcond=None)[0])


def _of_joint(joint: _Joint, left: Floats) -> Ripples:
    """Return the ripples of a joint by what is left (K,) of its torque.

    The strongest is found first, and the next in what it leaves.
    """
    left = joint.centred(left)
    grid = np.arange(*joint.seen, joint.lobe / _PER_LOBE)
    cycles: list[float] = []
    while True:
        rest = joint.without(cycles, left)
        c, parts, power = map(
            np.array, zip(*(joint.coefficients(N, rest) for N in grid), strict=True)
        )
        apart = np.linalg.norm(parts - c[:, None], axis=2)
        alike = (apart < _LIKE * np.linalg.norm(c, axis=1)[:, None]).all(axis=1)
        best = _highest(joint, grid, power, alike, cycles)
        if best is None or len(cycles) == _MOST:
            break
        cycles.append(_refined(joint, rest, best))
    torque = float(np.sqrt(np.mean(rest**2)))
    found = [_ripple(joint, left, cycles, N) for N in cycles]
    found.sort(key=lambda each: -each.amplitude)
    told = tuple(each for each in found if each.amplitude > _FELT * torque)
    least = max(float(np.median(apart.max(axis=1))) / _LIKE, _FELT * torque)
    return Ripples(told, joint.seen, least, torque)


def _highest(
    joint: _Joint, grid: Floats, power: Floats, alike: Floats, known: Sequence[float]
) -> float | None:
    """Return the N of the grid (k,) with the highest peak of `power` (k,) among those `alike` (k,).

    It stands out of its neighbours, and is none of the `known` ones.
    """
    for k in np.argsort(-np.where(alike, power, 0.0)):
        if not alike[k]:
            return None
        N = float(grid[k])
        away = np.abs(grid - N) / joint.lobe
        others = power[(away > _NEAR) & (away < _FAR)]
        is_new = all(abs(N - other) > _NEAR * joint.lobe for other in known)
        if is_new and others.size and power[k] > _ABOVE * np.median(others):
            return N
    return None


def _refined(joint: _Joint, left: Floats, cycles: float) -> float:
    """Return the N near one of the grid that explains most."""
    from scipy.optimize import minimize_scalar

    step = joint.lobe / _PER_LOBE
    found = minimize_scalar(
        lambda N: -joint.coefficients(N, left)[2],
        bounds=(cycles - step, cycles + step),
        method='bounded',
    )
    return float(found.x)


def _ripple(
    joint: _Joint, left: Floats, all_cycles: Sequence[float], cycles: float
) -> Ripple:
    """Return one ripple of several, in what the others leave.

    The deviation of N is the part of a lobe that the amplitude's is of the amplitude: twice that
    of the frequency of a sine in white noise.
    """
    others = [N for N in all_cycles if cycles != N]
    c, parts, _ = joint.coefficients(cycles, joint.without(others, left))
    amplitude = float(np.hypot(*c))
    count = len(parts)
    square = np.square(parts - c).sum() / (2 * (count - 1))  # of sine or cosine
    deviation = float(np.sqrt(square / count))
    return Ripple(cycles, joint.lobe * deviation / amplitude, amplitude, deviation)
