# SPDX-License-Identifier: Apache-2.0
"""Properties of an arm by its responses: inertias, damping, lags, resonances and readings.

Below its resonances an arm is rigid.  The inverse of its response, D = G_y^-1, has on its
diagonal what each joint asks for while the others are held, with a lag on the way,

    D_jj = (J (i omega)^2 + F i omega) e^(i omega tau)

so inertia J and damping F (friction in motion acts like it) follow by least squares, tau with
them.  That lag is no more than a part of the fit: at these frequencies friction turns D by more
than drives do.  Theirs is taken from higher ones, where gears and what carries the arm answer in
phase or against it, below and above their resonances: but for the damping, D is real without lag,

    Im(D_jj e^(-i omega tau)) = F omega

An inertia that asks for less than the damping is not seen, nor is one that fits best with
the longest lag that is tried: friction and noise turn D by as much.  The lag of velocities is
that of G_v against i omega G_y.  Where a joint is free, gears show as an antiresonance, at
which the link absorbs what its motor does, and a resonance above it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.linear_loop import Timing
from blf_dsc_controller.commissioning.response import Response
from blf_dsc_controller.run import Run

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

_RIGID = (2.0, 12.0)  # Hz, of the fit
_BELOW, _FEWEST = 0.35, 5.0  # of a resonance, up to which an arm is rigid; Hz
_SEEN = 1.0  # of the damping, what inertia asks for at the fastest of these
LONGEST_LAG = 0.03
"""Lag from a torque to its motion, up to which one is looked for [s]."""

_LAGS = np.linspace(0.0, LONGEST_LAG, 301)  # s
_PHASED = (8.0, 40.0)  # Hz, of the lag of the drives
_OUT_OF_PHASE = 0.1  # mean square of what is left of D, that is believed to be a lag
_SHOWN = 10.0  # times the doubt of a response, from which it shows resonances
_PEAK = 1.5  # over its neighbours
_APART = 16  # frequencies to either side of a peak, that it is compared with
# samples: a torque arrives after one and is held for another, a velocity is a difference of two
_TORQUE_DELAY, _VELOCITY_DELAY = 1.5, 0.5


class Resonance(NamedTuple):
    """A peak of the response of one joint."""

    joint: int
    posture: int
    frequency: float  # Hz
    height: float  # over a rigid joint


class Findings(NamedTuple):
    """What was measured of an arm, over its postures."""

    inertia: Floats  # (n,) kg m^2, the largest with the others held; nan: not seen
    inertias: Floats  # (k, n) likewise in each run
    damping: Floats  # (n,) N m s/rad, the mean
    friction: Floats  # (n,) N m, the largest: constant, it takes as much power
    # (k, n) kg m^2, inertias up to which one would not be seen; 0: it is
    hidden: Floats
    unfit: NDArray[np.bool_]  # (k, n) whether the longest lag that is tried fits best
    drive_lag: float  # s, from a torque to the motion, sampling included; nan likewise
    velocity_lag: float  # s, of velocities against positions
    resonances: tuple[Resonance, ...]
    rate: float  # Hz, of joint states
    jitter: float  # s, standard deviation of the time between two
    lost: float  # fraction of the joint states
    resolution: Floats  # (n,) rad, least step of the positions

    def lag(self, sample_time: float) -> float:
        """Return `robot.lag` [s]: the lags beyond those of sampling; nan: not known."""
        return float(np.sum(self._lags(sample_time)))

    def timing(self, sample_time: float, lag: float) -> Timing:
        """Return sampling and lags; where they are not known, halves of `lag` [s]."""
        drives, velocity = self._lags(sample_time)
        if np.isnan(drives):
            drives = velocity = 0.5 * lag
        return Timing(sample_time, drive_lag=drives, velocity_lag=velocity)

    def _lags(self, sample_time: float) -> tuple[float, float]:
        """Return the lags of drives and velocities [s] beyond those of sampling."""
        drives = np.maximum(0.0, self.drive_lag - _TORQUE_DELAY * sample_time)
        velocity = np.maximum(0.0, self.velocity_lag - _VELOCITY_DELAY * sample_time)
        return float(drives), float(velocity)


def findings_of(runs: Sequence[Run], responses: Sequence[Response]) -> Findings:
    """Return what runs of the motion and their responses show."""
    peaks = [_resonances(each, posture) for posture, each in enumerate(responses)]
    fits = [
        _rigid_fit(each, found) for each, found in zip(responses, peaks, strict=True)
    ]
    inertia, damping, lag, asked = (np.array(each) for each in zip(*fits, strict=True))
    unfit = lag >= LONGEST_LAG
    by_friction = _SEEN * damping / (2.0 * np.pi * _RIGID[1])
    hidden = np.where(unfit, asked, np.where(inertia < by_friction, by_friction, 0.0))
    inertia[hidden > 0.0] = np.nan
    gaps = np.concatenate([np.diff(run.stamp) for run in runs]) * 1e-9
    usual = float(np.median(gaps))
    missed = np.maximum(np.rint(gaps / usual) - 1.0, 0.0)
    return Findings(
        inertia=_largest(inertia),
        inertias=inertia,
        damping=damping.mean(axis=0),
        friction=_friction(damping, responses).max(axis=0),
        hidden=hidden,
        unfit=unfit,
        drive_lag=_drive_lag(responses),
        velocity_lag=float(np.median([_velocity_lag(each) for each in responses])),
        resonances=tuple(each for found in peaks for each in found),
        rate=1.0 / usual,
        jitter=float(gaps.std()),
        lost=float(missed.sum() / gaps.size),
        resolution=_resolution(runs),
    )


def _friction(damping: Floats, responses: Sequence[Response]) -> Floats:
    """Return the friction (k, n) [N m] in each run.

    Constant friction takes as much power as the damping (k, n) [N m s/rad] of the run, or
    as swings show that keep the joints sliding.
    """
    by_damping = damping.clip(0.0) * np.array([each.speed for each in responses])
    by_swings = np.array([each.friction for each in responses])
    return np.asarray(np.maximum(by_damping, by_swings))


def rubs(response: Response, damping: Floats) -> bool:
    """Whether friction damps a joint more than its gains do.

    Those with which it was measured have `damping` (n,) [N m s/rad].
    """
    fit = _rigid_fit(response, _resonances(response, 0))
    return bool((fit.damping > damping).any())


class _RigidFit(NamedTuple):
    """What joints (n,) look like while the arm is rigid."""

    inertia: Floats  # kg m^2
    damping: Floats  # N m s/rad
    lag: Floats  # s
    asked: Floats  # kg m^2, that would ask for all that is seen at the fastest of these


def _rigid_fit(response: Response, peaks: Sequence[Resonance]) -> _RigidFit:
    """Return what the joints look like below the lowest resonance."""
    peak = min((each.frequency for each in peaks), default=np.inf)
    low, high = _RIGID[0], max(_FEWEST, min(_RIGID[1], _BELOW * peak))
    rows = (response.frequency >= low) & (response.frequency <= high)
    s: Complex = np.asarray(2j * np.pi * response.frequency[rows], complex)
    D: Complex = np.asarray(np.linalg.inv(response.position[rows]), complex)
    joints = [_fit_of_joint(s, D[:, j, j]) for j in range(D.shape[-1])]
    J, F, tau = np.array(joints).T
    fast = s.size // 2
    own = np.diagonal(D, axis1=1, axis2=2)[fast:]
    asked = np.median(np.abs(own / s[fast:, None] ** 2), axis=0)
    return _RigidFit(J, F, tau, np.asarray(asked))


def _fit_of_joint(s: Complex, D: Complex) -> tuple[float, float, float]:
    """Return inertia, damping and lag by the least relative error, over a grid of lags."""
    weight = 1.0 / np.abs(D)
    wanted = np.concatenate(((D * weight).real, (D * weight).imag))

    def fit(lag: float) -> tuple[float, float, float, float]:
        turned = weight * np.exp(s * lag)
        columns = np.column_stack((turned * s**2, turned * s))
        rows = np.vstack((columns.real, columns.imag))
        x, rest, *_ = np.linalg.lstsq(rows, wanted, rcond=None)
        error = float(rest[0]) if rest.size else np.inf
        return error, float(x[0]), float(x[1]), lag

    return min(map(fit, _LAGS.tolist()))[1:]


def _largest(values: Floats) -> Floats:
    """Return the largest of each column (k, n) that is known, else nan."""
    known = np.where(np.isnan(values), -np.inf, values).max(axis=0)
    return np.where(np.isinf(known), np.nan, known)


def _drive_lag(responses: Sequence[Response]) -> float:
    """Return the lag [s] from torques to motion, in the median; nan: no joint shows it."""
    found = [_lags_by_phase(each) for each in responses]
    lags, left = (np.concatenate(each) for each in zip(*found, strict=True))
    known = lags[(left < _OUT_OF_PHASE) & (lags < LONGEST_LAG)]
    return float(np.median(known)) if known.size else float('nan')


def _lags_by_phase(response: Response) -> tuple[Floats, Floats]:
    """Return the lag (n,) [s] of each joint, and the mean square (n,) of what is left of D.

    It is a share of D: a half, if its phase is any.
    """
    low, high = _PHASED
    rows = (response.frequency >= low) & (response.frequency <= high)
    rate = 2.0 * np.pi * response.frequency[rows]
    own = np.diagonal(np.linalg.inv(response.position[rows]), axis1=1, axis2=2)
    turns = np.exp(-1j * rate * _LAGS[:, None])  # (lags, f)
    lags, left = [], []
    for D in own.T:
        across = (turns * D).imag / np.abs(D)
        damped = rate / np.abs(D)
        F = (across @ damped / (damped @ damped)).clip(0.0)
        squares = ((across - F[:, None] * damped) ** 2).mean(axis=1)
        lags.append(_LAGS[squares.argmin()])
        left.append(squares.min())
    return np.array(lags), np.array(left)


def _velocity_lag(response: Response) -> float:
    """Return the lag [s] of velocities, by the phase of the joints' own responses."""
    s = 2j * np.pi * response.frequency[:, None]
    own = [
        np.diagonal(each, axis1=1, axis2=2)
        for each in (response.velocity, response.position)
    ]
    rows = response.frequency >= _RIGID[0]
    phase = np.angle(own[0] / (s * own[1]))[rows]
    lags = -phase / (2.0 * np.pi * response.frequency[rows, None])
    return float(np.median(lags))


