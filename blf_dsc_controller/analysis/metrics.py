# SPDX-License-Identifier: Apache-2.0
"""Metrics of a run: tracking, torque and learning, each as one number."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.messages.journal import OUTSIDE_BOUND
from blf_dsc_controller.messages.topics import (
    COLUMNS,
    COMPUTE_TIME,
    DISTANCE,
    DISTURBANCE,
    LAMBDA_MIN,
    LATCHED,
    LOAD,
    LYAPUNOV,
    MODEL_CHANGES,
    POSITION,
    RATIO,
    VELOCITY,
)
from blf_dsc_controller.run import Floats, Regressor, Run, Series

MOMENTS = (5, 10, 20, 40, 60)
"""Times at which the parameter error is reported [s]."""

_LEARNED = 0.01
_FEW = 8  # estimates that are shown one by one
_POSTURES = 400  # of the reference, at which torques are compared
_TAIL = 10.0  # s
_MOST = 100_000  # samples of the estimates, evenly spaced
_BLOCK = 8192
_NO_PARAMETERS = (
    *(*COLUMNS, DISTURBANCE, POSITION, VELOCITY, RATIO, DISTANCE, *LOAD, LYAPUNOV),
    *(LAMBDA_MIN, LATCHED, MODEL_CHANGES, COMPUTE_TIME),
)


@dataclass(frozen=True)
class Estimates:
    """Estimated model parameters over m samples."""

    names: tuple[str, ...]
    time: Floats  # (m,) s since the first sample of the run
    estimate: Floats  # (m, p)
    true: Floats | None  # (m, p); None if unknown, or if the plant's parameters have other names
    relative_error: Floats | None  # (m,) |P^ - P| / |P|, or of torques; None if P is unknown
    of_torques: bool  # of H P^ and H P along the reference, as the P of a URDF has mixed units
    unlike: tuple[str, ...]  # the plant's names, if they differ


def estimates_of(run: Run) -> Estimates | None:
    """Return the estimates of the model parameters, None if nothing was learned.

    They are compared with the truth by name, and only if the plant has the same parameters; those
    of a URDF arm are compared by their torques.
    """
    if run.monitor is None:
        return None
    names, truth, arm = _parameters(run.monitor.names), run.truth, run.arm
    step = -(-run.monitor.stamp.size // _MOST)
    rows = slice((run.monitor.stamp.size - 1) % step, None, step)
    stamp = run.monitor.stamp[rows]
    estimate = run.monitor.values[rows][:, _columns(run.monitor, names)]
    of_torques = arm is not None and _parameters(arm.units) == names
    theirs = () if truth is None else _parameters(truth.names)
    true = error = None
    if truth is not None and set(names) == set(theirs):
        true, theirs = truth.held(stamp, _columns(truth, names)), ()
        R = None  # |R (P^ - P)| is the norm of the torques H P^ - H P
        if arm is not None and of_torques:
            R = np.asarray(np.linalg.qr(_torques(run, arm.regressor), 'r'))
        error = _relative_error(estimate, true, R)
    return Estimates(names, run.time_of(stamp), estimate, true, error, of_torques, theirs)


def rejected_columns(run: Run) -> list[str]:
    """Return the disturbance columns that are not estimated at the end: this tells them by NaN."""
    if run.monitor is None:
        return []
    last = run.monitor.values[run.monitor.stamp.size - 1 :][0]
    names = [run.monitor.names[j] for j in np.flatnonzero(np.isnan(last))]
    return [name for name in names if name.startswith(COLUMNS)]


def _relative_error(estimate: Floats, P: Floats, R: Floats | None) -> Floats:
    """Return |P^ - P| / |P| (m,), or |R (P^ - P)| / |R P|."""
    found = np.empty(len(P))
    for begin in range(0, len(P), _BLOCK):
        some = slice(begin, begin + _BLOCK)
        off, size = estimate[some] - P[some], P[some]
        if R is not None:
            off, size = off @ R.T, size @ R.T
        with np.errstate(over='ignore', invalid='ignore'):  # no motion, no torques: unknown
            found[some] = np.linalg.norm(off, axis=1) / np.linalg.norm(size, axis=1)
    return found


def _columns(series: Series, names: Sequence[str]) -> NDArray[np.intp]:
    return np.array([series.names.index(name) for name in names], np.intp)


def _torques(run: Run, regressor: Regressor) -> Floats:
    """Return rows of H(q, dq, dq, ddq) (k n, p) along the reference, else along the motion.

    The derivatives are three-point differences.
    """
    name = 'position' if run.column('reference', 0) is None else 'reference'
    finite = np.isfinite(sum(_known(run, name, i) for i in range(len(run.joints))))
    known = 1 + np.flatnonzero(finite[:-2] & finite[1:-1] & finite[2:])
    rows = known[np.linspace(0, known.size - 1, min(_POSTURES, known.size)).astype(int)]
    after, before = (np.diff(run.time)[rows + k, np.newaxis] for k in (0, -1))
    earlier, q, later = (getattr(run, name)[rows + k] for k in (-1, 0, 1))
    forward, backward = (later - q) / after, (q - earlier) / before
    dq = (after * backward + before * forward) / (after + before)
    ddq = 2.0 * (forward - backward) / (after + before)
    H = regressor(q, dq, dq, ddq)
    return H.reshape(-1, H.shape[-1])


def _parameters(names: Iterable[str]) -> tuple[str, ...]:
    """Return the names that are parameters of an arm."""
    return tuple(name for name in names if not name.startswith(_NO_PARAMETERS))


def bodies_of(names: Sequence[str]) -> dict[str, list[int]]:
    """Return the indices of the estimates of each link and kind of friction; of few, each alone."""
    if len(names) <= _FEW:
        return {name: [k] for k, name in enumerate(names)}
    bodies: dict[str, list[int]] = {}
    for k, name in enumerate(names):
        link = re.search(r'\d+$', name)
        body = f'link {link[0]}' if link and ' ' not in name else name.split(' ')[0]
        bodies.setdefault(body, []).append(k)
    return bodies


def errors_of_bodies(
    bodies: Mapping[str, Sequence[int]], estimate: Floats, true: Floats | None, prior: Floats
) -> Floats:
    """Return how far the estimates (m, p) of each body are off, (b, m): rms [% of the prior].

    Off the truth or, where none is known, off the first estimates; a rejected estimate is NaN.
    `prior` (p,) are deviations.
    """
    origin = estimate[:1] if true is None else np.where(np.isnan(true), estimate[0], true)
    square = (100.0 * (estimate - origin) / prior) ** 2
    with np.errstate(divide='ignore', invalid='ignore'):  # all rejected: 0 / 0
        each = [
            np.nansum(square[:, k], axis=1) / np.isfinite(square[:, k]).sum(axis=1)
            for k in bodies.values()
        ]
        return np.sqrt(each)


def latch_time(run: Run) -> float | None:
    """Return the time at which learning began [s], None if it never did or is not recorded."""
    return next(iter(_rises(run, LATCHED)), None) if run.learns else None


def change_times(run: Run) -> list[float]:
    """Return the times [s] at which the controller detected a change of the arm."""
    return _rises(run, MODEL_CHANGES)


def _rises(run: Run, name: str) -> list[float]:
    """Return the times [s] at which a count of the learning rises."""
    if run.monitor is None or name not in run.monitor.names:
        return []
    rises = np.flatnonzero(np.diff(np.nan_to_num(run.monitor.column(name)), prepend=0.0) > 0.0)
    return [float(t) for t in run.time_of(run.monitor.stamp[rises])]


def true_change_times(run: Run) -> list[float]:
    """Return the times [s] at which the plant's true parameters began to change."""
    if run.truth is None:
        return []
    true = run.truth.select(_parameters(run.truth.names))
    changed = np.any(np.diff(true, axis=0) != 0.0, axis=1)
    begins = np.flatnonzero(np.diff(changed, prepend=False) & changed) + 1
    return [float(t) for t in run.time_of(run.truth.stamp[begins])]


