# SPDX-License-Identifier: Apache-2.0
"""Limits of the envelope of an arm, from its configuration and the model of its law."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.model import inertia_matrices, regressors_at
from blf_dsc_controller.arms.tuning import loop_delay
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.law.state import Settings
from blf_dsc_controller.supervision.envelope import Body, Envelope, Limits

Array = NDArray[np.float64]

_POSTURES = 20
_STEP_ROUNDED = 1.0 + 1e-9  # the law computes its own steps with what the drives add
_BRAKED_SPEED = 0.9  # of the velocity limit: braked from below it
_LOOP_DELAYS = 4.0  # of the loop, in T_v
_APPROACH = 2.0  # T_v, in T_q
_REACH_TIME = 0.06  # s, at the velocity limit, of the largest error without a barrier
_MIN_AVAILABLE = 0.2  # of the torque limit, at least, besides gravity ...
_USED_TORQUE = 0.5  # ... and of what is left, to stop at the end of the range


def envelope_of(config: ControllerConfig, settings: Settings) -> Envelope:
    """Return the envelope of an arm, by its configuration and the `settings` of its law."""
    return Envelope(*limits_of(config, settings))


def limits_of(config: ControllerConfig, settings: Settings) -> tuple[Limits, Body]:
    """Return the limits of an arm, and the model that they rest on.

    The range ends where motions may, and as far beyond as an error may be.  `k_position` and
    `k_velocity` of a URDF make the joint slower; faster than the delay of the loop allows it
    is not.
    """
    model, P = settings.model, settings.initial_estimate[: settings.p]
    lower, upper = np.array(
        (config.limits.position_lower, config.limits.position_upper)
    )
    turns = np.array(
        [kind == 'continuous' for kind in config.robot.kinds(config.joints)]
    )
    q = np.random.default_rng(0).uniform(lower, upper, (_POSTURES, settings.n))
    M = inertia_matrices(model, P, q)
    diagonal = np.diagonal(M, axis1=1, axis2=2)
    is_known = bool(np.isfinite(M).all() and (diagonal > 0.0).all())
    inertia = diagonal.max(axis=0) if is_known else np.ones(settings.n)
    rest = np.zeros_like(q)
    gravity = np.abs((regressors_at(model, q, rest, rest, rest) * P).sum(axis=-1))
    torque, rate = np.array((config.torque.limit, config.torque.rate_limit))
    rate = np.where(rate > 0.0, rate, np.inf)
    available = np.maximum(torque - gravity.max(axis=0), _MIN_AVAILABLE * torque)
    delay = _LOOP_DELAYS * loop_delay(config.sample_time, config.robot.lag)
    k_position, k_velocity = _soft_limits(config)
    braking_time = np.maximum(delay, inertia / k_velocity)
    reserve = np.where(turns, np.inf, config.barrier.bound)
    any_error = settings.has_barrier == 1 or config.safety.error_ratio == 0.0
    error = (
        config.safety.error_ratio * _REACH_TIME * np.array(config.safety.velocity_limit)
    )
    limits = Limits(
        torque=torque,
        step=_STEP_ROUNDED * rate * config.sample_time,
        velocity=_BRAKED_SPEED * np.array(config.safety.velocity_limit),
        ends=np.array((lower - reserve, upper + reserve)),
        error=np.full(settings.n, np.inf) if any_error else error,
        braking_time=braking_time,
        approach_time=np.maximum(_APPROACH * braking_time, 1.0 / k_position),
        deceleration=_USED_TORQUE * available / inertia,
        jerk=rate / inertia,
    )
    return limits, Body(model, P, is_known and settings.has_barrier != 1)


def _soft_limits(config: ControllerConfig) -> Array:
    """Return k_position [1/s] and k_velocity [N m s/rad] (2, n); infinite: not given."""
    if config.model != 'urdf':
        return np.full((2, len(config.joints)), np.inf)
    joints = config.robot.chain(config.joints).joints
    soft: Array = np.array([joint.soft_limits for joint in joints]).T
    return soft
