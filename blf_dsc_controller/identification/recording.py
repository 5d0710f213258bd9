# SPDX-License-Identifier: Apache-2.0
"""Recordings of an arm, evenly sampled, and their regression X theta = u over short windows.

Velocities are not read: those of a driver lag behind its positions, usually by an unknown time.
Accelerations are not needed: with a smooth g that vanishes at both ends of a window,
d/dt(Yp P) + Yr P + friction = torque gives

    int (g Yr - g' Yp) dt P + int g friction dt = int g torque dt

exactly, by parts (modulating functions: Shinbrot, On the analysis of linear and nonlinear systems,
1957).  Both sides pass the same low-pass filter; windows with gaps are left out.

Friction of a joint with speed v and s(v) = tanh(v / v_c):  viscous v,  Coulomb s(v),  load |G| s(v)
with the torque G of gravity (gears lose what they carry),  Stribeck s(v) exp(-(v / v_s)^2),
quadratic v |v|.  A motor that drives the last two joints, which are then coupled, adds to each of
them the same Coulomb friction s(v_1 + v_2), and viscous friction and inertia times the speed and
acceleration of the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from blf_dsc_controller.arms.model import regressors_at
from blf_dsc_controller.arms.serial_chain import SerialChain
from blf_dsc_controller.arms.urdf import Tree
from blf_dsc_controller.bags.content import NO_NAMES, NameMap, read_content
from blf_dsc_controller.bags.reader import applied_torque, single_run
from blf_dsc_controller.bags.sources import BagError
from blf_dsc_controller.compiled.jit import kernel
from blf_dsc_controller.messages.topics import JOINT_STATES
from blf_dsc_controller.run import Floats, Stamps

_SLOWEST = 0.02  # s between states
_FASTEST = 1e-5  # s, likewise
_SPARSE = 100.0  # times the intervals between states: longest bag
_GAP = 3.0  # intervals between two states


class Recording(NamedTuple):
    """N samples of n joints, a period apart."""

    joints: tuple[str, ...]
    period: float  # s
    q: Floats  # (N, n) rad, or m
    torque: Floats  # (N, n) N m, or N
    gap: NDArray[np.bool_]  # (N,) whether nothing was recorded here
    source: str  # topic of the torques


def read_recording(
    path: Path,
    text: str,
    joints: Sequence[str] = (),
    namespace: str = '',
    names: NameMap = NO_NAMES,
    commanded: bool = False,  # noqa: FBT001, FBT002 - the last of a list
) -> Recording:
    """Read joint states with efforts, or else (or if `commanded`) commanded torques, from any bag.

    `text` is the URDF; `joints` are the arm's, from its base to its tip, by default all in the bag
    up to where the arm branches; `namespace` and `names` are as for `read_run`.

    Raises:
        BlfDscError: the bag cannot be read, has no torques or too few states, or has the joints
            of no arm.
    """
    content = read_content(path, namespace, names)
    named = content.topics[JOINT_STATES].name_lists()
    joints = tuple(joints) or _arm_joints(text, set().union(*named), names)
    theirs = names.joints_of(joints)
    states, _, _ = single_run(content, theirs)
    torque, source = np.asarray(states.field(2)), f'effort of {content.topics[JOINT_STATES].name}'
    if commanded or not np.nan_to_num(torque).any():
        source, applied = applied_torque(content, states)
        torque = np.asarray(applied.field(2))
        if not np.nan_to_num(torque).any():
            raise BagError(f'{path}: all torques in the {source} are zero: record measured efforts')
    return _resampled(joints, states.stamp, np.asarray(states.field(0)), torque, source)


def _arm_joints(text: str, in_bag: set[str], names: NameMap) -> tuple[str, ...]:
    """Return the joints of the arm: from the root of the URDF to the last that the bag has."""
    ours = in_bag | {our for our, their in names.joints.items() if their in in_bag}
    arm = Tree.of(text).trunk()
    while arm and arm[-1] not in ours:
        arm = arm[:-1]
    if not arm:
        raise BagError(
            f'the bag has no joint of the URDF; it names {", ".join(sorted(in_bag))}: choose an '
            "arm with --tip, or give the bag's names, as in --map joint1=shoulder"
        )
    return arm


def _resampled(
    joints: tuple[str, ...], stamp: Stamps, q: Floats, torque: Floats, source: str
) -> Recording:
    """Resample evenly, interpolating over uneven stamps and up to two lost states."""
    known = np.isfinite(np.column_stack((q, torque))).all(axis=1)
    stamp, order = np.unique(stamp[known], return_index=True)
    q, torque = q[known][order], torque[known][order]
    if stamp.size < 2:
        raise BagError(
            f'the bag has {stamp.size} joint state(s) with a position, a torque and a unique '
            'stamp; hundreds are needed'
        )
    time = (stamp - stamp[0]) * 1e-9
    intervals = np.diff(time)
    period = float(np.median(intervals))
    if period > _SLOWEST:
        raise BagError(
            f'the joint states are {period:.3g} s apart; at least one in {_SLOWEST:g} s is needed'
        )
    if period < _FASTEST or time[-1] > _SPARSE * period * time.size:
        raise BagError(
            f'{time.size} joint states are {period:.3g} s apart, but the last one comes '
            f'{time[-1]:.3g} s after the first: are their stamps of one clock? Cut the bag where '
            'they jump'
        )
    grid = np.arange(0.0, time[-1], period)
    gap = (intervals > _GAP * period)[np.searchsorted(time, grid, side='right') - 1]
    q, torque = (interpolated(grid, time, values) for values in (q, torque))
    return Recording(joints, period, q, torque, gap, source)


def interpolated(at: np.ndarray, time: np.ndarray, values: np.ndarray) -> Floats:
    """Return the values (N, n) of these times at other times (k,), linearly interpolated."""
    return np.asarray(np.transpose([np.interp(at, time, column) for column in values.T]))


def joined(first: Recording, second: Recording) -> tuple[Recording, float]:
    """Return two recordings with a gap between them as one, and the time [s] of the second."""
    times = np.arange(second.q.shape[0]) * second.period
    grid = np.arange(0.0, times[-1], first.period)
    q, torque = (interpolated(grid, times, values) for values in (second.q, second.torque))
    gap = np.interp(grid, times, second.gap) > 0.0
    gap[0] = True
    together = first._replace(
        q=np.vstack((first.q, q)),
        torque=np.vstack((first.torque, torque)),
        gap=np.append(first.gap, gap),
        source=f'{first.source}, {second.source}',
    )
    return together, first.q.shape[0] * first.period


WINDOW = 0.2
"""Length of a window [s]."""

HOP = WINDOW / 4
"""Time from one window to the next [s]."""

_SMOOTHING = 0.03  # s, over which positions are smoothed
_COULOMB = 0.01  # rad/s or m/s, scale v_c of the tanh that replaces the sign
_STRIBECK = 0.1  # rad/s or m/s, scale v_s
_GRAVITY = 0.01  # s between positions at which the torque of gravity is computed
_REST = 0.05  # rad/s or m/s, below which a joint may stick and its rows count less


COLUMNS = ('viscous', 'Coulomb', 'load', 'offset', 'Stribeck', 'quadratic')
"""Columns of each joint, after those of P."""

COUPLING = 3
"""Columns of a coupling of the last two joints: inertia, viscous and Coulomb friction."""


LOAD = 10
"""Columns of a load that is picked up."""


class Rows(NamedTuple):
    """R windows of n joints and m unknowns [P; COLUMNS of all joints; COUPLING; LOAD]."""

    time: Floats  # (R,) of their centres, s
    X: Floats  # (R, n, m)
    weight: Floats  # (R, n) of each row, at most 1
    speed: Floats  # (n,) 95th percentile of each joint's speed, rad/s or m/s
    torque: Floats  # (N, n) at all samples
    g: Floats  # (L,) with sum 1
    slope: Floats  # (L,) g' in 1/s, scaled likewise
    starts: np.ndarray  # (R,) first sample of each window
    period: float  # s
    sliding: Floats  # (N, n) s(v)
    gravity: Floats  # (N / every, n, p) regressor of the torque of gravity
    every: int  # samples between its positions

    def gravity_torque(self, P: Floats) -> Floats:
        """Return the torque of gravity (N, n) of the base parameters P (p,)."""
        samples = np.arange(len(self.sliding))
        return interpolated(samples, samples[:: self.every], self.gravity @ P)

    def set_load(self, P: Floats) -> None:
        """Compute the columns of the load friction in X for the gravity of P (p,)."""
        self.set_column('load', P.size, np.abs(self.gravity_torque(P)) * self.sliding)

    def set_column(self, name: str, p: int, values: Floats) -> None:
        """Set a column of each joint in X to the values (N, n), filtered."""
        n = values.shape[1]
        joints = np.arange(n)
        columns = p + COLUMNS.index(name) * n + joints
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
    X = np.zeros((starts.size, n, model.p + len(COLUMNS) * n + COUPLING + LOAD))
    regressors = np.zeros((2, n, model.p))
    add_windows(model, q, dq, g, slope, starts, regressors, X[:, :, : model.p])
    sliding = np.tanh(dq / _COULOMB)
    every = max(1, round(_GRAVITY / h))
    at = q[::every]
    still = np.zeros_like(at)
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
        sliding=sliding,
        gravity=regressors_at(model, at, still, still, still),
        every=every,
    )
    rows.set_column('viscous', model.p, dq)
    rows.set_column('Coulomb', model.p, sliding)
    rows.set_column('offset', model.p, np.ones_like(dq))
    rows.set_column('Stribeck', model.p, sliding * np.exp(-((dq / _STRIBECK) ** 2)))
    rows.set_column('quadratic', model.p, dq * np.abs(dq))
    if n > 1:
        at = model.p + len(COLUMNS) * n
        others, both = dq[:, [-1, -2]], np.tanh(dq[:, -2:].sum(axis=1, keepdims=True) / _COULOMB)
        X[:, -2:, at] = -rows.over_windows(others, slope)
        X[:, -2:, at + 1] = rows.over_windows(others, g)
        X[:, -2:, at + 2] = rows.over_windows(both, g)
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
