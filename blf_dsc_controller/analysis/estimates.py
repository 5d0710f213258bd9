# SPDX-License-Identifier: Apache-2.0
"""Estimates of a run beside the truth: by time, and by link."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from blf_dsc_controller.messages.topics import (
    COLUMNS,
    COMPUTE_TIME,
    CONTACT,
    DISTANCE,
    DISTURBANCE,
    LAMBDA_MIN,
    LATCHED,
    LOAD,
    MODEL_CHANGES,
    POSITION,
    RATIO,
    TOOL,
    VELOCITY,
)
from blf_dsc_controller.run import Floats, Regressor, Run

_SHOWN_SINGLY = 8  # estimates that are shown one by one
_POSTURES = 400  # of the reference, at which torques are compared
_MAX_SAMPLES = 100_000  # samples of the estimates, evenly spaced
_BLOCK = 8192
_NO_PARAMETERS = (
    *(*COLUMNS, DISTURBANCE, POSITION, VELOCITY, RATIO, DISTANCE, *LOAD),
    *(LAMBDA_MIN, LATCHED, MODEL_CHANGES, *CONTACT, *TOOL, COMPUTE_TIME),
)


@dataclass(frozen=True)
class Estimates:
    """Estimated model parameters over m samples."""

    names: tuple[str, ...]
    time: Floats  # (m,) s since the first sample of the run
    estimate: Floats  # (m, p)
    # (m, p); None if unknown, or if the plant's parameters have other names
    true: Floats | None
    # (m,) |P^ - P| / |P|, or of torques; None if P is unknown
    relative_error: Floats | None
    # of H P^ and H P along the reference, as the P of a URDF has mixed units
    of_torques: bool


def estimates_of(run: Run) -> Estimates | None:
    """Return the estimates of the model parameters, None if nothing was learned.

    They are compared with the truth by name, and only if the plant has the same
    parameters; those of a URDF arm are compared by their torques.
    """
    if run.monitor is None:
        return None
    names = parameters_in(run.monitor.names)
    truth = run.truth
    arm = run.arm
    of_torques = arm is not None and parameters_in(arm.units) == names
    is_known = truth is not None and set(names) == set(parameters_in(truth.names))
    R = None  # |R (P^ - P)| is the norm of the torques H P^ - H P
    if arm is not None and of_torques and is_known:  # before the memory is full
        R = np.asarray(np.linalg.qr(_torques(run, arm.regressor), 'r'))
    step = -(-run.monitor.stamp.size // _MAX_SAMPLES)
    rows = slice((run.monitor.stamp.size - 1) % step, None, step)
    stamp = run.monitor.stamp[rows]
    estimate = run.monitor.values[rows, run.monitor.indices(names)]
    true = error = None
    if truth is not None and is_known:
        true = truth.held(stamp, names)
        error = _relative_error(estimate, true, R)
    return Estimates(names, run.time_of(stamp), estimate, true, error, of_torques)


def rejected_columns(run: Run) -> list[str]:
    """Return the disturbance columns that are rejected, NaN, at the end."""
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
        off = estimate[some] - P[some]
        size = P[some]
        if R is not None:
            off = off @ R.T
            size = size @ R.T
        # no motion, no torques: unknown
        with np.errstate(over='ignore', invalid='ignore'):
            found[some] = np.linalg.norm(off, axis=1) / np.linalg.norm(size, axis=1)
    return found


def _torques(run: Run, regressor: Regressor) -> Floats:
    """Return H(q, dq, dq, ddq) (k n, p) along the reference, else the motion.

    The derivatives are three-point differences.
    """
    name = 'position' if run.column('reference', 0) is None else 'reference'
    finite = np.isfinite(sum(run.known(name, i) for i in range(len(run.joints))))
    known = 1 + np.flatnonzero(finite[:-2] & finite[1:-1] & finite[2:])
    rows = known[np.linspace(0, known.size - 1, min(_POSTURES, known.size)).astype(int)]
    intervals = np.diff(run.time)[:, np.newaxis]
    before = intervals[rows - 1]
    after = intervals[rows]
    path = getattr(run, name)
    earlier = path[rows - 1]
    q = path[rows]
    later = path[rows + 1]
    forward = (later - q) / after
    backward = (q - earlier) / before
    dq = (after * backward + before * forward) / (after + before)
    ddq = 2.0 * (forward - backward) / (after + before)
    H = regressor(q, dq, dq, ddq)
    return H.reshape(-1, H.shape[-1])


def parameters_in(names: Iterable[str]) -> tuple[str, ...]:
    """Return the names that are parameters of an arm."""
    return tuple(name for name in names if not name.startswith(_NO_PARAMETERS))


def bodies_of(names: Sequence[str]) -> dict[str, list[int]]:
    """Return the indices of the estimates of each link and kind of friction.

    If there are few of them, each estimate is a group of its own.
    """
    if len(names) <= _SHOWN_SINGLY:
        return {name: [k] for k, name in enumerate(names)}
    bodies: dict[str, list[int]] = {}
    for k, name in enumerate(names):
        link = re.search(r'\d+$', name)
        body = f'link {link[0]}' if link and ' ' not in name else name.split(' ')[0]
        bodies.setdefault(body, []).append(k)
    return bodies


def errors_of_bodies(
    bodies: Mapping[str, Sequence[int]],
    estimate: Floats,
    true: Floats | None,
    prior: Floats,
) -> Floats:
    """Return the rms error (b, m) of each body's estimates (m, p) [% of the prior].

    Off the truth or, where none is known, off the first estimates; a rejected estimate
    is NaN. `prior` (p,) are deviations.
    """
    return np.array(
        [
            _rms_of_known(
                estimate[:, body],
                None if true is None else true[:, body],
                prior[body],
            )
            for body in bodies.values()
        ]
    )


def _rms_of_known(estimate: Floats, true: Floats | None, prior: Floats) -> Floats:
    """Return the rms error (m,) of the estimates (m, k) of one body."""
    origin = estimate[:1]
    if true is not None:
        origin = np.where(np.isnan(true), estimate[0], true)
    square = (100.0 * (estimate - origin) / prior) ** 2
    with np.errstate(divide='ignore', invalid='ignore'):  # all rejected: 0 / 0
        mean = np.nansum(square, axis=1) / np.isfinite(square).sum(axis=1)
    rms: Floats = np.sqrt(mean)
    return rms
