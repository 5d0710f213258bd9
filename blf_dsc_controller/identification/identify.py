# SPDX-License-Identifier: Apache-2.0
"""Inertias, rotors and friction identified from a recording, with the URDF as the prior.

The maximum a posteriori estimate of all unknowns over physical bodies, from the prior of `prior_of`
and the first four fifths of the windows in which the arm moves, each joint weighted by the inverse
of its residual variance.  Optional terms are chosen one by one, as long as each reduces the error
of five-fold cross-validation.  The covariance allows for residuals that are correlated,
H^-1 (I + sum_i l_i A_i^T A_i) H^-1 with H = I + sum_i A_i^T A_i and the correlation lengths l_i of
the joints (Liang and Zeger, Longitudinal data analysis using generalized linear models, 1986), and
ignores the bounds, which can only reduce it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.base_parameters import BaseParameters, base_parameters
from blf_dsc_controller.arms.serial_chain import ROTOR
from blf_dsc_controller.arms.urdf import Chain
from blf_dsc_controller.bags.content import NO_NAMES, NameMap
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.identification.prior import (
    Parts,
    Prior,
    base_matrix,
    parts,
    prior_of,
    solve,
)
from blf_dsc_controller.identification.recording import (
    HOP,
    LOAD,
    WINDOW,
    Recording,
    Rows,
    joined,
    read_recording,
    rows_of,
)
from blf_dsc_controller.run import Floats

Effort = Literal['torque', 'without-gravity', 'command']
"""What efforts are."""

_SHORTEST = 5.0  # s
_HELD_BACK = 0.2  # fraction of the moving windows, at the end
_STILL = 0.02  # rad/s or m/s
_MOVING = 0.02  # least weight of a joint that moves: that of _STILL
_PASSES = 6
_PER_STEP = 10  # windows from one time to the next at which a load may be picked up
_FAINT = 0.1  # of the torque, least gravity that can be checked
_FOLDS = 5
_WORTH = 0.01  # of the squared error of cross-validation, least reduction by a term that is kept


class Identified(NamedTuple):
    """An identified arm of n bodies; values are ordered as in `Prior`."""

    source: str  # topic of the torques
    duration: float  # s
    chain: Chain
    parameters: BaseParameters
    prior: Floats  # (17 n + 14,)
    values: Floats  # (17 n + 14,)
    prior_covariance: Floats  # (17 n + 14, 17 n + 14)
    covariance: Floats  # likewise, given the recording
    dynamics: Floats  # (2, n) damping and friction of the corrected URDF, which has no more terms
    errors: Floats  # (3, n) rms torque error of the URDF, the corrected URDF, all values
    torque: Floats  # (n,) root mean square of the torque held back, N m or N
    still: tuple[str, ...]  # joints that did not move
    lasting: Floats  # (n,) correlation length of the residual, s
    held_back: tuple[float, float]  # s, from, to
    rest: float  # s in which no joint moves, which were left out
    gravity: float  # share of the URDF's gravity in the torques; NaN if it would hardly show
    picked_up: float | None  # s, when the load was picked up
    predicted: Floats  # (3, R, n) torque in windows by the URDF, the corrected URDF, all values
    measured: Floats  # (R, n) likewise
    time: Floats  # (R,) of the windows, s

    @property
    def parts(self) -> Parts:
        """Parts of the values."""
        return parts(self.values)

    @property
    def load(self) -> tuple[Floats, Floats]:
        """Mass [kg] and centre (x, y, z) [m] in the tip of the load, and their deviations."""
        at = parts(np.arange(self.values.size)).load[:4]
        C = self.covariance[np.ix_(at, at)]
        return mass_and_centre(self.values[at], C, self.chain.tip_placement)


def mass_and_centre(values: Floats, covariance: Floats, T: Floats) -> tuple[Floats, Floats]:
    """Return mass [kg] and centre (x, y, z) [m] in the frame T, and their deviations.

    `values` are mass and first moments (4,) [kg, kg m].
    """
    R, shift = T[:3, :3], T[:3, 3]
    m, *h = values
    centre = np.array(h) / m
    # c = R^T (h / m - shift):  dc = R^T (dh - (h / m) dm) / m
    J = np.eye(4)
    J[1:] = R.T @ np.column_stack((-centre, np.eye(3))) / m
    return np.append(m, R.T @ (centre - shift)), np.sqrt(np.diag(J @ covariance @ J.T))


def identify_bag(
    path: Path,
    robot: Robot,
    namespace: str = '',
    names: NameMap = NO_NAMES,
    effort: Effort = 'torque',
    gains: Sequence[float] = (),
    loaded: Path | None = None,
    *,
    pick_up: bool = False,
) -> Identified:
    """Identify the arm of a bag from its URDF; path, namespace and names as for `read_run`.

    `effort` says what the efforts are: the whole torque, the torque without that of gravity, or the
    commanded torque instead of them; `gains` [N m/A] turn currents into torques.  A load is
    identified if there is a bag in which the arm is `loaded`, or if it does `pick_up` one.

    Raises:
        BlfDscError: the bag or the URDF cannot be read, or the bag has no torques of the arm, is
            too short, or contains no motion.
    """
    joints = robot.chain(()).joints if robot.tip else ()
    given = [joint.name for joint in joints]
    recording = read_recording(path, robot.text, given, namespace, names, effort == 'command')
    picked_up = float('nan') if pick_up else None
    if loaded is not None:
        given = list(recording.joints)
        other = read_recording(loaded, robot.text, given, namespace, names, effort == 'command')
        recording, picked_up = joined(recording, other)
    if len(gains):
        if len(gains) != len(recording.joints):
            found = f'{len(recording.joints)} joints: {", ".join(recording.joints)}'
            raise BlfDscError(f'got {len(gains)} gains for {found}')
        recording = recording._replace(torque=recording.torque * np.array(gains))
    return identify_arm(recording, robot, effort, picked_up)


def identify_arm(
    recording: Recording, robot: Robot, effort: Effort = 'torque', picked_up: float | None = None
) -> Identified:
    """Identify the arm of a recording, and the load picked up at that time [s]; NaN: find it.

    Raises:
        BlfDscError: the recording is too short or has no motion.
    """
    chain = robot.chain(recording.joints)
    n = len(chain.joints)
    parameters = base_parameters(chain, robot.gravity)
    duration = recording.q.shape[0] * recording.period
    if duration < _SHORTEST:
        raise BlfDscError(f'the bag holds {duration:.3g} s; record at least {_SHORTEST:g} s')
    rows = rows_of(recording, parameters.model)
    moving, fit, test = windows_of(rows, n)
    P = parameters.of(chain.inertias, robot.rotors(chain))
    if effort == 'without-gravity':
        rows = rows._replace(torque=recording.torque + rows.gravity_torque(P))
    largest = np.maximum(np.abs(rows.torque).max(axis=0), 1e-6)
    speed = np.maximum(rows.speed, _STILL)
    full = prior_of(robot, chain, largest, speed, load=picked_up is not None)
    G = base_matrix(parameters, n)
    if picked_up is not None:
        K = parameters.K[:, -(ROTOR + 1) : -1]
        loaded = rows.X[:, :, : parameters.model.p] @ K
        rows.X[:, :, -LOAD:] = loaded
        if np.isnan(picked_up):
            picked_up = _pick_up(rows, fit, G, full)
        rows.X[rows.time < picked_up, :, -LOAD:] = 0.0
    prior = full.only(_worthwhile(regression(rows, fit, G, full), full))
    found = regression(rows, fit, G, prior)
    z_best = solve(found.A, found.b, prior.cones, prior.start)
    values = prior.mean + prior.D @ z_best
    rows.set_load((G @ values)[: parameters.model.p])
    H = np.linalg.inv(found.A.T @ found.A + np.eye(z_best.size))
    covariance = prior.D @ H @ (np.eye(z_best.size) + found.scatter) @ H @ prior.D.T
    measured = rows.u(values[-1])[moving]
    dynamics = _dynamics(rows, fit, values, n)
    urdf, corrected = np.zeros((2, values.size))
    for each, source in ((urdf, parts(prior.mean)), (corrected, parts(values))):
        of = parts(each)
        of.bodies[:], of.load[:] = source.bodies, source.load
        of.terms[1:3] = source.terms[1:3] if each is urdf else dynamics
    predicted = np.array([rows.X[moving] @ (G @ v)[:-1] for v in (urdf, corrected, values)])
    shown = np.isin(moving, test)
    errors, u = predicted[:, shown] - measured[shown], measured[shown]
    return Identified(
        source=recording.source,
        duration=duration,
        chain=chain,
        parameters=parameters,
        prior=prior.mean,
        values=values,
        prior_covariance=full.D @ full.D.T,
        covariance=covariance,
        dynamics=dynamics,
        errors=np.sqrt(np.mean(np.square(errors), axis=1)),
        torque=np.sqrt(np.mean(u**2, axis=0)),
        still=tuple(
            joint for joint, v in zip(recording.joints, rows.speed, strict=True) if v < _STILL
        ),
        lasting=found.lasting,
        held_back=(float(rows.time[test][0]), float(rows.time[test][-1])),
        rest=(rows.time.size - moving.size) * HOP,
        gravity=_gravity_share(rows, fit, P),
        picked_up=picked_up,
        predicted=predicted,
        measured=measured,
        time=rows.time[moving],
    )


def windows_of(rows: Rows, n: int) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Return the windows in which the arm moves: all, those to fit, and those held back.

    Raises:
        BlfDscError: there are too few.
    """
    if rows.time.size < 10 * n:
        raise BlfDscError(f'only {rows.time.size} windows have no gaps: record without losses')
    if rows.speed.max() < _STILL:
        fastest = f'{rows.speed.max():.2g} rad/s (or m/s)'
        raise BlfDscError(f'no joint moves faster than {fastest}: record a motion of all joints')
    moving = np.flatnonzero(rows.weight.max(axis=1) > _MOVING)
    if moving.size < 10 * n:
        raise BlfDscError(
            f'the arm moves in {moving.size} of {rows.time.size} windows: record at least '
            f'{10 * n * HOP:.3g} s of motion'
        )
    until = rows.time[moving[round((1.0 - _HELD_BACK) * moving.size)]]
    fit = moving[rows.time[moving] < until - 0.5 * WINDOW]
    test = moving[rows.time[moving] > until + 0.5 * WINDOW]
    return moving, fit, test