def outside(run: Run, i: int) -> NDArray[np.bool_] | None:
    """Return where |xi1| >= k_c for a joint, (N,); None if error or bound is unknown."""
    error, bound = run.column('error', i), run.column('bound', i)
    return None if error is None or bound is None else np.asarray(np.abs(error) >= bound)


def _known(run: Run, name: str, i: int) -> Floats:
    """Return the values of one joint, NaN where they are unknown."""
    found = run.column(name, i)
    return np.full(run.stamp.size, np.nan) if found is None else found


def first_violation(run: Run) -> tuple[float, str]:
    """Return when [s] a joint first left its bound, and which; NaN and empty if none did.

    The error of the sample that causes a stop is not published, so the stop itself counts.
    """
    found = [
        (time, next((joint for joint in run.joints if f'{joint!r}' in stop.text), ''))
        for time, stop in run.timed_stops
        if stop.reason == OUTSIDE_BOUND
    ]
    for i, joint in enumerate(run.joints):
        violated = outside(run, i)
        if violated is not None and violated.any():
            found.append((float(run.time[violated.argmax()]), joint))
    return min(found, key=itemgetter(0), default=(math.nan, ''))


@dataclass(frozen=True)
class Metrics:
    """Metrics of n joints; NaN for what is unknown or has not happened."""

    max_error: tuple[float, ...]  #: (n,) rad, of |xi1|
    rms_error: tuple[float, ...]  #: (n,) rad
    bound: tuple[float, ...]  #: (n,) rad, the smallest
    widest_bound: tuple[float, ...]  #: (n,) rad, of a funnel or before a change
    peak_torque: tuple[float, ...]  #: (n,) N m
    rms_torque: tuple[float, ...]  #: (n,) N m
    torque_limit: tuple[float, ...]  #: (n,) N m, the smallest
    torque_rate: tuple[float, ...]  #: (n,) N m/s, rms of the change per sample time
    max_error_ratio: float  #: of |xi1| / k_c
    first_violation: float  #: s
    violating_joint: str
    latch_time: float  #: s
    parameter_error: dict[int, float]  #: `Estimates.relative_error` at MOMENTS
    final_parameter_error: float
    tail_parameter_error: float  #: rms over the last ten seconds
    time_to_1_percent: float  #: s, after which the parameter error stays below 1 %

    @property
    def held(self) -> bool | None:
        """Whether no joint left its bound, None if error or bound is unknown."""
        if not math.isnan(self.first_violation):
            return False
        return None if math.isnan(self.max_error_ratio) else True


