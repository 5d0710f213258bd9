# SPDX-License-Identifier: Apache-2.0
"""Gains and limits of the controller for the arm of a URDF: what is not given follows from it.

From the delay of the loop, 1.5 T + robot.lag, comes one rate, omega_v = 0.5 / delay, at which the
damping loop keeps a phase margin of 60 degrees; every other gain is a fraction of it and of the
inertia m_i = 1 / (M^-1)_ii of a joint with the others free, the least over several postures
(doc/tuning.md).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from blf_dsc_controller.configuration.robot import Robot, given_robot, parameters_of

if TYPE_CHECKING:
    from blf_dsc_controller.arms.urdf import Chain
    from blf_dsc_controller.configuration.schema import Value

_PHASE = 0.5  # rad that the damping loop loses to the delay
_BOUND = 0.002  # rad
_UNMODELLED = 0.01  # of the rated torque, rms: ripple, noise, Stribeck
_WINDOW = 5.0  # s
_PRIOR = 0.01  # one over the independent rows in a window
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
    effort = _finite([joint.effort for joint in chain.joints], 100.0)
    velocity = _finite([joint.velocity for joint in chain.joints], 2.0)
    lower = _finite([joint.lower for joint in chain.joints], -_FREE)
    upper = _finite([joint.upper for joint in chain.joints], _FREE)
    P0 = parameters_of(robot, chain).of(chain.inertias, robot.rotors(chain))
    period = given.get('sample_time', 0.001)
    rate = _PHASE / (1.5 * period + robot.lag) if isinstance(period, float) else 0.0
    m = _free_inertia(robot, chain, P0, lower, upper)
    floor = _UNMODELLED * effort
    zeros = (0.0,) * n
    return {
        'joints': tuple(joint.name for joint in chain.joints),
        'barrier.bound': (_BOUND,) * n,
        'barrier.initial_bound': zeros,
        'barrier.weight': _listed(0.25 * m * rate**2),
        'barrier.slope_limit': _listed(1.8 * m * rate**2),
        'surface.gain': (1.3 * rate,) * n,
        'surface.mu': (0.25 * rate,) * n,
        'feedback.gain': zeros,
        'feedback.damping': zeros,
        'feedback.damping_rate': 0.8 * rate,
        'disturbance.gain': _listed(0.5 * m * rate**2),
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
        'learning.radius': 10.0 * float(np.linalg.norm(P0)),
        'learning.window': _WINDOW,
        'learning.settling_time': 0.3,
        'learning.filter_pole': 20.0,
        'learning.row_interval': 10,
        'learning.interval': 50,
        'learning.excitation_threshold': 1e-9,
        'learning.prior_weight': _PRIOR,
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


def _free_inertia(
    robot: Robot, chain: Chain, P: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> np.ndarray:
    """Least 1 / (M^-1)_ii (n,) over random postures within the limits."""
    model = parameters_of(robot, chain).model
    n = model.n
    random = np.random.default_rng(0)
    Yp, Yr, M = np.zeros((n, P.size)), np.zeros((n, P.size)), np.zeros((n, n))
    least = np.full(n, np.inf)
    for _ in range(_POSTURES):
        q = random.uniform(lower, upper)
        for i, unit in enumerate(np.eye(n)):
            model.momentum_regressor(q, unit, Yp, Yr)
            M[:, i] = Yp @ P
        least = np.minimum(least, 1.0 / np.diag(np.linalg.inv(M)))
    return least


def _finite(values: list[float], instead: float) -> np.ndarray:
    return np.array([value if math.isfinite(value) else instead for value in values])


def _listed(values: np.ndarray) -> tuple[float, ...]:
    """Entries of four digits: gains are no measurements."""
    return tuple(float(f'{value:.4g}') for value in values)