class Regression(NamedTuple):
    """The problem |A z - b|^2 + |z|^2 of k unknowns z, normalised by deviations of the joints."""

    A: Floats  # (., k)
    b: Floats  # (.,)
    folds: Floats  # (parts, k + 1, k + 1) [A | b]^T [A | b] of successive windows
    scatter: Floats  # (k, k) covariance of A^T b
    lasting: Floats  # (n,) correlation length of each joint's residual, s


def regression(
    rows: Rows, fit: NDArray[np.intp], G: Floats, prior: Prior, parts: int = _FOLDS
) -> Regression:
    """Return the problem of the prior's z, with deviations and gravity of its own solution.

    The delay is linearised about its last estimate.
    """
    n, p = rows.torque.shape[1], rows.gravity.shape[2]
    B, theta = G @ prior.D, G @ prior.mean
    mean = theta
    weight = rows.weight[fit][:, :, None]
    deviation = np.sqrt(np.mean(rows.u(0.0)[fit] ** 2, axis=0)) * 0.1
    floor = 1e-3 * deviation + 1e-12
    counted = np.maximum(np.sum(weight[:, :, 0] ** 2, axis=0) - theta.size / n, 1.0)
    for _ in range(_PASSES):
        rows.set_load(theta[:p])
        delay = float(theta[-1])
        rate = rows.rate(delay)[fit][:, :, None]
        y = rows.u(delay)[fit][:, :, None] - delay * rate
        full = weight * np.concatenate((rows.X[fit], -rate, y), axis=2)
        scaled = full / deviation[:, None]
        R = np.asarray(np.linalg.qr(scaled.reshape(-1, theta.size + 1), mode='r'))
        A, b = R[:, :-1] @ B, R[:, -1] - R[:, :-1] @ mean
        theta = mean + B @ np.linalg.solve(A.T @ A + np.eye(A.shape[1]), A.T @ b)
        left = full[:, :, :-1] @ theta - full[:, :, -1]
        deviation = np.maximum(np.sqrt(np.sum(left**2, axis=0) / counted), floor)
    scatter = np.zeros((A.shape[1], A.shape[1]))
    lengths = np.array([correlation_length(left[:, i]) for i in range(n)])
    for i in range(n):
        a = scaled[:, i, :-1] @ B
        scatter += lengths[i] * a.T @ a
    folds = []
    for part in np.array_split(scaled, parts):
        all_rows = part.reshape(-1, theta.size + 1)
        Ab = np.column_stack((all_rows[:, :-1] @ B, all_rows[:, -1] - all_rows[:, :-1] @ mean))
        folds.append(Ab.T @ Ab)
    return Regression(A, b, np.array(folds), scatter, lengths * HOP)


