# SPDX-License-Identifier: Apache-2.0
"""Inertias, rotors and friction identified from a recording, with the URDF as the prior.

The maximum a posteriori estimate of all unknowns over physical bodies, from the prior of `prior_of`
and the first four fifths of the rows, each joint weighted by the inverse of its residual variance
times correlation length.  The covariance ignores the bounds, which can only reduce it.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.arms.base_parameters import BaseParameters, base_parameters
from blf_dsc_controller.arms.urdf import Chain, attached
from blf_dsc_controller.bags.content import NO_NAMES, NameMap
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.identification.physical import solve
from blf_dsc_controller.identification.prior import JOINT_TERMS, columns_of, prior_of
from blf_dsc_controller.identification.recording import Recording, read_recording
from blf_dsc_controller.identification.rows import WINDOW, Rows, rows_of
from blf_dsc_controller.replay.learn import correlation_length
from blf_dsc_controller.run import Floats

_SHORTEST = 5.0  # s
_HELD_BACK = 0.2  # fraction of the rows, at the end
_STILL = 0.02  # rad/s or m/s
_PASSES = 6


class Identified(NamedTuple):
    """An identified arm of n bodies; values are ordered as in `Prior`."""

    source: str  # topic of the torques
    duration: float  # s
    chain: Chain
    parameters: BaseParameters
    prior: Floats  # (14 n + 1,)
    values: Floats  # (14 n + 1,)
    prior_covariance: Floats  # (14 n + 1, 14 n + 1)
    covariance: Floats  # likewise, given the recording
    errors: Floats  # (3, n) rms torque error of the URDF, the corrected URDF, all values
    torque: Floats  # (n,) root mean square of the torque held back, N m or N
    still: tuple[str, ...]  # joints that did not move
    held_back: tuple[float, float]  # s, from, to

    @property
    def inertias(self) -> Floats:
        """Inertial parameters of the bodies (n, 10)."""
        n = len(self.chain.joints)
        return self.values[: 10 * n].reshape(n, 10)

    @property
    def joint_terms(self) -> Floats:
        """Values (4, n) of JOINT_TERMS."""
        return self.values[10 * len(self.chain.joints) : -1].reshape(len(JOINT_TERMS), -1)


def identify_bag(
    path: Path, robot: Robot, namespace: str = '', names: NameMap = NO_NAMES
) -> Identified:
    """Identify the arm of a bag from its URDF; path, namespace and names as for `what_if`.

    Raises:
        BlfDscError: the bag or the URDF cannot be read, or the bag has no torques of the arm, is
            too short, or contains no motion.
    """
    joints = robot.chain(()).joints if robot.tip else ()
    given = [joint.name for joint in joints]
    return identify_arm(read_recording(path, robot.text, given, namespace, names), robot)


def identify_arm(recording: Recording, robot: Robot) -> Identified:
    """Identify the arm of a recording; raises BlfDscError if it is too short or has no motion."""
    chain = robot.chain(recording.joints)
    n = len(chain.joints)
    x, y, z = robot.gravity
    parameters = base_parameters(chain, (x, y, z))
    duration = recording.q.shape[0] * recording.period
    if duration < _SHORTEST:
        raise BlfDscError(f'the bag holds {duration:.3g} s; record at least {_SHORTEST:g} s')
    rows = rows_of(recording, parameters.model)
    if rows.time.size < 10 * n:
        raise BlfDscError(f'only {rows.time.size} windows have no gaps: record without losses')
    if rows.speed.max() < _STILL:
        fastest = f'{rows.speed.max():.2g} rad/s (or m/s)'
        raise BlfDscError(f'no joint moves faster than {fastest}: record a motion of all joints')
    held = [attached(robot.text, joint.link, recording.joints)[1] for joint in chain.joints]
    largest = np.maximum(np.abs(recording.torque).max(axis=0), 1e-6)
    prior = prior_of(robot, chain, held, largest, np.maximum(rows.speed, _STILL))
    G = columns_of(parameters, n)
    until = (1.0 - _HELD_BACK) * duration
    fit, test = rows.time < until - 0.5 * WINDOW, rows.time > until + 0.5 * WINDOW
    A, b = _whitened(rows, fit, G @ prior.D, G @ prior.mean)
    values = prior.mean + prior.D @ solve(A, b, prior.cones, prior.start)
    covariance = prior.D @ np.linalg.inv(A.T @ A + np.eye(A.shape[1])) @ prior.D.T
    u = rows.u(values[-1])[test]
    in_urdf = np.ones(values.size)
    in_urdf[10 * n : 11 * n] = in_urdf[13 * n :] = 0.0
    models = in_urdf * prior.mean, in_urdf * values, values
    errors = [rows.X[test] @ (G @ v)[:-1] - u for v in models]
    return Identified(
        source=recording.source,
        duration=duration,
        chain=chain,
        parameters=parameters,
        prior=prior.mean,
        values=values,
        prior_covariance=prior.D @ prior.D.T,
        covariance=covariance,
        errors=np.sqrt(np.mean(np.square(errors), axis=1)),
        torque=np.sqrt(np.mean(u**2, axis=0)),
        still=tuple(
            joint for joint, v in zip(recording.joints, rows.speed, strict=True) if v < _STILL
        ),
        held_back=(float(rows.time[test][0]), float(rows.time[test][-1])),
    )


def _whitened(rows: Rows, fit: Floats, B: Floats, theta0: Floats) -> tuple[Floats, Floats]:
    """Return A, b so that |A z - b|^2 sums the normalised squared residuals of theta0 + B z.

    The delay is linearised about its last estimate; variances are those of the residuals.
    """
    X, weight = rows.X[fit], rows.weight[fit][:, :, None]
    count, n, m = (int(size) for size in X.shape)
    deviation = np.sqrt(np.mean(rows.u(0.0)[fit] ** 2, axis=0)) * 0.1
    floor = 1e-3 * deviation + 1e-12
    delay = 0.0
    for _ in range(_PASSES):
        rate = rows.rate(delay)[fit][:, :, None]
        y = rows.u(delay)[fit][:, :, None] - delay * rate
        full = weight * np.concatenate((X, -rate, y), axis=2)
        scaled = (full / deviation[:, None]).reshape(count * n, m + 2)
        R = np.asarray(np.linalg.qr(scaled, mode='r'))
        A, b = R[:, :-1] @ B, R[:, -1] - R[:, :-1] @ theta0
        z = np.linalg.solve(A.T @ A + np.eye(A.shape[1]), A.T @ b)
        theta = theta0 + B @ z
        left = full[:, :, :-1] @ theta - full[:, :, -1]
        for i in range(n):
            counted = max(float(np.sum(weight[:, i] ** 2)) - (m + 1) / n, 1.0)
            length = correlation_length(left[:, i : i + 1])
            deviation[i] = max(np.sqrt(np.sum(left[:, i] ** 2) / counted * length), floor[i])
        delay = float(theta[-1])
    return A, b
