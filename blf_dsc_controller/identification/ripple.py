# SPDX-License-Identifier: Apache-2.0
"""Torque ripple of gears and motors, in what model and friction leave of the torques.

A ripple with N periods per turn leaves a torque of the joint's own position,

    a sin(N q) + b cos(N q)                                                        [N m]

which `law/columns.py` compensates.  N is searched on a grid by least squares (the periodogram of
Lomb, Least-squares frequency analysis of unequally spaced data, 1976, over position instead of
time).  Both sides pass windows of 0.05 s: at a speed v, these leave a share G(N v) of it.

What is left is correlated.  So deviations are those of passes, which are motions in one
direction and err independently (Liang and Zeger, Longitudinal data analysis using
generalized linear models, 1986).  And a ripple must be the same in both directions, where
friction is not, and in both halves of the recording, and stand out of its neighbours.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.arms.serial_chain import SerialChain
from blf_dsc_controller.identification.recording import Flags, Indices
from blf_dsc_controller.identification.windows import STILL, Rows, shortened
from blf_dsc_controller.numerics.intervals import TWO_SIDED
from blf_dsc_controller.run import Floats

_SHORT = 0.05  # s, length of the windows
_SAMPLES = 6  # of a window, at least
_PER_HOP = 4  # windows, from one of the fit to the next; fewer in long recordings
_ENOUGH = 20_000  # windows
_LARGEST = 300.0  # N that is searched
_PERIODS = 2.5  # of a ripple in the range of the joint, at least
_GRID = 6000  # N that are tried, at most
_PER_LOBE = 4.0  # steps of N in a lobe, 2 pi / range, within which ripples look alike
_PASSES = 8  # least number
_ROWS = 4  # of a pass, at least
_LONGEST = 2.0  # s of a pass; a longer one is cut
_ROBUST = 2.5  # robust deviations, beyond which rows count less
_CHANCE = 1e-3  # of a false ripple, in all N of a joint
_LIKE = 0.5  # of a ripple, most that directions and halves may differ by
_ABOVE = 6.0  # times the median power of its neighbours, at least
_NEAR, _FAR = 1.5, 8.0  # lobes, from and to which there are neighbours
_MOST = 3  # ripples of a joint
_LISTED = 3
_FELT = 0.35  # of the rms torque that is left without it, least amplitude that is told
_ROUNDING = 2e-3  # of N, that makes no difference
_ALIKE = 0.5  # of a lobe, by which N of two joints may differ
_TWINS = 0.02  # of the range, by which passes of a motion that repeats differ at most
_TABLE = 4096  # frequencies
_AT_ONCE = 1_000_000  # numbers of a block
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
    # whether the motion repeats: then whatever errs alike in each pass looks like a ripple
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
    q = short.postures
    dq = short.columns['viscous']
    share = _Share(short.g, short.period)
    found = []
    for i in range(short.speed.size):
        passes = _Passes.of(short.time, dq[:, i], ~short.clipped[:, i])
        at = passes.rows
        found.append(_of_joint(passes, q[at, i], dq[at, i], left[at, i], share))
    return tuple(found)


def listed_cycles(ripples: Sequence[Ripples]) -> tuple[float, ...]:
    """Return the N of `learning.ripple_cycles`: of all joints, the few that disturb most."""
    candidates = []
    for own in ripples:
        whole = sum(each.amplitude**2 for each in own.found) + 2.0 * own.torque**2
        lobe = own.seen[0] / _PERIODS
        candidates += [
            _Candidate(each, each.amplitude**2 / whole, lobe) for each in own.found
        ]
    groups: list[list[_Candidate]] = []
    for each in sorted(candidates, key=lambda one: -one.worth):
        same = next((group for group in groups if _is_same(group[0], each)), [])
        if not same:
            groups.append(same)
        same.append(each)
    groups.sort(key=lambda group: -sum(each.worth for each in group))
    return tuple(map(_together, groups[:_LISTED]))


class _Candidate(NamedTuple):
    """A ripple that may be listed."""

    ripple: Ripple
    worth: float  # how much of what is left of its joint's torque it takes
    lobe: float  # of its joint


def _is_same(one: _Candidate, other: _Candidate) -> bool:
    """Return whether ripples of two joints may have the same N, or look alike in their motion."""
    a, b = one.ripple, other.ripple
    deviation = float(np.hypot(a.cycles_deviation, b.cycles_deviation))
    lobe = _ALIKE * max(one.lobe, other.lobe)
    return abs(a.cycles - b.cycles) < max(lobe, TWO_SIDED * deviation)


def _together(same: Sequence[_Candidate]) -> float:
    """Return the mean N of ripples, with no more digits than are known: 30.0 for 29.98 +- 0.03."""
    ripples = [each.ripple for each in same]
    weights = np.array([1.0 / (each.cycles_deviation**2 + _TINY) for each in ripples])
    mean = float(weights @ [each.cycles for each in ripples] / weights.sum())
    deviation = 1.0 / float(np.sqrt(weights.sum()))
    half = max(TWO_SIDED * deviation, _ROUNDING * mean)
    for digits in range(3):
        rounded = round(mean, digits)
        if abs(rounded - mean) < half:
            break
    return rounded


class _Share:
    """The share of a sine that passes a window, by its angular frequency."""

    def __init__(self, g: Floats, h: float) -> None:
        time = h * (np.arange(g.size) - 0.5 * (g.size - 1))
        self._frequency = np.linspace(0.0, np.pi / h, _TABLE)
        self._share = np.cos(np.multiply.outer(self._frequency, time)) @ g

    def __call__(self, frequency: Floats) -> Floats:
        """Return it for frequencies (...) [rad/s], as of the nearest in the table."""
        at = np.abs(frequency) / self._frequency[1] + 0.5
        return np.asarray(np.take(self._share, at.astype(np.intp), mode='clip'))

    @property
    def half(self) -> float:
        """Frequency of which half passes [rad/s]."""
        return float(self._frequency[np.argmax(self._share < 0.5)])


class _Passes(NamedTuple):
    """Rows in which a joint moves, by passes in one direction."""

    rows: Indices  # (K,)
    begins: Indices  # (G,) of passes, in `rows`
    is_forward: Flags  # (G,)
    time: Floats  # (G,) s

    @classmethod
    def of(cls, time: Floats, dq: Floats, is_sound: Flags) -> _Passes:
        """Return those at times (R,) with the speeds (R,)."""
        moves = np.flatnonzero(is_sound & (np.abs(dq) > STILL))
        if moves.size < 2:
            nothing = np.zeros(0, dtype=np.intp)
            return cls(nothing, nothing, nothing > 0, np.zeros(0))
        at = time[moves]
        step = np.diff(at)
        is_end = (np.diff(np.sign(dq[moves])) != 0) | (step > 1.5 * np.median(step))
        number = np.cumsum(np.append(0, is_end))
        part = np.floor((at - at[np.searchsorted(number, number)]) / _LONGEST)
        number = np.cumsum(np.append(0, is_end | (np.diff(part) != 0)))
        is_long = np.bincount(number) >= _ROWS
        rows = moves[is_long[number]]
        begins = np.unique(number[is_long[number]], return_index=True)[1]
        return cls(rows, begins, dq[rows[begins]] > 0.0, time[rows[begins]])

    def sums(self, values: Floats) -> Floats:
        """Return sums (..., G) of values (..., K) over each pass."""
        return np.add.reduceat(values, self.begins, axis=-1)

    def spread(self, values: Floats) -> Floats:
        """Return values (..., G) of passes at their rows (..., K)."""
        counts = np.diff(np.append(self.begins, self.rows.size))
        return np.repeat(values, counts, axis=-1)

    def repeat(self, q: Floats, travel: float) -> bool:
        """Return whether most passes have a twin: from and to the same q (K,), as long."""
        ends = np.append(self.begins[1:], self.rows.size) - 1
        rows = np.column_stack((q[self.begins], q[ends])) / (_TWINS * travel)
        length = ends - self.begins
        apart = np.abs(rows[:, None] - rows).max(axis=-1)
        longer = np.abs(np.subtract.outer(length, length)) > 1 + 0.1 * length
        is_twin = (apart < 1.0) & ~longer & ~np.eye(length.size, dtype=bool)
        return bool(is_twin.any(axis=1).mean() > 0.5)


class _Estimate(NamedTuple):
    """Least squares of what is left by a sine and a cosine, for k values of N."""

    A: Floats  # (k, G, 2, 2) products of the columns in each pass
    b: Floats  # (k, G, 2) and of them with what is left

    def of(self, passes: Flags | slice = slice(None)) -> Floats:
        """Return the coefficients (k, 2) by some passes."""
        A = self.A[:, passes].sum(axis=1) + _TINY * np.eye(2)
        return np.asarray(
            np.linalg.solve(A, self.b[:, passes].sum(axis=1)[..., None])[..., 0]
        )

    @property
    def power(self) -> Floats:
        """What they explain (k,)."""
        return np.asarray(np.sum(self.of() * self.b.sum(axis=1), axis=-1))

    def covariance(self) -> Floats:
        """Return the covariance (k, 2, 2) of the coefficients, by passes."""
        G = self.A.shape[1]
        score = self.b - np.einsum('kgab,kb->kga', self.A, self.of())
        B = np.einsum('kga,kgb->kab', score, score) * G / (G - 2.0)
        inverse = np.linalg.inv(self.A.sum(axis=1) + _TINY * np.eye(2))
        return np.asarray(inverse @ B @ inverse)


class _Joint(NamedTuple):
    """Rows (K,) of one joint."""

    passes: _Passes
    q: Floats  # from the middle of its range
    dq: Floats
    weight: Floats
    share: _Share
    travel: float  # from one end of its range to the other, rad
    seen: tuple[float, float]  # N that are searched, from, to

    @property
    def lobe(self) -> float:
        """The N within which ripples look alike."""
        return float(2.0 * np.pi / self.travel)

    @property
    def grid(self) -> Floats:
        """The N that are tried (k,)."""
        return np.arange(*self.seen, self.lobe / _PER_LOBE)

    @property
    def level(self) -> float:
        """The F statistic that noise exceeds at one N of the grid by `_CHANCE`."""
        from scipy.special import fdtri

        chance = _CHANCE / max(self.grid.size / _PER_LOBE, 1.0)
        return float(fdtri(2.0, self.passes.begins.size - 2.0, 1.0 - chance))

    def columns(self, cycles: Floats) -> Floats:
        """Return sine and cosine (k, 2, K) for some N (k,), without their mean of each pass."""
        angle = np.multiply.outer(cycles, self.q)
        passed = self.share(np.multiply.outer(cycles, self.dq))
        return self.centred(
            np.stack((passed * np.sin(angle), passed * np.cos(angle)), axis=1)
        )

    def centred(self, values: Floats) -> Floats:
        """Return values (..., K) without their weighted mean of each pass."""
        means = self.passes.sums(self.weight * values) / self.passes.sums(self.weight)
        return values - self.passes.spread(means)

    def estimate(self, cycles: Floats, left: Floats) -> _Estimate:
        """Return the estimate for some N (k,)."""
        A, b = [], []
        for part in np.array_split(cycles, 1 + cycles.size * left.size // _AT_ONCE):
            H = self.columns(part)
            weighted = self.weight * H
            A.append(self.passes.sums(weighted[:, :, None] * H[:, None]))
            b.append(self.passes.sums(weighted * left))
        of_passes = (np.moveaxis(np.concatenate(each), -1, 1) for each in (A, b))
        return _Estimate(*of_passes)

    def fitted(
        self, cycles: Sequence[float], left: Floats, but: int | None = None
    ) -> Floats:
        """Return what ripples with these N explain together, or all of them but one."""
        H = self.columns(np.array(cycles)).reshape(-1, left.size)
        weighted = self.weight * H
        c = np.linalg.lstsq(weighted @ H.T, weighted @ left, rcond=None)[0]
        if but is not None:
            c[2 * but : 2 * but + 2] = 0.0
        return np.asarray(c @ H)


def _joint_of(passes: _Passes, q: Floats, dq: Floats, share: _Share) -> _Joint | None:
    """Return a joint by its rows (K,), None if it moved too little to show any N."""
    forward = passes.is_forward.sum()
    if passes.begins.size < _PASSES or not 3 <= forward <= passes.begins.size - 3:
        return None
    low, high = np.percentile(q, (1.0, 99.0))
    lobe = 2.0 * np.pi / (high - low)
    first = _PERIODS * lobe
    fastest = share.half / float(np.median(np.abs(dq)))
    last = min(_LARGEST, fastest, first + _GRID * lobe / _PER_LOBE)
    if last < first + lobe:
        return None
    middle = 0.5 * (low + high)
    travel = high - low
    return _Joint(passes, q - middle, dq, np.ones(q.size), share, travel, (first, last))


def _of_joint(
    passes: _Passes, q: Floats, dq: Floats, left: Floats, share: _Share
) -> Ripples:
    """Return the ripples of a joint by its rows (K,)."""
    joint = _joint_of(passes, q, dq, share)
    if joint is None:
        return NOTHING
    joint, left = _robust(joint, left)
    cycles, rest, without = _all_cycles(joint, left)
    torque = float(np.sqrt(np.mean(rest**2)))
    found = [_ripple(joint, left, cycles, k) for k in range(len(cycles))]
    found.sort(key=lambda each: -each.amplitude)
    told = tuple(each for each in found if each.amplitude > _FELT * torque)
    # amplitudes (k,) that would be certain
    variance = 0.5 * np.trace(without.covariance(), axis1=1, axis2=2)
    least = float(np.median(np.sqrt(2.0 * variance * joint.level)))
    repeats = passes.repeat(q, joint.travel)
    return Ripples(told, joint.seen, max(least, _FELT * torque), torque, repeats)


def _robust(joint: _Joint, left: Floats) -> tuple[_Joint, Floats]:
    """Return the joint with less weight of rows far off, and what is left without its means."""
    left = joint.centred(left)
    spread = 1.4826 * float(np.median(np.abs(left))) + _TINY
    weight = np.minimum(1.0, _ROBUST * spread / (np.abs(left) + _TINY))
    joint = joint._replace(weight=weight)
    return joint, joint.centred(left)


def _all_cycles(joint: _Joint, left: Floats) -> tuple[list[float], Floats, _Estimate]:
    """Return the N of all ripples, what is left without these, and its estimate on the grid.

    The strongest is found first, and the next in what it leaves.
    """
    grid = joint.grid
    cycles: list[float] = []
    rest = left
    while True:
        estimate = joint.estimate(grid, rest)
        away = np.abs(np.subtract.outer(grid, cycles)).min(axis=1, initial=np.inf)
        is_new = away > _NEAR * joint.lobe
        certain = np.flatnonzero(_is_ripple(joint, estimate) & is_new)
        if not certain.size or len(cycles) == _MOST:
            return cycles, rest, estimate
        best = certain[np.argmax(estimate.power[certain])]
        cycles.append(_refined(joint, rest, float(grid[best])))
        rest = left - joint.fitted(cycles, left)


def _is_ripple(joint: _Joint, estimate: _Estimate) -> Flags:
    """Return at which N (k,) of the grid there is a ripple, like in all parts of the passes."""
    c = estimate.of()
    V = estimate.covariance() + _TINY * np.eye(2)
    F = 0.5 * np.einsum('ka,ka->k', c, np.linalg.solve(V, c[..., None])[..., 0])
    certain = joint.level < F
    amplitude = np.linalg.norm(c, axis=1)
    forward, time = joint.passes.is_forward, joint.passes.time
    first = time < np.median(time)
    for part in (forward, ~forward, first, ~first):
        certain &= np.linalg.norm(estimate.of(part) - c, axis=1) < _LIKE * amplitude
    power = estimate.power
    for k in np.flatnonzero(certain):
        away = np.abs(joint.grid - joint.grid[k]) / joint.lobe
        others = power[(away > _NEAR) & (away < _FAR)]
        certain[k] = others.size > 0 and power[k] > _ABOVE * np.median(others)
    return np.asarray(certain)


def _refined(joint: _Joint, left: Floats, cycles: float) -> float:
    """Return the N near one of the grid that explains most."""
    step = joint.lobe / _PER_LOBE
    for _ in range(3):
        near = cycles + step * np.linspace(-1.0, 1.0, 11)
        cycles = float(near[np.argmax(joint.estimate(near, left).power)])
        step *= 0.2
    return cycles


def _ripple(joint: _Joint, left: Floats, all_cycles: Sequence[float], k: int) -> Ripple:
    """Return ripple k of several, without what the others explain."""
    if len(all_cycles) > 1:
        left = left - joint.fitted(all_cycles, left, but=k)
    N = np.array([all_cycles[k]])
    (H,) = joint.columns(N)
    (c,) = joint.estimate(N, left).of()
    rest = left - c @ H
    sine, cosine = H
    slope = joint.centred(joint.q * (c @ (cosine, -sine)))  # d/dN of the ripple
    amplitude = float(np.hypot(*c))
    along = c / (amplitude + _TINY)
    return Ripple(
        all_cycles[k],
        float(np.sqrt(_covariance(joint, np.stack((*H, slope)), rest)[2, 2])),
        amplitude,
        float(np.sqrt(along @ _covariance(joint, H, rest) @ along)),
    )


def _covariance(joint: _Joint, H: Floats, rest: Floats) -> Floats:
    """Return the covariance (m, m) of coefficients of columns H (m, K) by passes."""
    inverse = np.linalg.inv((joint.weight * H) @ H.T)
    score = joint.passes.sums(joint.weight * H * rest)
    G = joint.passes.begins.size
    return np.asarray(inverse @ score @ score.T @ inverse * G / (G - len(H)))
