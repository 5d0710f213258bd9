# SPDX-License-Identifier: Apache-2.0
"""The errors to expect: those of the sampled loop at small errors.

About a motion that the law follows, learning aside, the law is linear in the errors,
and so is the arm with its inertia M of that posture.  From one sample to the next the
errors of n joints follow x+ = A x + B d with, for each joint,

    x = [q, dq, drive torque, torque of the last sample, q of the last sample, filtered dq,
         alpha2, d^3]

where d [N m] is the torque that the model lacks.  Torques arrive a sample late and pass
the drives, velocities are differences of positions behind a filter; each of both lags
is half of `robot.lag`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.model import inertia_matrices, regressors_at
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.robot import parameters_of
from blf_dsc_controller.law import barrier
from blf_dsc_controller.law.factory import settings_of_config
from blf_dsc_controller.law.state import Settings
from blf_dsc_controller.supervision.reference_load import along

Floats = NDArray[np.float64]

_RESPONSE = 20.0  # time constants of the damping, for which the response is followed
_MOMENTS = 40  # of the reference
# of Coulomb friction: half of it too much at breakaway, with either sign
_REVERSAL = 0.75


def transition(
    settings: Settings, T: float, lag: float, M: Floats, M0: Floats, stiffness: Floats
) -> tuple[Floats, Floats]:
    """Return A (k, 8 n, 8 n), B (k, 8 n, n) for inertias M and M0 (k, n, n).

    T [s] is the sample time, `lag` [s] that of velocity filter and drives together, and
    `stiffness` (n,) [N m/rad] the slope of the barrier.
    """
    n = settings.n
    decay = np.exp(-T / max(0.5 * lag, 1e-9))  # of the drives
    mean = (1.0 - decay) * 0.5 * lag / T  # of the drives' transient over the sample
    rate = settings.K / 2.0 + settings.mu
    g = barrier.filter_gain(settings.time_constant, T)
    # Rows of x, and of what the law computes in terms of x: alpha2', xi2 and the
    # torque.
    q, dq, drive, last, before, speed, alpha2, d3 = np.eye(8 * n).reshape(8, n, 8 * n)
    measured = speed + (1.0 - decay) * ((q - before) / T - speed)
    beta2 = -rate[:, None] * q
    dalpha2 = g * (beta2 - alpha2) / T
    if settings.known_rate == 1:
        dalpha2 = dalpha2 - rate[:, None] * measured
    xi2 = measured - alpha2
    m = settings.joint_inertia
    push_back = (stiffness / m)[:, None] * q
    torque = (
        M0 @ (dalpha2 - settings.damping_rate * xi2 - push_back)
        - settings.Kp[:, None] * xi2
        + d3
    )
    absorbed = M0 @ ((settings.gamma / m)[:, None] * xi2)
    applied = mean * drive + (1.0 - mean) * last  # mean over the sample
    free = np.linalg.inv(M)
    push = free @ applied
    rows = [
        q + T * dq + 0.5 * T**2 * push,
        dq + T * push,
        decay * drive + (1.0 - decay) * last,
        torque,
        q,
        measured,
        alpha2 + T * dalpha2,
        d3 - T * absorbed,
    ]
    A = np.concatenate(np.broadcast_arrays(*rows), axis=1)
    B = np.zeros((*A.shape[:-1], n))
    B[:, :n] = 0.5 * T**2 * free
    B[:, n : 2 * n] = T * free
    return A, B


def _peak_errors(
    config: ControllerConfig, settings: Settings, M: Floats, M0: Floats, torque: Floats
) -> Floats:
    """Return the largest errors (k, n) [rad] after a torque step d (k, n) [N m]."""
    A, B = transition(
        settings, config.sample_time, config.robot.lag, M, M0, settings.weight
    )
    push = (B @ torque[..., None])[..., 0]
    x = np.zeros_like(push)
    largest = np.zeros_like(torque)
    rate = max(settings.damping_rate, 1.0)
    for _ in range(round(_RESPONSE / rate / config.sample_time)):
        x = (A @ x[..., None])[..., 0] + push
        largest = np.maximum(largest, np.abs(x[:, : settings.n]))
    return largest


class ExpectedErrors(NamedTuple):
    """Largest errors (n,) [rad] along the reference, before anything is learned."""

    unmodelled: Floats  # of learning.residual_floor and friction at a reversal
    pick_up: Floats  # when robot.payload is picked up in motion


def expected_errors(config: ControllerConfig, settings: Settings) -> ExpectedErrors:
    """Return the expected errors of an arm from a URDF, by the linear loop."""
    model, robot = settings.model, config.robot
    chain = robot.chain(config.joints)
    if config.reference.type == 'hold':  # at rest anywhere
        limits = config.limits.position_lower, config.limits.position_upper
        q = np.random.default_rng(0).uniform(*limits, (_MOMENTS, len(config.joints)))
        dq = ddq = np.zeros_like(q)
    else:
        q, dq, ddq = along(config, _MOMENTS)
    P0 = settings.initial_estimate[: settings.p]
    load = robot.payload * parameters_of(robot, chain).load
    M0, M = (inertia_matrices(model, P, q) for P in (P0, P0 + load))
    floor = np.array(config.learning.residual_floor)
    floor += _REVERSAL * np.array(robot.friction(chain)['coulomb'])
    unmodelled = _peak_errors(config, settings, M0, M0, np.broadcast_to(floor, q.shape))
    pick_up = _peak_errors(
        config, settings, M, M0, regressors_at(model, q, dq, dq, ddq) @ load
    )
    return ExpectedErrors(unmodelled.max(axis=0), pick_up.max(axis=0))


def expectation(config: ControllerConfig) -> str:
    """Return the largest errors to expect of an arm of a URDF, in a sentence."""
    errors = expected_errors(config, settings_of_config(config))
    usual, most = (1e3 * float(each.max()) for each in errors)
    joint = config.joints[int(errors.pick_up.argmax())]
    return (
        f'{usual:.2g} mrad by friction and unmodelled torque; {most:.2g} mrad of {joint} when '
        f'{config.robot.payload:g} kg are picked up in motion'
    )
