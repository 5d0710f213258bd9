# SPDX-License-Identifier: Apache-2.0
"""Design rules: the gains and limits of the controller that follow from the URDF of an arm.

Gains of joints, each on its own, follow from a stiffness and a damping (`joint_gains`).

Where the whole feedback acts through M(q, P^(0)), for arms whose gears are rigid, the
delay of the loop, 3 T + robot.lag, gives the rate omega_b = 0.625 / delay;
feedback.stiffness is the part of it that is used. Gains are multiples of this rate and
of the inertia of each joint with the others free, m_i = 1 / (M^-1)_ii, minimised over
several postures; the law multiplies what acts on errors by M(q, P^(0)) / m. Three
samples: half a sample for which torques are held, one until they are applied, half a
sample of differenced velocities, and one for the surface filter and alpha2', so that
gain margins are alike at 1 kHz and 250 Hz (doc/gains.md: margins).

Errors of the modelled gravity, including the rated payload, make a joint sag at the
start until the disturbance estimate compensates them. If it sags by more than the
bound, the bound is a funnel.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from typing import NamedTuple, TypeAlias

import numpy as np

from blf_dsc_controller.arms.base_parameters import BaseParameters, prior_factor
from blf_dsc_controller.arms.joint_gains import (
    BESIDE,
    JointGains,
    barriers,
    funnel_rate,
)
from blf_dsc_controller.arms.known_gears import GearedArm, Gears
from blf_dsc_controller.arms.linear_loop import Timing
from blf_dsc_controller.arms.model import free_inertias, inertia_matrices, regressors_at
from blf_dsc_controller.arms.urdf import Chain

UNKNOWN_EFFORT = 100.0
"""Torque limit [N m] of a joint without one in the URDF."""
SAMPLES = 3.0
"""Delay of the loop by its sampling alone, in samples."""
# sag over (standard deviation of gravity / m omega_b^2); measured: at most 1
_SAG = 1.5
_PHASE = 0.625  # rad, phase lost to the delay at omega_b
_BRAKING = 0.375  # of the fastest omega_b, by the damping of a stop
_BOUND = 0.002  # rad, at full stiffness
WIDEST = 0.35
"""The widest bound by default [rad or m], of soft gains of joints."""
# Of such gains: fraction of the rated torque that is expected beside gravity and
# unknown friction
_PUSH = 0.03
# What is left, with drives as heavy as they may be, of how much the slow oscillation is
# damped: a factor of two instead of three
_HEAVIEST = 1.5
_UNMODELLED = 0.01  # rms, fraction of the rated torque: ripple, noise, Stribeck
_WINDOW = 5.0  # s
# Of feedback through the inertia: over m omega_b^2, or over omega_b
_BARRIER, _INTEGRAL, _DAMPING = 0.5, 0.4, 0.6
_SURFACE = 0.4, 1.3  # K and mu
_POSTURES = 20
_FEW = 3  # postures, without and with payload, of known gears
_ADAPTATION = 0.5  # Gamma, in units of the prior's covariance
_FREE = 2.0 * math.pi  # rad, position limit of a joint without one
_SLOW = 0.5  # fraction of the rated velocity
_FASTEST = 1.2  # times the rated velocity, at which the arm stops ...
_UNKNOWN = 3.0  # ... and times that of motions where it is not known


def loop_delay(sample_time: float, lag: float) -> float:
    """Return the delay of the loop [s] that its gains allow for: 3 T + lag."""
    return SAMPLES * sample_time + lag


Value: TypeAlias = bool | int | float | str | tuple[float, ...] | tuple[str, ...]


class Design(NamedTuple):
    """An arm, as far as its gains follow from it."""

    chain: Chain
    parameters: BaseParameters
    efforts: np.ndarray  # (n,) N m, rated torques
    rotors: np.ndarray  # (n,) kg m^2, inertias of the drives
    unknown_rotors: np.ndarray  # (n,) kg m^2, what these may be beyond a guess
    friction: np.ndarray  # (n,) N m, dry friction to expect where none is known
    payload: float  # kg, rated
    lag: float  # s
    # None: the whole feedback acts through the inertia matrix
    joints: JointGains | None
    stiffness: float  # part of the rate that is used, or factor on `joints`
    sample_time: float  # s

    @property
    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest position (n,) [rad]."""
        joints = self.chain.joints
        return (
            _finite([joint.lower for joint in joints], -_FREE),
            _finite([joint.upper for joint in joints], _FREE),
        )

    def over_postures(self) -> Postures:
        """Return the inertias and the gravity of the arm over its postures."""
        P = self.parameters.of(self.chain.inertias, self.rotors)
        limits = (tuple(each) for each in self.limits)
        return over_postures(
            self.chain, self.parameters, self.payload, tuple(P), *limits
        )


