# SPDX-License-Identifier: Apache-2.0
"""The configured reference, and its beginning where the arm is."""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.errors import OutsideBarrierError
from blf_dsc_controller.reference.limits import Limits
from blf_dsc_controller.reference.polynomials import ending_at_rest, minimum_jerk
from blf_dsc_controller.reference.splice import Motion, Rules, splice, stop
from blf_dsc_controller.reference.terms import Term, evaluate, pack, sinusoids_term, unpack


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


def check_start(
    joints: tuple[str, ...],
    q: np.ndarray,
    bound: np.ndarray,
    reference_vector: np.ndarray,
    t: float = 0.0,
) -> None:
    """Refuse a start outside the barrier, where the law is not defined.

    Args:
        joints: names of the joints, for the message.
        q: positions (n,) [rad].
        bound: k(t) (n,) [rad].
        reference_vector: of `terms.pack`.
        t: time since the start [s].

    Raises:
        OutsideBarrierError: some |xi1_i| >= k_i(t); names joint, error and bound.
    """
    qr, dqr, ddqr = np.zeros((3, len(joints)))
    evaluate(reference_vector, t, qr, dqr, ddqr)
    for joint, error, limit in zip(joints, q - qr, bound, strict=True):
        if not abs(error) < limit:
            raise OutsideBarrierError(joint, float(error), float(limit))


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