def _worthwhile(found: Regression, prior: Prior) -> list[tuple[int, ...]]:
    """Return the optional entries of z that predict the folds better, each fold by the others.

    Entries that cannot be negative must be positive in all of them.
    """
    kept: list[tuple[int, ...]] = []
    optional = prior.optional
    positive = np.zeros(prior.mean.size, dtype=bool)
    positive[[cone.at for cone in prior.cones if cone.at in sum(optional, ())]] = True
    always = np.ones(prior.mean.size, dtype=bool)
    for entry in optional:
        always[list(entry)] = False
    rest = found.folds.sum(axis=0) - found.folds

    def error(entries: list[tuple[int, ...]]) -> float:
        used = always.copy()
        used[[k for entry in entries for k in entry]] = True
        at = np.append(used, False)
        total = 0.0
        for own, others in zip(found.folds, rest, strict=True):
            A = others[np.ix_(at, at)] + np.eye(int(used.sum()))
            z = np.append(np.linalg.solve(A, others[at, -1]), -1.0)
            if (z[:-1][positive[used]] <= 0.0).any():
                return np.inf
            at_b = np.append(used, True)
            total += float(z @ own[np.ix_(at_b, at_b)] @ z)
        return total

    least = error(kept)
    while True:
        errors = {entry: error([*kept, entry]) for entry in optional if entry not in kept}
        best = min(errors, key=lambda entry: errors[entry], default=None)
        if best is None or errors[best] > (1.0 - _WORTH) * least:
            return kept
        kept.append(best)
        least = errors[best]