class Gains(NamedTuple):
    """Gains of the law (28) that follow from an arm."""

    sag: tuple[
        float, ...
    ]  # (n,) rad, at the start, by gravity that is not in the model
    funnel_rate: float  # 1/s, at which a bound of that sag narrows
    weight: tuple[float, ...]  # (n,) w, N m/rad
    slope_limit: tuple[float, ...]  # (n,) N m/rad
    surface: tuple[float, ...]  # (n,) K, 1/s
    mu: tuple[float, ...]  # (n,) 1/s
    feedback: tuple[float, ...]  # (n,) K_p, N m s/rad
    damping_rate: float  # omega_v, 1/s
    integral: tuple[float, ...]  # (n,) gamma, N m/rad
    adaptation: float  # Gamma, in units of the prior's covariance


def gains_of(arm: Design) -> Gains:
    """Return the gains of the law (28) for an arm."""
    if arm.joints is None:
        return _inertia_feedback(arm)
    return _joint_feedback(arm, arm.joints.scaled(arm.stiffness))


def defaults_of(arm: Design) -> Mapping[str, Value]:
    """Return the parameters that follow from an arm, by their dotted names."""
    n = len(arm.chain.joints)
    gains = gains_of(arm)
    if arm.joints is None:
        bound = (float(f'{_BOUND / arm.stiffness**2:.4g}'),) * n
    else:
        bound = _listed(np.maximum(gains.sag, _BOUND))
    return {
        **_limits(arm),
        **_learning(arm),
        'feedback.inertia': 'whole' if arm.joints is None else 'none',
        'barrier.bound': bound,
        'disturbance.gain': gains.integral,
    }


def _inertia_feedback(arm: Design) -> Gains:
    """Return the gains of feedback through the inertia matrix."""
    n = len(arm.chain.joints)
    fastest = _PHASE / loop_delay(arm.sample_time, arm.lag)
    rate = arm.stiffness * fastest
    postures = arm.over_postures()
    m = postures.free_inertia
    integral = _INTEGRAL * m * rate**2
    return Gains(
        sag=tuple((_SAG * postures.gravity / (m * rate**2)).tolist()),
        funnel_rate=float(f'{rate / 20.0:.4g}'),
        weight=_listed(_BARRIER * m * rate**2),
        slope_limit=_listed(1.5 * m * rate**2),
        surface=(_SURFACE[0] * rate,) * n,
        mu=(_SURFACE[1] * rate,) * n,
        feedback=(0.0,) * n,
        damping_rate=_DAMPING * rate,
        integral=_listed(integral),
        adaptation=adaptation_gain(integral, postures.gravity),
    )


def _joint_feedback(arm: Design, gains: JointGains) -> Gains:
    """Return the gains of joints, each on its own."""
    postures = arm.over_postures()
    disturbance = postures.gravity + _PUSH * arm.efforts + arm.friction
    sag = np.minimum(_SAG * disturbance / gains.stiffness, WIDEST)
    heaviest = (postures.inertia + arm.unknown_rotors) / _HEAVIEST
    inertia = np.maximum(postures.inertia, heaviest)
    integral_beside = gains._replace(integral_fraction=BESIDE).integral(inertia)
    barrier_gains = barriers(gains)
    return Gains(
        sag=tuple(sag.tolist()),
        funnel_rate=float(f'{funnel_rate(gains):.4g}'),
        weight=_listed(barrier_gains.weight),
        slope_limit=_listed(barrier_gains.slope_limit),
        surface=_listed(barrier_gains.surface),
        mu=_listed(barrier_gains.mu),
        feedback=_listed(gains.damping),
        damping_rate=0.0,
        integral=_listed(gains.integral(inertia)),
        adaptation=adaptation_gain(integral_beside, postures.gravity),
    )


def initial_bound(gains: Gains, bound: tuple[float, ...]) -> tuple[float, ...]:
    """Return the bound (n,) [rad] at the start: wider where a joint sags past its `bound`."""
    sag = np.array(gains.sag)
    wide = _listed(np.where(sag > bound, sag, 0.0))
    return tuple(start or each for start, each in zip(wide, bound, strict=True))


def initial_estimate(arm: Design) -> tuple[float, ...]:
    """Return P^(0) (p,) by the description of an arm."""
    return _listed(arm.parameters.of(arm.chain.inertias, arm.rotors))


def radius(arm: Design) -> float:
    """Return the radius of the ball that P^ stays in: ten times the arm, or its payload."""
    P = arm.parameters.of(arm.chain.inertias, arm.rotors)
    return 10.0 * max(float(np.sqrt((P * P).sum())), arm.payload)


