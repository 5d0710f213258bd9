# SPDX-License-Identifier: Apache-2.0
"""Regression X theta = u of a recording over short windows.

Accelerations are not needed: with a smooth g that vanishes at both ends of a window,
d/dt(Yp P) + Yr P + friction = torque gives

    int (g Yr - g' Yp) dt P + int g friction dt = int g torque dt

exactly, by parts (modulating functions: Shinbrot, On the analysis of linear and
nonlinear systems, 1957).  Both sides pass the same low-pass filter; windows with gaps
are left out.

Velocities are not read, either: those of a driver lag behind its positions, usually by
an unknown time.  They are the slopes of cubics fitted to the positions around each
sample (Savitzky and Golay, Smoothing and differentiation of data, 1964).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from blf_dsc_controller.arms.friction import STRIBECK_SPEED, fadings, slidings
from blf_dsc_controller.arms.model import regressors_at
from blf_dsc_controller.arms.serial_chain import SerialChain
from blf_dsc_controller.bags.on_disk import BLOCK, Samples, blocks_of, mapped
from blf_dsc_controller.compiled.jit import kernel
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.identification.recording import (
    Flags,
    Indices,
    Recording,
    interpolated,
)
from blf_dsc_controller.identification.sliding import COULOMB_SPEED, sliding_direction
from blf_dsc_controller.identification.values import COUPLING, LOAD
from blf_dsc_controller.run import Floats

OfSamples = Callable[[slice], Floats]
"""Returns values (k, n) of some samples."""

WINDOW = 0.2
"""Length of a window [s]."""

HOP = WINDOW / 4
"""Time from one window to the next [s]."""

SMOOTHING = 0.03
"""Time over which positions are smoothed [s]."""

STILL = 0.02
"""Speed of a joint that does not move [rad/s or m/s]."""

COLUMNS = ('viscous', 'Coulomb', 'load', 'offset', 'Stribeck', 'quadratic')
"""Columns of each joint, after those of P."""

_GRAVITY = 0.01  # s between positions at which the torque of gravity is computed
# rad/s or m/s, below which stiction may hold a joint, whose rows then count less
_REST = 0.003
_HELD_BACK = 0.2  # fraction of the moving windows, at the end
_WINDOWS_OF_JOINT = 10  # least number


class Carried(NamedTuple):
    """When a load is carried [s]."""

    begin: float = -np.inf
    end: float = np.inf

    def at(self, time: Floats) -> Flags:
        """Return at which of the times [s] it is carried."""
        return (time >= self.begin) & (time < self.end)

    @property
    def when(self) -> str:
        """The times, in words."""
        if np.isinf(self.begin):
            return f'until {self.end:.1f} s'
        if np.isinf(self.end):
            return f'from {self.begin:.1f} s on'
        return f'from {self.begin:.1f} to {self.end:.1f} s'


_UNKNOWN = np.empty(0)


class Rows(NamedTuple):
    """R windows of n joints and m unknowns [P; COLUMNS of all joints; COUPLING; LOAD].

    The N samples are on disk, and so is what is large; `blocks` of windows come into
    memory.  Rows do not change: `with_sliding` and `with_load` return others, which share
    all columns but those of friction that they compute.
    """

    q: Samples  # (N, n) smoothed positions at all samples
    dq: Samples  # (N, n) their velocities
    torque: Samples | Floats  # (N, n) likewise
    period: float  # s
    gravity: Samples  # (N / every, n, p) regressor of the torque of gravity
    every: int  # samples between its positions
    speed: Floats  # (n,) 95th percentile of each joint's speed, rad/s or m/s
    load: Floats  # (p, 10) columns of P that are those of a load
    carried: Carried
    starts: Indices  # (R,) first sample of each window
    clipped: Flags  # (R, n) whether a torque in the window is clipped
    time: Floats = _UNKNOWN  # (R,) of their centres, s
    g: Floats = _UNKNOWN  # (L,) with sum 1
    slope: Floats = _UNKNOWN  # (L,) g' in 1/s, scaled likewise
    inertial: Samples | Floats = _UNKNOWN  # (R, n, p) columns of P
    # (R, n) by name, one for each of COLUMNS: of each joint, zero for the others
    columns: Mapping[str, Floats] = {}
    coupling: Floats = _UNKNOWN  # (R, 2, 3) columns of COUPLING for the last two joints
    sliding: Samples | Floats = _UNKNOWN  # (N, n) s
    weight: Floats = _UNKNOWN  # (R, n) of each row, at most 1
    speeds: Floats = _UNKNOWN  # (R, n) mean speed in each window, rad/s or m/s

    @property
    def p(self) -> int:
        """Number of base parameters."""
        return int(self.load.shape[0])

    @property
    def unknowns(self) -> int:
        """Number m."""
        return self.p + len(COLUMNS) * self.speed.size + COUPLING + LOAD

    def blocks(self, windows: Indices) -> Iterator[slice]:
        """Yield slices of windows (k,), which increase, one after the other."""
        of_samples = np.arange(0, len(self.q) + BLOCK, BLOCK)
        edges = np.searchsorted(self.starts[windows], of_samples).tolist()
        return (slice(*pair) for pair in pairwise(edges) if pair[0] < pair[1])

    def matrix(self, windows: Indices) -> Floats:
        """Return X (k, n, m) of some windows, which increase."""
        n = self.speed.size
        p = self.p
        X = np.zeros((windows.size, n, self.unknowns))
        inertial = self.inertial[windows]
        X[:, :, :p] = inertial
        at = X.shape[2] - LOAD - COUPLING
        X[:, :, p:at] = of_each_joint(self.friction(windows))
        X[:, -2:, at : at + COUPLING] = self.coupling[windows]
        with_load = self.carried.at(self.time[windows])
        X[with_load, :, -LOAD:] = inertial[with_load] @ self.load
        return X

    def friction(self, windows: Indices, names: Sequence[str] = COLUMNS) -> Floats:
        """Return columns of friction (k, c, n) of some windows: of the c names."""
        return np.stack([self.columns[name][windows] for name in names], axis=1)

    def rms(self, values: Floats, windows: Indices) -> Floats:
        """Return the root mean square (..., n) of values (..., k, n) that are not clipped."""
        kept = ~self.clipped[windows]
        counted = np.maximum(kept.sum(axis=0), 1)
        squares = np.sum(values**2 * kept, axis=-2)
        return np.asarray(np.sqrt(squares / counted))

    def torques(self, windows: Indices, theta: Floats) -> Floats:
        """Return X theta (k, n) of some windows, which increase, by the first m of `theta`."""
        found = np.zeros((windows.size, self.speed.size))
        for block in self.blocks(windows):
            found[block] = self.matrix(windows[block]) @ theta[: self.unknowns]
        return found

    @property
    def largest_torque(self) -> Floats:
        """Largest torque of each joint (n,) [N m or N]."""
        return np.asarray(np.abs(self.torque[:]).max(axis=0))

    def with_torque(self, torque: OfSamples) -> Rows:
        """Return the rows with other torques."""
        return self._replace(torque=mapped(len(self.q), torque))

    def gravity_torque(self, P: Floats, samples: slice) -> Floats:
        """Return the torque of gravity (k, n) of the base parameters P (p,) at some samples."""
        first = samples.start // self.every
        knots = self.gravity[first : (samples.stop - 1) // self.every + 2]
        torque = knots @ P
        at = np.arange(samples.start, samples.stop) / self.every - first
        return interpolated(at, np.arange(len(torque)), torque)

    def with_load(self, theta: Floats) -> Rows:
        """Return the rows with load friction for the gravity of unknowns (m,), or of P (p,)."""

        def load(rows: slice) -> Floats:
            torque = self.gravity_torque(theta[: self.p], rows)
            return np.abs(torque) * self.sliding[rows]

        columns = {**self.columns, 'load': self.over_windows(load)}
        return self._replace(columns=columns)

    def with_sliding(self, distances: Floats) -> Rows:
        """Return the rows with friction for the distances x_s (n,) of `sliding`.

        They have no load friction: `with_load` adds it.
        """
        sliding = Samples(self._sliding(distances))
        slid = self._replace(sliding=sliding)
        columns = {
            **self.columns,
            'Coulomb': slid.over_windows(lambda rows: sliding[rows]),
            'Stribeck': slid.stribeck(STRIBECK_SPEED, 2.0),
            'load': np.zeros((self.starts.size, self.speed.size)),
        }
        return slid._replace(columns=columns)

    def _sliding(self, distances: Floats) -> Iterator[Floats]:
        """Yield blocks of `sliding`."""
        last: Floats | None = None
        for rows in blocks_of(len(self.q)):
            before = slice(max(rows.start - 1, 0), rows.stop)
            s = sliding_direction(self.q[before], self.dq[before], distances, last)
            yield s[rows.start - before.start :]
            last = s[-1]

    def stribeck(self, speed: float, exponent: float) -> Floats:
        """Return the column (R, n) of the Stribeck friction, s exp(-|v / speed|^exponent).

        That is the shape of `arms.friction`, at |v / speed|^(exponent / 2).
        """

        def fading(rows: slice) -> Floats:
            over = np.abs(self.dq[rows] / speed) ** (0.5 * exponent)
            return self.sliding[rows] * fadings(over, 1.0)

        return self.over_windows(fading)

    def sliding_at_once(self) -> Floats:
        """Return the Coulomb column (R, n) of contacts that do not yield: that of a URDF."""
        return self.over_windows(lambda at: slidings(self.dq[at], COULOMB_SPEED))

    def u(self, delay: float) -> Floats:
        """Return the right-hand side (R, n) of torques recorded `delay` [s] late."""
        return self.over_windows(self._shifted(delay))

    def u_and_rate(self, delay: float) -> tuple[Floats, Floats]:
        """Return `u` and its time derivative (R, n)."""
        u, falling = self._sums(self._shifted(delay), self.g, self.slope)
        return u, -falling

    def _shifted(self, delay: float) -> OfSamples:
        shift = delay / self.period
        last = len(self.q) - 1

        def shifted(rows: slice) -> Floats:
            at = np.arange(rows.start, rows.stop) + shift
            first = int(np.clip(np.floor(at[0]), 0, last))
            until = int(np.clip(np.floor(at[-1]), 0, last)) + 2
            torque = self.torque[first:until]
            return interpolated(at - first, np.arange(len(torque)), torque)

        return shifted

    @property
    def postures(self) -> Floats:
        """Positions (R, n) of the windows."""
        return self.over_windows(lambda at: self.q[at])

    def over_windows(self, values: OfSamples, factors: Floats | None = None) -> Floats:
        """Return the sums (R, n) of the values in each window times factors (L,), by default g."""
        (found,) = self._sums(values, self.g if factors is None else factors)
        return found

    def _sums(self, values: OfSamples, *factors: Floats) -> list[Floats]:
        """Return `over_windows` for each of several factors."""
        columns = values(slice(0, 1)).shape[1]
        found = [np.zeros((self.starts.size, columns)) for _ in factors]
        for block, samples in self.in_blocks():
            all_windows = sliding_window_view(values(samples), self.g.size, axis=0)
            windows = all_windows[self.starts[block] - samples.start]
            for sums, own in zip(found, factors, strict=True):
                sums[block] = windows @ own
        return found

    def in_blocks(self) -> Iterator[tuple[slice, slice]]:
        """Yield slices of windows and of their samples."""
        for block in self.blocks(np.arange(self.starts.size)):
            starts = self.starts[block]
            yield block, slice(int(starts[0]), int(starts[-1]) + self.g.size)


def of_each_joint(columns: Floats) -> Floats:
    """Return columns (k, n, c n) that are zero but for their own joint, from these (k, c, n)."""
    k, _, n = columns.shape
    found: Floats = np.einsum('kcn,in->kicn', columns, np.eye(n))
    return found.reshape(k, n, -1)


def rows_of(recording: Recording, model: SerialChain) -> Rows:
    """Return the rows of all windows of a recording without gaps.

    Raises:
        BlfDscError: there are too few.
    """
    h = recording.period
    n = len(recording.joints)
    near_gap = _near_gap(recording)
    starts = _starts(near_gap, h)
    needed = _WINDOWS_OF_JOINT * n
    if starts.size < needed:
        raise BlfDscError(
            f'only {starts.size} windows of {WINDOW:g} s have no gaps: record at least '
            f'{needed * HOP:.3g} s without losses'
        )
    q, dq = _smoothed(recording)
    every = max(1, round(_GRAVITY / h))
    rows = Rows(
        q=q,
        dq=dq,
        torque=recording.torque,
        period=h,
        gravity=Samples(_at_rest(q[::every], model)),
        every=every,
        speed=np.percentile(np.abs(dq[~near_gap]), 95.0, axis=0, overwrite_input=True),
        load=np.zeros((model.p, LOAD)),
        carried=Carried(),
        starts=starts,
        clipped=np.zeros((starts.size, n), dtype=bool),
    )
    return _filled(rows, model, WINDOW, np.zeros(n))


def _filled(rows: Rows, model: SerialChain, length: float, distances: Floats) -> Rows:
    """Return rows of windows of so many seconds with all columns but load friction."""
    dq = rows.dq
    n = rows.speed.size
    g, slope = weighting(rows.period, length)
    time = np.asarray((rows.starts + 0.5 * (g.size - 1)) * rows.period, np.float64)
    rows = rows._replace(time=time, g=g, slope=slope)

    def in_motion(at: slice) -> Floats:
        return dq[at] ** 2 / (dq[at] ** 2 + _REST**2)

    return rows._replace(
        inertial=Samples(_inertial(rows, model)),
        weight=rows.over_windows(in_motion) ** 2,
        speeds=rows.over_windows(lambda at: np.abs(dq[at])),
        columns={
            'viscous': rows.over_windows(lambda at: dq[at]),
            'offset': np.ones((rows.starts.size, n)),
            'quadratic': rows.over_windows(lambda at: dq[at] * np.abs(dq[at])),
        },
        coupling=_coupling(rows),
    ).with_sliding(distances)


def shortened(
    rows: Rows,
    windows: Indices,
    model: SerialChain,
    distances: Floats,
    length: float,
    parts: int,
) -> Rows:
    """Return rows of windows of so many seconds, in `parts` for each of some of the windows.

    They pass what changes faster.  `distances` (n,) are those of `with_sliding`; there is no load
    friction.
    """
    h = rows.period
    hop = max(1.0, HOP / h) / parts
    middle = 0.5 * (rows.g.size - _samples(h, length))
    after = np.round(middle + hop * (np.arange(parts) - 0.5 * (parts - 1)))
    at = (rows.starts[windows, None] + after.astype(np.intp)).ravel()
    starts, first = np.unique(at, return_index=True)
    clipped = np.repeat(rows.clipped[windows], parts, axis=0)[first]
    short = rows._replace(starts=starts, clipped=clipped)
    return _filled(short, model, length, distances)


def _near_gap(recording: Recording) -> Flags:
    """Return at which samples (N,) smoothed positions have a gap within."""
    from scipy.ndimage import maximum_filter1d

    width = smoothing_width(recording.period)
    found = maximum_filter1d(recording.gap, width, mode='constant')
    return np.asarray(found, dtype=bool)


def _smoothed(recording: Recording) -> tuple[Samples, Samples]:
    """Return smoothed positions and velocities (N, n)."""
    from scipy.signal import savgol_filter

    h = recording.period
    size = recording.gap.size
    width = smoothing_width(h)

    def smoothed(at: slice, derivative: int) -> Floats:
        found = savgol_filter(recording.q[at], width, 3, derivative, h, axis=0)
        return np.asarray(found)

    q, dq = (mapped(size, partial(smoothed, derivative=k), width) for k in range(2))
    return q, dq


def smoothing_width(h: float) -> int:
    """Return the number of samples, one each h seconds, over which positions are smoothed."""
    return 2 * max(2, round(0.5 * SMOOTHING / h)) + 1


def _inertial(rows: Rows, model: SerialChain) -> Iterator[Floats]:
    """Yield blocks of the columns of P."""
    n = rows.speed.size
    regressors = np.zeros((2, n, model.p))
    for block, samples in rows.in_blocks():
        starts = rows.starts[block] - samples.start
        X = np.zeros((starts.size, n, model.p))
        q = rows.q[samples]
        dq = rows.dq[samples]
        add_windows(model, q, dq, rows.g, rows.slope, starts, regressors, X)
        yield X


def _at_rest(postures: Floats, model: SerialChain) -> Iterator[Floats]:
    """Yield blocks of the regressors (., n, p) at rest in postures (., n)."""
    for block in blocks_of(len(postures)):
        zeros = np.zeros_like(postures[block])
        yield regressors_at(model, postures[block], zeros, zeros, zeros)


def weighting(h: float, window: float = WINDOW) -> tuple[Floats, Floats]:
    """Return g with sum 1, and g' [1/s], at the samples of a window [s]."""
    length = _samples(h, window)
    turn = np.pi / (length - 1)
    phase = turn * np.arange(length) - 0.5 * np.pi
    g = np.cos(phase) ** 4
    slope = -4.0 * np.cos(phase) ** 3 * np.sin(phase) * turn / h
    total = g.sum()
    return g / total, slope / total


