# SPDX-License-Identifier: Apache-2.0
"""Design rules: the gains and limits of the controller that follow from the URDF of an arm.

The delay of the loop, 3 T + robot.lag, gives the rate omega_b = 0.625 / delay;
feedback.stiffness is the part of it that is used. Gains are multiples of this rate and
of the inertia of each joint with the others free, m_i = 1 / (M^-1)_ii, minimised over
several postures; the law multiplies what acts on errors by M(q, P^(0)) / m. Three
samples: half a sample for which torques are held, one until they are applied, half a
sample of differenced velocities, and one for the surface filter and alpha2', so that
gain margins are alike at 1 kHz and 250 Hz (doc/arms.md: margins).

Errors of the modelled gravity, including the rated payload, make a joint sag at the
start until the disturbance estimate compensates them. If it sags by more than the
bound, the bound is a funnel.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.arms.base_parameters import BaseParameters, prior_factor
from blf_dsc_controller.arms.model import free_inertias, inertia_matrices, regressors_at
from blf_dsc_controller.arms.urdf import Chain

UNKNOWN_EFFORT = 100.0
"""Torque limit [N m] of a joint without one in the URDF."""
SAMPLES = 3.0
"""Delay of the loop by its sampling alone, in samples."""
# sag over (standard deviation of gravity / m omega_b^2); measured: at most 1
_SAG = 1.5
_PHASE = 0.625  # rad, phase lost to the delay at omega_b
_BOUND = 0.002  # rad, at full stiffness
_UNMODELLED = 0.01  # rms, fraction of the rated torque: ripple, noise, Stribeck
_WINDOW = 5.0  # s
_REGULARISATION = 1e-5  # pulls P (about 1) to 0
_ANCHOR = 5.0  # times the mean square of the unmodelled torque
_POSTURES = 20
_SURFACE = 0.004  # s, least time constant of the surface filter: noise of alpha2'
_FREE = 2.0 * math.pi  # rad, position limit of a joint without one
_SLOW = 0.5  # fraction of the rated velocity


def loop_delay(sample_time: float, lag: float) -> float:
    """Return the delay of the loop [s] that its gains allow for."""
    return SAMPLES * sample_time + lag


class Design(NamedTuple):
    """What the gains of an arm follow from."""

    chain: Chain
    parameters: BaseParameters
    efforts: np.ndarray  # (n,) N m, rated torques
    rotors: np.ndarray  # (n,) kg m^2, inertias of the drives
    payload: float  # kg, rated
    lag: float  # s


def gains_of(
    arm: Design, sample_time: float, stiffness: float, bound: np.ndarray | None
) -> Mapping[str, bool | int | float | str | tuple[float, ...] | tuple[str, ...]]:
    """Return gains and limits by the dotted name of their parameter.

    `stiffness` is the part of the rate omega_b that is used, `bound` (n,) [rad] or None
    the one that is given.
    """
    chain = arm.chain
    n = len(chain.joints)
    effort = _finite([joint.effort for joint in chain.joints], UNKNOWN_EFFORT)
    velocity = _finite([joint.velocity for joint in chain.joints], 2.0)
    lower = _finite([joint.lower for joint in chain.joints], -_FREE)
    upper = _finite([joint.upper for joint in chain.joints], _FREE)
    P = arm.parameters.of(chain.inertias, arm.rotors)
    fastest = _PHASE / loop_delay(sample_time, arm.lag)
    rate = stiffness * fastest
    usual_bound = float(f'{_BOUND / stiffness**2:.4g}')
    limits = tuple(lower), tuple(upper)
    m, gravity = over_postures(chain, arm.parameters, arm.payload, tuple(P), *limits)
    sag = _SAG * gravity / (m * rate**2)
    floor = _UNMODELLED * arm.efforts
    zeros = (0.0,) * n
    return {
        'joints': tuple(joint.name for joint in chain.joints),
        'barrier.bound': (usual_bound,) * n,
        'barrier.initial_bound': _listed(
            np.where(sag > (usual_bound if bound is None else bound), sag, 0.0)
        ),
        'barrier.funnel_rate': float(f'{rate / 20.0:.4g}'),
        'barrier.weight': _listed(0.5 * m * rate**2),
        'barrier.slope_limit': _listed(1.5 * m * rate**2),
        'surface.gain': (0.4 * rate,) * n,
        'surface.mu': (1.3 * rate,) * n,
        'surface.time_constant': max(sample_time, _SURFACE),
        'surface.known_rate': True,
        'feedback.gain': zeros,
        'feedback.damping': zeros,
        'feedback.damping_rate': 0.6 * rate,
        'disturbance.gain': _listed(0.4 * m * rate**2),
        'torque.limit': _listed(effort),
        'torque.rate_limit': zeros,
        'torque.first_step': zeros,
        'reference.type': 'hold',
        'reference.offset': _listed((lower + upper) / 2.0),
        'reference.amplitude': zeros,
        'limits.position_lower': _listed(lower),
        'limits.position_upper': _listed(upper),
        'limits.velocity': _listed(_SLOW * velocity),
        'limits.acceleration': _listed(4.0 * _SLOW * velocity),
        'learning.initial_estimate': _listed(P),
        'learning.adaptation_gain': (0.5,) * P.size,
        'learning.radius': 10.0 * max(float(np.sqrt((P * P).sum())), arm.payload),
        'learning.window': _WINDOW,
        'learning.regularization': _REGULARISATION,
        'learning.settling_time': 0.3,
        'learning.filter_pole': 20.0,
        'learning.excitation_threshold': 1e-9,
        'learning.anchor_weight': _ANCHOR * float(floor.min()) ** 2,
        'learning.residual_floor': _listed(floor),
        'learning.bias': False,
        'learning.viscous': True,
        'learning.coulomb': True,
        'learning.coulomb_velocity': 0.02,
        'comparison.surface_gain': (rate / 3.0,) * n,
        'comparison.position_gain': _listed(m * (rate / 4.0) ** 2),
        'comparison.robust_gain': zeros,
        'truth.constant': zeros,
        'truth.amplitude': zeros,
        'truth.frequency': (1.0,) * n,
        'truth.phase': zeros,
        'safety.torque': 'hold_gravity',
        'safety.damping': _listed(m * fastest / 4.0),
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
    """Return least 1 / (M^-1)_ii (n,) and largest standard deviation of gravity (n,) [N m].

    Both are taken over random postures within the limits, with the rated payload [kg].
    """
    model = parameters.model
    n = model.n
    L = prior_factor(chain, parameters, payload, np.zeros(n))
    q = np.random.default_rng(0).uniform(lower, upper, (_POSTURES, n))
    free = free_inertias(inertia_matrices(model, np.array(P), q))
    zero = np.zeros_like(q)
    deviation = np.linalg.norm(regressors_at(model, q, zero, zero, zero) @ L, axis=2)
    return free.min(axis=0), deviation.max(axis=0)


def _finite(values: list[float], instead: float) -> np.ndarray:
    return np.array([value if math.isfinite(value) else instead for value in values])


def _listed(values: np.ndarray) -> tuple[float, ...]:
    """Round to four digits, since gains need no more."""
    return tuple(float(f'{value:.4g}') for value in values)
