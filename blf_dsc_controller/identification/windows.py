# SPDX-License-Identifier: Apache-2.0
"""Regression X theta = u of a recording over short windows.

Accelerations are not needed: with a smooth g that vanishes at both ends of a window,
d/dt(Yp P) + Yr P + friction = torque gives

    int (g Yr - g' Yp) dt P + int g friction dt = int g torque dt

exactly, by parts (modulating functions: Shinbrot, On the analysis of linear and nonlinear systems,
1957).  Both sides pass the same low-pass filter; windows with gaps are left out.

Velocities are not read, either: those of a driver lag behind its positions, usually by an unknown
time.  They are the slopes of cubics fitted to the positions around each sample (Savitzky and Golay,
Smoothing and differentiation of data, 1964).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from blf_dsc_controller.arms.model import regressors_at
from blf_dsc_controller.arms.serial_chain import SerialChain
from blf_dsc_controller.compiled.jit import kernel
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.identification.recording import Recording, interpolated
from blf_dsc_controller.identification.sliding import COULOMB_SPEED, sliding_direction
from blf_dsc_controller.identification.values import COUPLING, LOAD
from blf_dsc_controller.run import Floats

Indices = NDArray[np.intp]

WINDOW = 0.2
"""Length of a window [s]."""

HOP = WINDOW / 4
"""Time from one window to the next [s]."""

SMOOTHING = 0.03
"""Time over which positions are smoothed [s]."""

STILL = 0.02
"""Speed of a joint that does not move [rad/s or m/s]."""

STRIBECK_SPEED = 0.1
"""Scale v_s of the Stribeck friction [rad/s or m/s]."""

COLUMNS = ('viscous', 'Coulomb', 'load', 'offset', 'Stribeck', 'quadratic')
"""Columns of each joint, after those of P."""

_GRAVITY = 0.01  # s between positions at which the torque of gravity is computed
# rad/s or m/s, below which stiction may hold a joint, whose rows then count less
_REST = 0.003
_HELD_BACK = 0.2  # fraction of the moving windows, at the end
_WINDOWS_OF_JOINT = 10  # least number


class Rows(NamedTuple):
    """R windows of n joints and m unknowns [P; COLUMNS of all joints; COUPLING; LOAD]."""

    time: Floats  # (R,) of their centres, s
    X: Floats  # (R, n, m)
    weight: Floats  # (R, n) of each row, at most 1
    speeds: Floats  # (R, n) mean speed in each window, rad/s or m/s
    speed: Floats  # (n,) 95th percentile of each joint's speed, rad/s or m/s
    q: Floats  # (N, n) smoothed positions at all samples
    dq: Floats  # (N, n) their velocities
    torque: Floats  # (N, n) likewise
    g: Floats  # (L,) with sum 1
    slope: Floats  # (L,) g' in 1/s, scaled likewise
    starts: np.ndarray  # (R,) first sample of each window
    period: float  # s
    sliding: Floats  # (N, n) s
    gravity: Floats  # (N / every, n, p) regressor of the torque of gravity
    every: int  # samples between its positions

    @property
    def p(self) -> int:
        """Number of base parameters."""
        return int(self.gravity.shape[2])

    def gravity_torque(self, P: Floats) -> Floats:
        """Return the torque of gravity (N, n) of the base parameters P (p,)."""
        samples = np.arange(len(self.q))
        return interpolated(samples, samples[:: self.every], self.gravity @ P)

    def set_load(self, P: Floats) -> None:
        """Compute the columns of the load friction in X for the gravity of P (p,)."""
        self.set_column('load', np.abs(self.gravity_torque(P)) * self.sliding)

    def set_sliding(self, distances: Floats) -> None:
        """Compute the columns of friction in X for the distances x_s (n,) of `sliding`.

        Those of the load friction follow with the next `set_load`.
        """
        self.sliding[:] = sliding_direction(self.q, self.dq, distances)
        self.set_column('Coulomb', self.sliding)
        self.set_stribeck(STRIBECK_SPEED, 2.0)

    def set_stribeck(self, speed: float, exponent: float) -> None:
        """Compute the columns of the Stribeck friction in X, s exp(-|v / speed|^exponent)."""
        fading = np.exp(-(np.abs(self.dq / speed) ** exponent))
        self.set_column('Stribeck', self.sliding * fading)

    def set_column(self, name: str, values: Floats) -> None:
        """Set a column of each joint in X to the values (N, n), filtered."""
        n = values.shape[1]
        joints = np.arange(n)
        columns = self.p + COLUMNS.index(name) * n + joints
        self.X[:, joints, columns] = self.over_windows(values, self.g)

    def u(self, delay: float) -> Floats:
        """Return the right-hand side (R, n) of torques recorded `delay` [s] late."""
        return self.over_windows(self._shifted(delay), self.g)

    def rate(self, delay: float) -> Floats:
        """Return the time derivative (R, n) of `u`."""
        return -self.over_windows(self._shifted(delay), self.slope)

    def _shifted(self, delay: float) -> Floats:
        samples = np.arange(self.torque.shape[0])
        return interpolated(samples + delay / self.period, samples, self.torque)

    def over_windows(self, values: np.ndarray, factors: Floats) -> Floats:
        """Return the sums (R, n) of the values (N, n) in each window times factors (L,)."""
        windows = sliding_window_view(values, factors.size, axis=0)[self.starts]
        return np.asarray(windows @ factors)


def rows_of(recording: Recording, model: SerialChain) -> Rows:
    """Return the rows of all windows of a recording without gaps."""
    from scipy.signal import savgol_filter

    h = recording.period
    n = len(recording.joints)
    g, slope = _weighting(h)
    width = 2 * max(2, round(0.5 * SMOOTHING / h)) + 1
    q = savgol_filter(recording.q, width, 3, 0, h, axis=0)
    dq = savgol_filter(recording.q, width, 3, 1, h, axis=0)
    near_gap = np.convolve(recording.gap, np.ones(width), 'same') > 0.0
    starts = _starts(near_gap, g.size, h)
    every = max(1, round(_GRAVITY / h))
    postures = q[::every]
    zeros = np.zeros_like(postures)
    columns = model.p + len(COLUMNS) * n + COUPLING + LOAD
    rows = Rows(
        time=np.asarray((starts + 0.5 * (g.size - 1)) * h, dtype=np.float64),
        X=np.zeros((starts.size, n, columns)),
        weight=np.empty(0),
        speeds=np.empty(0),
        speed=np.percentile(np.abs(dq[~near_gap]), 95.0, axis=0),
        q=q,
        dq=dq,
        torque=recording.torque,
        g=g,
        slope=slope,
        starts=starts,
        period=h,
        sliding=np.zeros_like(dq),
        gravity=regressors_at(model, postures, zeros, zeros, zeros),
        every=every,
    )
    regressors = np.zeros((2, n, model.p))
    add_windows(model, q, dq, g, slope, starts, regressors, rows.X[:, :, : model.p])
    rows.set_sliding(np.zeros(n))
    rows.set_column('viscous', dq)
    rows.set_column('offset', np.ones_like(dq))
    rows.set_column('quadratic', dq * np.abs(dq))
    if n > 1:
        _set_coupling(rows)
    in_motion = dq**2 / (dq**2 + _REST**2)
    return rows._replace(
        weight=rows.over_windows(in_motion, g) ** 2,
        speeds=rows.over_windows(np.abs(dq), g),
    )


def _weighting(h: float) -> tuple[Floats, Floats]:
    """Return g with sum 1, and g' [1/s], at the samples of a window."""
    length = round(WINDOW / h) + 1
    turn = np.pi / (length - 1)
    phase = turn * np.arange(length) - 0.5 * np.pi
    g = np.cos(phase) ** 4
    slope = -4.0 * np.cos(phase) ** 3 * np.sin(phase) * turn / h
    total = g.sum()
    return g / total, slope / total


def _starts(near_gap: np.ndarray, length: int, h: float) -> Indices:
    """Return the first sample of each window without gaps."""
    hop = max(1, round(HOP / h))
    starts = np.arange(0, near_gap.size - length + 1, hop)
    if not starts.size:
        return starts
    with_gaps = sliding_window_view(near_gap, length)[starts].any(axis=1)
    return np.asarray(starts[~with_gaps])


def _set_coupling(rows: Rows) -> None:
    """Set the columns of one motor that drives the last two joints."""
    at = rows.X.shape[2] - LOAD - COUPLING
    last = rows.dq[:, -2:]
    others = last[:, ::-1]
    both = np.tanh(last.sum(axis=1, keepdims=True) / COULOMB_SPEED)
    rows.X[:, -2:, at] = -rows.over_windows(others, rows.slope)
    rows.X[:, -2:, at + 1] = rows.over_windows(others, rows.g)
    rows.X[:, -2:, at + 2] = rows.over_windows(both, rows.g)


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
    n = rows.speed.size
    needed = _WINDOWS_OF_JOINT * n
    if rows.time.size < needed:
        raise BlfDscError(
            f'only {rows.time.size} windows have no gaps: record without losses'
        )
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