def _samples(h: float, window: float) -> int:
    """Return the number of samples of a window [s], one each h seconds."""
    return round(window / h) + 1


def _starts(near_gap: np.ndarray, h: float) -> Indices:
    """Return the first sample of each window without gaps."""
    length = _samples(h, WINDOW)
    hop = max(1, round(HOP / h))
    starts = np.arange(0, near_gap.size - length + 1, hop)
    if not starts.size:
        return starts
    with_gaps = sliding_window_view(near_gap, length)[starts].any(axis=1)
    return starts[~with_gaps]


def _coupling(rows: Rows) -> Floats:
    """Return the columns (R, 2, 3) of one motor that drives the last two joints."""

    def others(at: slice) -> Floats:
        return rows.dq[at][:, :-3:-1]

    def both(at: slice) -> Floats:
        speed = rows.dq[at][:, -2:].sum(axis=1, keepdims=True)
        return np.repeat(slidings(speed, COULOMB_SPEED), 2, axis=1)

    if rows.speed.size == 1:
        return np.zeros((rows.starts.size, 1, COUPLING))
    inertia = -rows.over_windows(others, rows.slope)
    friction = (rows.over_windows(each) for each in (others, both))
    return np.stack((inertia, *friction), axis=2)


class Split(NamedTuple):
    """Indices of the windows in which the arm moves."""

    moving: Indices  # all
    fit: Indices  # the first four fifths
    test: Indices  # the rest


