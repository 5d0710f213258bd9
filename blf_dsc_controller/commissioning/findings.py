# SPDX-License-Identifier: Apache-2.0
"""Properties of an arm by its responses: inertias, damping, lags, resonances and readings.

Below its resonances an arm is rigid.  The inverse of its response, D = G_y^-1, has on its
diagonal what each joint asks for while the others are held, with a lag on the way,

    D_jj = (J (i omega)^2 + F i omega) e^(i omega tau)

so inertia J and damping F (friction in motion acts like it) follow by least squares, tau with
them.  That lag is no more than a part of the fit: at these frequencies friction turns D by more
than drives do, and not by the same at all of them where joints stick at times.  Theirs is taken
from higher ones.  Without lag, D is real there but for the damping F of the motor, and c of the
motor behind a spring, or of a loop at joint torque sensors,

    Im(D_jj e^(-i omega tau)) = F omega - c omega^3,        F, c >= 0

tau is the same for all joints.  Of a drive that lags like a filter it is the delay of the phase at
these frequencies, a little less than its time constant; springs that damp make it less, too.

An inertia that asks for less than the damping is not seen, nor is one that fits best with
the longest lag that is tried: friction and noise turn D by as much.  The lag of velocities is
that of G_v against i omega G_y, while the arm is rigid.  Where a joint is free, gears show as an
antiresonance, at which the link absorbs what its motor does, and a resonance above it.
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
# Hz, up to which the lag of the drives shows, and the part of that from which friction hides less
_FASTEST, _PHASED = 75.0, 1.0 / 3.0
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
    """Return the lag [s] from torques to motion, of all joints alike; nan: none shows it."""
    left = np.concatenate([_out_of_phase(each) for each in responses])
    within = left.argmin(axis=1) < _LAGS.size - 1  # else more would fit better
    known = left[within & (left.min(axis=1) < _OUT_OF_PHASE)]
    if not known.size:
        return float('nan')
    return float(_LAGS[np.log(known).sum(axis=0).argmin()])


def _out_of_phase(response: Response) -> Floats:
    """Return the mean square (n, lags) of what is left of D of each joint with each lag.

    It is a share of its column of D: a half, if it is alone and its phase is any.
    """
    from scipy.optimize import nnls

    high = min(_FASTEST, float(response.frequency[-1]))
    rows = (response.frequency >= _PHASED * high) & (response.frequency <= high)
    rate = 2.0 * np.pi * response.frequency[rows]
    D = np.linalg.inv(response.position[rows])
    sizes = np.linalg.norm(D, axis=1)  # (f, n), of columns, which friction disturbs
    own = np.diagonal(D, axis1=1, axis2=2)
    turned = np.exp(-1j * rate * _LAGS[:, None])[..., None] * own  # (lags, f, n)
    across = turned.imag / sizes
    powers = np.column_stack((rate / rate[-1], -((rate / rate[-1]) ** 3)))
    damped = rate[-1] * powers[..., None] / sizes[:, None]  # (f, 2, n)
    left = [
        [nnls(damped[..., j], at_lag)[1] for at_lag in across[..., j]]
        for j in range(own.shape[1])
    ]
    return np.square(left) / rate.size


def _velocity_lag(response: Response) -> float:
    """Return the lag [s] of velocities, by the joints' own responses while the arm is rigid."""
    low, high = _RIGID
    rows = (response.frequency >= low) & (response.frequency <= high)
    rate = 2.0 * np.pi * response.frequency[rows, None]
    position, velocity = (
        np.diagonal(each[rows], axis1=1, axis2=2)
        for each in (response.position, response.velocity)
    )
    return float(np.median((1j * rate * position / velocity).imag / rate))


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