def _resonances(response: Response, posture: int) -> list[Resonance]:
    """Return the highest peak of each joint that has one."""
    own = np.abs(np.diagonal(response.position, axis1=1, axis2=2))
    doubt = response.position_noise * response.columns
    rate = 2.0 * np.pi * response.frequency
    found = []
    for j in range(own.shape[1]):
        relative = own[:, j] * rate**2
        rows = np.flatnonzero(
            (own[:, j] > _SHOWN * doubt[:, j]) & (response.frequency > _RIGID[1])
        )
        peaks = [k for k in rows.tolist() if _is_peak(relative, k)]
        if peaks:
            rigid = np.median(relative[response.frequency < _RIGID[1]])
            k = max(peaks, key=lambda k: float(relative[k]))
            height = float(relative[k] / rigid)
            found.append(Resonance(j, posture, float(response.frequency[k]), height))
    return found


def _is_peak(values: Floats, k: int) -> bool:
    near = values[max(0, k - _APART) : k + _APART + 1]
    if values[k] < near.max():
        return False
    before, after = values[max(0, k - _APART) : k], values[k + 1 : k + _APART + 1]
    if not (before.size and after.size):
        return False
    return bool(values[k] > _PEAK * max(before.min(), after.min()))


def _resolution(runs: Sequence[Run]) -> Floats:
    """Return the least step (n,) [rad] between two positions, 0 where they never repeat."""
    columns = np.concatenate([run.position for run in runs]).T
    steps = []
    for column in columns:
        values = np.unique(column)
        repeats = values.size < column.size / 2
        steps.append(
            float(np.diff(values).min()) if repeats and values.size > 1 else 0.0
        )
    return np.array(steps)
