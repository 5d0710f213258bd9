# SPDX-License-Identifier: Apache-2.0
"""Rows X theta = u of the regression over short windows of a recording, without accelerations.

With a smooth g that vanishes at both ends of a window, d/dt(Yp P) + Yr P + friction = torque gives

    int (g Yr - g' Yp) dt P + int g friction dt = int g torque dt

exactly, by parts (modulating functions: Shinbrot, On the analysis of linear and nonlinear systems,
1957).  Both sides pass the same low-pass filter; windows with gaps are left out.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from blf_dsc_controller.arms.serial_chain import SerialChain
from blf_dsc_controller.compiled.jit import kernel
from blf_dsc_controller.identification.recording import Recording
from blf_dsc_controller.run import Floats

WINDOW = 0.2
"""Length of a window [s]."""

HOP = WINDOW / 4
"""Time from one window to the next [s]."""

_SMOOTHING = 0.03  # s, over which positions are smoothed
_COULOMB = 0.01  # rad/s or m/s, scale of the tanh that replaces the sign
_REST = 0.05  # rad/s or m/s, below which a joint may stick and its rows count less


class Rows(NamedTuple):
    """R windows of n joints and m unknowns [P; viscous; Coulomb; offset]."""

    time: Floats  # (R,) of their centres, s
    X: Floats  # (R, n, m)
    weight: Floats  # (R, n) of each row, at most 1
    speed: Floats  # (n,) 95th percentile of each joint's speed, rad/s or m/s
    torque: Floats  # (N, n) at all samples
    g: Floats  # (L,) with sum 1
    slope: Floats  # (L,) g' in 1/s, scaled likewise
    starts: np.ndarray  # (R,) first sample of each window
    period: float  # s

    def u(self, delay: float) -> Floats:
        """Return the right-hand side (R, n) of torques recorded `delay` [s] late."""
        return self.over_windows(self._shifted(delay), self.g)

    def rate(self, delay: float) -> Floats:
        """Return the time derivative (R, n) of `u`."""
        return -self.over_windows(self._shifted(delay), self.slope)

    def _shifted(self, delay: float) -> Floats:
        at = np.arange(self.torque.shape[0]) + delay / self.period
        samples = np.arange(at.size)
        return np.transpose([np.interp(at, samples, column) for column in self.torque.T])

    def over_windows(self, values: Floats, factors: Floats) -> Floats:
        """Return the sums (R, n) of the values (N, n) in each window times factors (L,)."""
        windows = sliding_window_view(values, factors.size, axis=0)[self.starts]
        return np.asarray(windows @ factors)


def rows_of(recording: Recording, model: SerialChain) -> Rows:
    """Return the rows of all windows of a recording without gaps."""
    from scipy.signal import savgol_filter

    h, n = recording.period, len(recording.joints)
    length = round(WINDOW / h) + 1
    width = 2 * max(2, round(0.5 * _SMOOTHING / h)) + 1
    covered = np.convolve(recording.gap, np.ones(width), 'same') > 0.0
    starts = np.arange(0, recording.q.shape[0] - length + 1, max(1, round(HOP / h)))
    starts = starts[~sliding_window_view(covered, length)[starts].any(axis=1)]
    turn = np.pi / (length - 1)
    phase = turn * np.arange(length) - 0.5 * np.pi
    g, slope = np.cos(phase) ** 4, -4.0 * np.cos(phase) ** 3 * np.sin(phase) * turn / h
    g, slope = g / g.sum(), slope / g.sum()
    q, dq = (savgol_filter(recording.q, width, 3, k, h, axis=0) for k in (0, 1))
    X = np.zeros((starts.size, n, model.p + 3 * n))
    regressors = np.zeros((2, n, model.p))
    add_windows(model, q, dq, g, slope, starts, regressors, X[:, :, : model.p])
    rows = Rows(
        time=(starts + 0.5 * (length - 1)) * h,
        X=X,
        weight=np.empty(0),
        speed=np.percentile(np.abs(dq[~covered]), 95.0, axis=0),
        torque=recording.torque,
        g=g,
        slope=slope,
        starts=starts,
        period=h,
    )
    columns = dq, np.tanh(dq / _COULOMB), np.ones_like(dq)
    for k, column in enumerate(columns):
        filtered = rows.over_windows(column, g)
        for i in range(n):
            X[:, i, model.p + k * n + i] = filtered[:, i]
    moving = dq**2 / (dq**2 + _REST**2)
    return rows._replace(weight=rows.over_windows(moving, g) ** 2)


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