def _pick_up(rows: Rows, fit: NDArray[np.intp], G: Floats, prior: Prior) -> float:
    """Return the time [s] from which a load explains the torques best."""
    found = regression(rows, fit, G, prior, len(fit) // _PER_STEP)
    load = parts(np.arange(prior.mean.size)).load
    without = found.folds.copy()
    without[:, load] = without[:, :, load] = 0.0
    costs = []
    for k in range(len(found.folds)):
        Q = without[:k].sum(axis=0) + found.folds[k:].sum(axis=0)
        b = Q[:-1, -1]
        costs.append(Q[-1, -1] - b @ np.linalg.solve(Q[:-1, :-1] + np.eye(b.size), b))
    first = np.array_split(fit, len(found.folds))[int(np.argmin(costs))][0]
    return float(rows.time[first])


def _gravity_share(rows: Rows, fit: NDArray[np.intp], P: Floats) -> float:
    """Return the factor of the gravity of P that explains the torques best; NaN if it is small."""
    n, p = rows.torque.shape[1], P.size
    u = rows.u(0.0)[fit]
    size = np.maximum(np.sqrt(np.mean(u**2, axis=0)), 1e-6)
    weight = rows.weight[fit] / size
    gravity = rows.over_windows(rows.gravity_torque(P), rows.g)[fit]
    rest = rows.X[fit][:, :, :p] @ P - gravity
    if np.sqrt(np.mean((gravity / size) ** 2)) < _FAINT:
        return float('nan')
    friction = rows.X[fit][:, :, [*range(p, p + 2 * n), *range(p + 3 * n, p + 4 * n)]]
    columns = np.concatenate((gravity[:, :, None], rest[:, :, None], friction), axis=2)
    columns = (columns * weight[:, :, None]).reshape(-1, 2 + 3 * n)
    return float(np.linalg.lstsq(columns, (u * weight).ravel(), rcond=None)[0][0])


def _dynamics(rows: Rows, fit: NDArray[np.intp], values: Floats, n: int) -> Floats:
    """Return the viscous and Coulomb friction (2, n) nearest to that of all terms."""
    p = rows.gravity.shape[2]
    terms = parts(values).terms[1:].copy()
    terms[3] = 0.0  # the offset
    both = np.append(terms, parts(values).coupling)
    friction = rows.X[fit][:, :, p:-LOAD] @ both * rows.weight[fit]
    found = []
    for i in range(n):
        columns = rows.X[fit][:, i, [p + i, p + n + i]] * rows.weight[fit][:, i, None]
        found.append(np.linalg.lstsq(columns, friction[:, i], rcond=None)[0])
    return np.asarray(np.maximum(np.transpose(found), 0.0))


def correlation_length(left: Floats) -> float:
    """Return 1 + 2 sum of the autocorrelation of (N,) up to its first zero, in samples."""
    size = 2 ** int(np.ceil(np.log2(2 * left.size)))
    correlation = np.fft.irfft(np.abs(np.fft.rfft(left, size)) ** 2)[: left.size]
    if correlation[0] <= 0.0:
        return 1.0
    negative = np.flatnonzero(correlation <= 0.0)
    end = int(negative[0]) if negative.size else correlation.size
    return float(1.0 + 2.0 * correlation[1:end].sum() / correlation[0])
