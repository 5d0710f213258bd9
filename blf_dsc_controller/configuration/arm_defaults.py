# SPDX-License-Identifier: Apache-2.0
"""Gains and limits of the controller for the arm of a URDF: what is not given follows from it.

From the delay of the loop, 1.5 T + robot.lag, comes one rate, omega_v = 0.5 / delay, at which it
loses half a radian of phase; every gain is a fraction of it and of the inertia m_i = 1 / (M^-1)_ii
of a joint with the others free, the least over several postures (doc/arms.md has the margins).

What gravity may be off by, the rated payload among it, makes a joint sag at the start before the
disturbance estimate follows: where that is more than the bound, it is a funnel.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from blf_dsc_controller.configuration.robot import given_robot, learned_of, parameters_of

if TYPE_CHECKING:
    from blf_dsc_controller.arms.base_parameters import BaseParameters
    from blf_dsc_controller.arms.urdf import Chain
    from blf_dsc_controller.configuration.schema import Value

UNKNOWN_EFFORT = 100.0
"""Torque limit [N m] of a joint without one in the URDF."""
_SAG = 1.5  # standard deviations of gravity over m omega_v^2; measured: at most 1
_PHASE = 0.5  # rad that is lost to the delay at omega_v
_BOUND = 0.002  # rad
_UNMODELLED = 0.01  # of the rated torque, rms: ripple, noise, Stribeck
_WINDOW = {'base': 5.0, 'payload': 2.0, 'scale': 5.0}  # s
# One over the independent rows in a window; more where few unknowns cannot explain them all.
_PRIOR = {'base': 0.01, 'payload': 0.1, 'scale': 0.1}
_REGULARISATION = {'base': 1e-5, 'payload': 1e-9, 'scale': 1e-9}  # to 0, where P is about 1
_ANCHOR = 5.0  # of the mean square of the unmodelled torque
_POSTURES = 20
_FREE = 2.0 * math.pi  # rad, limit of a joint without one
_SLOW = 0.5  # of the rated velocity


def controller_defaults(given: Mapping[str, Any]) -> Mapping[str, Value]:
    """Defaults by dotted name for the parameters of the model `urdf` that are given.

    Raises ConfigurationError where the URDF has no such arm.
    """
    robot, chain = given_robot(given, given.get('joints', ()))
    n = len(chain.joints)
    effort = _finite([joint.effort for joint in chain.joints], UNKNOWN_EFFORT)
    velocity = _finite([joint.velocity for joint in chain.joints], 2.0)
    lower = _finite([joint.lower for joint in chain.joints], -_FREE)
    upper = _finite([joint.upper for joint in chain.joints], _FREE)
    parameters = parameters_of(robot, chain)
    P = parameters.of(chain.inertias, robot.rotors(chain))
    P0 = learned_of(robot, chain).initial
    period = given.get('sample_time', 0.001)
    rate = _PHASE / (1.5 * period + robot.lag) if isinstance(period, float) else 0.0
    limits = tuple(lower), tuple(upper)
    m, gravity = over_postures(chain, parameters, robot.payload, tuple(P), *limits)
    sag = _SAG * gravity / (m * rate**2) if rate else np.zeros(n)
    floor = _UNMODELLED * effort
    zeros = (0.0,) * n
    return {
        'joints': tuple(joint.name for joint in chain.joints),
        'barrier.bound': (_BOUND,) * n,
        'barrier.initial_bound': _listed(np.where(sag > _bound_of(given, n), sag, 0.0)),
        'barrier.funnel_rate': float(f'{rate / 20.0:.4g}'),
        'barrier.weight': _listed(0.25 * m * rate**2),
        'barrier.slope_limit': _listed(m * rate**2),
        'surface.gain': (2.0 * rate,) * n,
        'surface.mu': (0.5 * rate,) * n,
        'feedback.gain': zeros,
        'feedback.damping': zeros,
        'feedback.damping_rate': 0.6 * rate,
        'disturbance.gain': _listed(0.4 * m * rate**2),
        'torque.limit': _listed(effort),
        'torque.rate_limit': zeros,
        'reference.type': 'hold',
        'reference.offset': _listed((lower + upper) / 2.0),
        'reference.amplitude': zeros,
        'limits.position_lower': _listed(lower),
        'limits.position_upper': _listed(upper),
        'limits.velocity': _listed(_SLOW * velocity),
        'limits.acceleration': _listed(4.0 * _SLOW * velocity),
        'learning.initial_estimate': _listed(P0),
        'learning.adaptation_gain': (0.5,) * P0.size,
        'learning.radius': 10.0 * max(float(np.linalg.norm(P0)), robot.payload),
        'learning.window': _WINDOW[robot.learn],
        'learning.regularization': _REGULARISATION[robot.learn],
        'learning.settling_time': 0.3,
        'learning.filter_pole': 20.0,
        'learning.row_interval': 10,
        'learning.interval': 50,
        'learning.excitation_threshold': 1e-9,
        'learning.prior_weight': _PRIOR[robot.learn],
        'learning.anchor_weight': _ANCHOR * float(floor.min()) ** 2,
        'learning.motion_scale': 0.05,
        'learning.residual_floor': _listed(floor),
        'learning.bias': False,
        'learning.viscous': True,
        'learning.coulomb': True,
        'learning.coulomb_velocity': 0.05,
        'comparison.surface_gain': (rate / 3.0,) * n,
        'comparison.position_gain': _listed(m * (rate / 4.0) ** 2),
        'comparison.robust_gain': zeros,
        'truth.constant': zeros,
        'truth.amplitude': zeros,
        'truth.frequency': (1.0,) * n,
        'truth.phase': zeros,
        'safety.torque': 'hold_gravity',
        'safety.damping': _listed(m * rate / 4.0),
        'safety.velocity_limit': 3.0 * float(velocity.max()),
    }


@functools.lru_cache(maxsize=16)
def over_postures(
    chain: Chain,
    parameters: BaseParameters,
    payload: float,
    P: tuple[float, ...],
    lower: tuple[float, ...],
    upper: tuple[float, ...],
) -> tuple[np.ndarray, np.ndarray]:
    """Least 1 / (M^-1)_ii (n,), and largest standard deviation of gravity (n,) [N m].

    Over random postures within the limits; for a rated payload [kg].
    """
    from blf_dsc_controller.arms.prior import prior_factor  # compiles

    model = parameters.model
    n = model.n
    L = prior_factor(chain, parameters, payload, np.zeros(n))
    random = np.random.default_rng(0)
    Yp, Yr, M = np.zeros((n, len(P))), np.zeros((n, len(P))), np.zeros((n, n))
    least, deviation = np.full(n, np.inf), np.zeros(n)
    for _ in range(_POSTURES):
        q = random.uniform(lower, upper)
        for i, unit in enumerate(np.eye(n)):
            model.momentum_regressor(q, unit, Yp, Yr)
            M[:, i] = Yp @ P
        least = np.minimum(least, 1.0 / np.diag(np.linalg.inv(M)))
        model.momentum_regressor(q, np.zeros(n), Yp, Yr)
        deviation = np.maximum(deviation, np.linalg.norm(Yr @ L, axis=1))
    return least, deviation


def _bound_of(given: Mapping[str, Any], n: int) -> np.ndarray:
    """Bound [rad] that is given, or the default; validation comes later."""
    try:
        return np.broadcast_to(np.array(given['barrier.bound'], dtype=float), (n,))
    except (KeyError, TypeError, ValueError):
        return np.full(n, _BOUND)


def _finite(values: list[float], instead: float) -> np.ndarray:
    return np.array([value if math.isfinite(value) else instead for value in values])


def _listed(values: np.ndarray) -> tuple[float, ...]:
    """Entries of four digits: gains are no measurements."""
    return tuple(float(f'{value:.4g}') for value in values)
