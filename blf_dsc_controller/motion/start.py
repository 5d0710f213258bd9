# SPDX-License-Identifier: Apache-2.0
"""The configured reference, and its beginning where the arm is."""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.core.controller import Controller, check_start
from blf_dsc_controller.core.reference import Term, pack, sinusoids_term, unpack
from blf_dsc_controller.errors import OutsideBarrierError
from blf_dsc_controller.motion.limits import Limits
from blf_dsc_controller.motion.polynomials import ending_at_rest, minimum_jerk
from blf_dsc_controller.motion.splice import Motion, Rules, splice, stop


def hold(position: np.ndarray) -> Term:
    """Stay at `position` (n,) [rad]."""
    return ending_at_rest(np.zeros(1), np.zeros((0, len(position), 6)), position)


def reference_of(config: ControllerConfig) -> np.ndarray:
    """Pack the configured reference; `hold` stays at reference.offset until `begin` says where."""
    told = config.reference
    if told.type == 'hold':
        term = hold(np.array(told.offset))
    elif told.type == 'waypoints':
        points = np.reshape(told.points, (len(config.joints), -1)).T
        term = minimum_jerk(np.array(told.times), points)
    else:
        term = sinusoids_term(told.offset, told.amplitude, told.frequency, told.phase)
    return pack(len(config.joints), [term])


def rules_of(config: ControllerConfig) -> Rules:
    """What the configuration demands of an approach or a trajectory."""
    told = config.limits
    limits = Limits(
        config.joints,
        np.array(told.position_lower),
        np.array(told.position_upper),
        np.array(told.velocity),
        np.array(told.acceleration),
    )
    return Rules(limits, config.approach.longest)


def plan(
    config: ControllerConfig,
    bound: np.ndarray,
    q: np.ndarray,
    dq: np.ndarray,
    t: float = 0.0,
) -> Motion:
    """Reference from a measured state to the configured one; none is made inside the bound.

    Args:
        config: of the controller.
        bound: at that time (n,) [rad].
        q: positions (n,) [rad].
        dq: velocities (n,) [rad/s].
        t: time since the start [s].

    Raises:
        OutsideBarrierError: the arm is outside the bound, and approach.enabled is false.
        ReferenceLimitError: the configured reference goes past the limits of the approach.
        ApproachError: no approach keeps within the limits.
    """
    if config.reference.type == 'hold':
        return Motion(pack(q.size, [hold(q)]), t)
    vector = reference_of(config)
    try:
        check_start(config.joints, q, bound, vector, t)
    except OutsideBarrierError:
        if not config.approach.enabled:
            raise
        rules = rules_of(config)
        (main,) = unpack(vector)
        return splice([stop(t, q, dq, rules.limits)], main, t, rules)
    return Motion(vector, t)


def begin(
    controller: Controller,
    config: ControllerConfig,
    q: np.ndarray,
    dq: np.ndarray,
    t: float = 0.0,
) -> float:
    """Give the controller the planned reference; returns when [s] the approach is over, or `t`.

    Arguments and errors as in `plan`.
    """
    motion = plan(config, controller.bound_at(t), q, dq, t)
    controller.reference_vector = motion.vector
    return motion.settled
