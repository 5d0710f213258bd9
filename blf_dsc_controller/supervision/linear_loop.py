# SPDX-License-Identifier: Apache-2.0
"""What the reference needs of the arm, and the errors to expect of the sampled loop.

About a motion that the law follows, learning aside, the law is linear in the errors, and so is the
arm with its inertia M of that posture.  From one sample to the next the errors of n joints follow
x+ = A x + B d with, for each joint,

    x = [q, dq, drive torque, torque of the last sample, q of the last sample, filtered dq,
         alpha2, d^3]

where d [N m] is the torque that the model lacks.  Torques arrive a sample late and pass the drives,
velocities are differences of positions behind a filter; each of both lags is half of `robot.lag`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.model import free_inertias, inertia_matrices, regressors_at
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.robot import parameters_of
from blf_dsc_controller.law.barrier import filter_gain
from blf_dsc_controller.law.settings import Settings
from blf_dsc_controller.reference.approach import reference_of
from blf_dsc_controller.reference.terms import sampled

Floats = NDArray[np.float64]

_POINTS = 400  # along the reference
_LONGEST = 120.0  # s of the reference


class ReferenceLoad(NamedTuple):
    """Torque, inertia and excitation along the reference."""

    torque: Floats  # largest magnitude (n,), N m
    inertia: Floats  # M, where positive definite (k, n, n), kg m^2
    excitation: Floats  # mean of H^T H (p, p)

    def rate(self, settings: Settings) -> float:
        """Return the largest eigenvalue of M^-1 K_p + omega_v, 1/s."""
        Kp = np.diag(settings.Kp)[np.newaxis]  # numpy 1 reads a lone matrix as vectors
        roots = np.linalg.eigvals(np.linalg.solve(self.inertia, Kp))
        return float(np.abs(roots).max(initial=0.0)) + settings.damping_rate

    @property
    def free_inertia(self) -> Floats:
        """Smallest inertia (n,) of each joint with the others free, kg m^2."""
        least: Floats = free_inertias(self.inertia).min(axis=0, initial=np.inf)
        return least

    def damping(self, settings: Settings) -> Floats:
        """Return the smallest damping (n,) of each joint with the others free, N m s/rad."""
        rate = settings.damping_rate
        damped = rate * self.free_inertia if rate > 0.0 else 0.0
        return settings.Kp + damped


def reference_load(config: ControllerConfig, settings: Settings) -> ReferenceLoad:
    """Evaluate the dynamics along the reference, over its slowest period."""
    model, P = settings.model, settings.initial_estimate[: settings.p]
    q, dq, ddq = _along(config, _POINTS)
    H = regressors_at(model, q, dq, dq, ddq)
    M = inertia_matrices(model, P, q)
    return ReferenceLoad(
        torque=np.abs(H @ P).max(axis=0),
        inertia=M[np.linalg.eigvalsh(M)[:, 0] > 0.0],
        excitation=np.einsum('kni,knj->ij', H, H) / _POINTS,
    )


def _along(config: ControllerConfig, count: int) -> Floats:
    """Return q, dq, ddq (3, k, n) over the whole reference, at most `_LONGEST`."""
    frequencies = [w for w in config.reference.frequency if w > 0.0]
    end = 2.0 * np.pi / min(frequencies, default=1.0)
    if config.reference.type == 'waypoints':
        end = max(config.reference.times)
    times = np.linspace(0.0, min(end, _LONGEST), count, endpoint=False)
    return np.moveaxis(sampled(reference_of(config), times), 1, 0)


# The sampled loop at small errors.

_RESPONSE = 20.0  # time constants of the damping, for which the response is followed
_MOMENTS = 40  # of the reference
_REVERSAL = 0.75  # of Coulomb friction: half of it too much at breakaway, with either sign


def transition(
    settings: Settings, T: float, lag: float, M: Floats, M0: Floats, stiffness: Floats
) -> tuple[Floats, Floats]:
    """Return A (k, 8 n, 8 n) and B (k, 8 n, n) for the inertias M and M0 of the model (k, n, n).

    T [s] is the sample time, `lag` [s] that of velocity filter and drives together, and
    `stiffness` (n,) [N m/rad] the slope of the barrier.
    """
    n = settings.n
    decay = np.exp(-T / max(0.5 * lag, 1e-9))  # of the drives
    mean = (1.0 - decay) * 0.5 * lag / T  # of the drives' transient over the sample
    rate = settings.K / 2.0 + settings.mu
    g = filter_gain(settings.time_constant, T)
    # Rows of x, and of what the law computes in terms of x: alpha2', xi2 and the torque.
    q, dq, drive, last, before, speed, alpha2, d3 = np.eye(8 * n).reshape(8, n, 8 * n)
    measured = speed + (1.0 - decay) * ((q - before) / T - speed)
    beta2 = -rate[:, None] * q
    dalpha2 = g * (beta2 - alpha2) / T
    xi2 = measured - alpha2
    torque = (
        M0 @ (dalpha2 - settings.damping_rate * xi2)
        - settings.Kp[:, None] * xi2
        - stiffness[:, None] * q
        + d3
    )
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
        d3 - T * settings.gamma[:, None] * xi2,
    ]
    A = np.concatenate(np.broadcast_arrays(*rows), axis=1)
    B = np.zeros((*A.shape[:-1], n))
    B[:, :n], B[:, n : 2 * n] = 0.5 * T**2 * free, T * free
    return A, B


def _peak_errors(
    config: ControllerConfig, settings: Settings, M: Floats, M0: Floats, torque: Floats
) -> Floats:
    """Return the largest errors (k, n) [rad] after a step of the torque d (k, n) [N m]."""
    A, B = transition(settings, config.sample_time, config.robot.lag, M, M0, settings.weight)
    push = (B @ torque[..., None])[..., 0]
    x, largest = np.zeros_like(push), np.zeros_like(torque)
    rate = max(settings.damping_rate, 1.0)
    for _ in range(round(_RESPONSE / rate / config.sample_time)):
        x = (A @ x[..., None])[..., 0] + push
        largest = np.maximum(largest, np.abs(x[:, : settings.n]))
    return largest


class ExpectedErrors(NamedTuple):
    """Largest errors (n,) [rad] along the reference, before anything is learned of their cause."""

    unmodelled: Floats  # of learning.residual_floor and friction at a reversal
    pick_up: Floats  # when robot.payload is picked up in motion


def expected_errors(config: ControllerConfig, settings: Settings) -> ExpectedErrors:
    """Return the errors to expect from an arm of a URDF, by the linear loop without the barrier."""
    model, robot = settings.model, config.robot
    chain = robot.chain(config.joints)
    if config.reference.type == 'hold':  # at rest anywhere
        limits = config.limits.position_lower, config.limits.position_upper
        q = np.random.default_rng(0).uniform(*limits, (_MOMENTS, len(config.joints)))
        dq = ddq = np.zeros_like(q)
    else:
        q, dq, ddq = _along(config, _MOMENTS)
    P0 = settings.initial_estimate[: settings.p]
    load = robot.payload * parameters_of(robot, chain).load
    M0, M = (inertia_matrices(model, P, q) for P in (P0, P0 + load))
    floor = np.array(config.learning.residual_floor)
    floor += _REVERSAL * np.array(robot.friction(chain)['coulomb'])
    unmodelled = _peak_errors(config, settings, M0, M0, np.broadcast_to(floor, q.shape))
    pick_up = _peak_errors(config, settings, M, M0, regressors_at(model, q, dq, dq, ddq) @ load)
    return ExpectedErrors(unmodelled.max(axis=0), pick_up.max(axis=0))