def split(rows: Rows) -> Split:
    """Return the windows in which the arm moves, to fit and to test.

    Raises:
        BlfDscError: there are too few.
    """
    needed = _WINDOWS_OF_JOINT * rows.speed.size
    if rows.speed.max() < STILL:
        fastest = f'{rows.speed.max():.2g} rad/s (or m/s)'
        raise BlfDscError(
            f'no joint moves faster than {fastest}: record a motion of all joints'
        )
    moving = np.flatnonzero(rows.speeds.max(axis=1) > STILL)
    if moving.size < needed:
        raise BlfDscError(
            f'the arm moves in {moving.size} of {rows.time.size} windows: record at least '
            f'{needed * HOP:.3g} s of motion'
        )
    time = rows.time[moving]
    until = time[round((1.0 - _HELD_BACK) * moving.size)]
    fit = moving[time < until - 0.5 * WINDOW]
    test = moving[time > until + 0.5 * WINDOW]
    return Split(moving, fit, test)


@kernel
def add_windows(
    model: SerialChain,
    q: np.ndarray,
    dq: np.ndarray,
    g: np.ndarray,
    slope: np.ndarray,
    starts: np.ndarray,
    regressors: np.ndarray,
    X: np.ndarray,
) -> None:
    """Add g Yr - g' Yp of the samples (N, n) in each window to X (R, n, p).

    `regressors` (2, n, p) are overwritten.
    """
    Yp, Yr = regressors[0], regressors[1]
    first = 0
    for k in range(q.shape[0]):
        while first < starts.size and starts[first] + g.size <= k:
            first += 1
        if first < starts.size and starts[first] <= k:
            model.momentum_regressor(q[k], dq[k], Yp, Yr)
            for r in range(first, starts.size):
                j = k - starts[r]
                if j < 0:
                    break
                for i in range(model.n):
                    for c in range(model.p):
                        X[r, i, c] += g[j] * Yr[i, c] - slope[j] * Yp[i, c]