def adaptation_gain(integral: np.ndarray, deviation: np.ndarray) -> float:
    """Return a Gamma with which the tracking error adapts no faster than an integral.

    `integral` (n,) [N m/rad] is the gain gamma of that, and `deviation` (n,) [N m] the standard
    deviation of the modelled torque: where d^3 integrates gamma xi2, adaptation integrates
    Gamma deviation^2 xi2.  It grows with the square of the payload, and nothing else
    bounds it on slow or soft loops.
    """
    with np.errstate(divide='ignore'):
        slow = float((integral / deviation**2).min())
    return min(_ADAPTATION, float(f'{slow:.4g}'))


def _limits(arm: Design) -> dict[str, Value]:
    """Return the joints, their limits, a reference that holds within them, and safety."""
    joints = arm.chain.joints
    effort = _finite([joint.effort for joint in joints], UNKNOWN_EFFORT)
    velocity = _finite([joint.velocity for joint in joints], 2.0)
    known = np.array([math.isfinite(joint.velocity) for joint in joints])
    acceleration = np.array([joint.acceleration for joint in joints])
    lower, upper = arm.limits
    fastest = _PHASE / loop_delay(arm.sample_time, arm.lag)
    zeros = (0.0,) * len(joints)
    return {
        'joints': tuple(joint.name for joint in joints),
        'torque.limit': _listed(effort),
        'torque.rate_limit': zeros,
        'torque.first_step': zeros,
        'reference.type': 'hold',
        'reference.offset': _listed((lower + upper) / 2.0),
        'reference.amplitude': zeros,
        'limits.position_lower': _listed(lower),
        'limits.position_upper': _listed(upper),
        'limits.velocity': _listed(_SLOW * velocity),
        'limits.acceleration': _listed(
            np.minimum(4.0 * _SLOW * velocity, acceleration)
        ),
        'safety.torque': 'hold_gravity',
        'safety.damping': _listed(
            _BRAKING * arm.over_postures().free_inertia * fastest
        ),
        'safety.velocity_limit': _listed(
            np.where(known, _FASTEST, _UNKNOWN) * velocity
        ),
    }


def _learning(arm: Design) -> dict[str, Value]:
    """Return what learning needs: where it begins, how far it goes, and its filters."""
    return {
        'learning.window': _WINDOW,
        'learning.residual_floor': _listed(_UNMODELLED * arm.efforts),
    }


def geared_arm(arm: Design, gears: Gears) -> GearedArm:
    """Return an arm with its gears, in three postures, without and with its rated payload."""
    none = np.zeros(len(arm.rotors))
    P = arm.parameters.of(arm.chain.inertias, none)
    q = np.random.default_rng(0).uniform(*arm.limits, (_FEW, len(none)))
    links = [
        inertia_matrices(arm.parameters.model, P + load * arm.parameters.load, q)
        for load in (0.0, arm.payload)
    ]
    half = 0.5 * arm.lag
    return GearedArm(
        np.concatenate(links), gears, Timing(arm.sample_time, 1, half, half)
    )


class Postures(NamedTuple):
    """Extremes over the postures of an arm."""

    free_inertia: np.ndarray  # least 1 / (M^-1)_ii (n,), kg m^2
    inertia: np.ndarray  # largest M_ii with the rated payload (n,), kg m^2
    gravity: np.ndarray  # largest standard deviation of gravity (n,), N m


@functools.lru_cache(maxsize=16)
def over_postures(
    chain: Chain,
    parameters: BaseParameters,
    payload: float,
    P: tuple[float, ...],
    lower: tuple[float, ...],
    upper: tuple[float, ...],
) -> Postures:
    """Return extremes over random postures within the limits [rad].

    The rated payload [kg] counts in what is largest.
    """
    model = parameters.model
    n = model.n
    L = prior_factor(chain, parameters, payload, np.zeros(n))
    q = np.random.default_rng(0).uniform(lower, upper, (_POSTURES, n))
    M = inertia_matrices(model, np.array(P), q)
    loaded = inertia_matrices(model, np.array(P) + payload * parameters.load, q)
    zero = np.zeros_like(q)
    deviation = np.linalg.norm(regressors_at(model, q, zero, zero, zero) @ L, axis=2)
    return Postures(
        free_inertia=free_inertias(M).min(axis=0),
        inertia=np.diagonal(loaded, axis1=1, axis2=2).max(axis=0),
        gravity=deviation.max(axis=0),
    )


def _finite(values: list[float], instead: float) -> np.ndarray:
    return np.array([value if math.isfinite(value) else instead for value in values])


def _listed(values: np.ndarray) -> tuple[float, ...]:
    """Round to four digits, since gains need no more."""
    return tuple(float(f'{value:.4g}') for value in values)