@np.errstate(all='ignore')  # a bag may hold any number
def measure(run: Run) -> Metrics:
    """Compute the metrics of a run."""
    step = float(run.time[1]) if run.stamp.size > 1 else math.nan
    violation, joint = first_violation(run)
    latched = latch_time(run)
    estimates = estimates_of(run)
    learned = None if estimates is None else estimates.relative_error
    learning = dict.fromkeys(MOMENTS, math.nan), math.nan, math.nan, math.nan
    if estimates is not None and learned is not None:
        at = estimates.time
        tail = rms(learned[at >= at[-1] - _TAIL])
        learning = _at_moments(at, learned), float(learned[-1]), tail, _settled(at, learned)

    def each(reduce: Callable[[Floats], float], name: str) -> tuple[float, ...]:
        return tuple(reduce(_known(run, name, i)) for i in range(len(run.joints)))

    return Metrics(
        each(_peak, 'error'),
        each(rms, 'error'),
        each(_least, 'bound'),
        each(_peak, 'bound'),
        each(_peak, 'torque'),
        each(rms, 'torque'),
        each(_least, 'torque_limit'),
        tuple(change / step for change in each(lambda torque: rms(np.diff(torque)), 'torque')),
        _largest_ratio(run),
        violation,
        joint,
        math.nan if latched is None else latched,
        *learning,
    )


def _largest_ratio(run: Run) -> float:
    """Return the largest |xi1| / k_c; NaN if it is unknown."""
    pairs = ((_known(run, 'error', i), _known(run, 'bound', i)) for i in range(len(run.joints)))
    return float(np.fmax.reduce([_peak(error / bound) for error, bound in pairs]))


def _reduced(values: Floats, reduce: Callable[[Floats], float]) -> float:
    known = values[np.isfinite(values)]
    return float(reduce(known)) if known.size else math.nan


def rms(values: Floats) -> float:
    """Return the root mean square of the known values."""
    return _reduced(values, lambda known: np.sqrt(np.mean(known**2)))


def _peak(values: Floats) -> float:
    return _reduced(values, lambda known: np.abs(known).max())


def _least(values: Floats) -> float:
    return _reduced(values, np.min)


def _at_moments(time: Floats, error: Floats) -> dict[int, float]:
    """Return the error at the sample nearest to each moment; NaN where the run did not reach it."""
    end = time[-1] + 1.5 * (float(np.median(np.diff(time))) if time.size > 1 else 0.0)
    return {
        moment: float(error[np.abs(time - moment).argmin()])
        if time[0] <= moment <= end
        else math.nan
        for moment in MOMENTS
    }


def _settled(time: Floats, error: Floats) -> float:
    above = np.flatnonzero(~(error < _LEARNED))
    first = above[-1] + 1 if above.size else 0
    return float(time[first]) if first < time.size else math.nan
