# SPDX-License-Identifier: Apache-2.0
"""Design rules for elastic joints: each has a stiffness and a damping of its own.

A geared joint is a motor behind a spring.  Beyond the resonance of both, a torque moves
the motor alone, so feedback through the inertia matrix of the links is too high there by
their ratio, up to fifteen times, and the loop oscillates.  Gains of the joints, each on
its own, have no such factor; makers of arms publish theirs in this form.  From the
stiffness k and the damping d of a joint follow the gains of the law (28),

    r = k / (1.8 d),    K = 0.4 r,  mu = 1.3 r,  K_p = d,  w = 0.3 r d,  gamma = c r d

so that near the reference the torque is - d xi1' - (1.8 + c) r d xi1 - 1.5 c r^2 d int xi1.
The factor c of the integral is at most 0.45, or 0.15 where drives have a torque loop: there a
load observer integrates beside it, and play in the gears tolerates no more.  It is less where
the damping is small for the inertia J of the outstretched, loaded arm: d (1.8 r d) >
J 1.5 c r^2 d keeps the slow oscillation damped, here by a factor of three, or two with
drives as heavy as they may be where they are a guess.  What the tracking error adapts is
an integral beside it as well.

Of an arm about which nothing but its URDF is known, the gears may have any stiffness,
the encoders may be on either side of them, and drives may have a torque loop that hides
the motor.  Damping of 2.1 (10 1/s) times the motor's inertia then holds it, softly.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.linear_loop import Feedback

Floats = NDArray[np.float64]

_POSITION = 1.8  # k / (r d), without the integral
_BARRIER = 0.3  # w / (r d)
_STEEPEST = 0.9  # likewise, of the barrier's slope near the bound
_FILTERED = 0.4, 1.3  # K / r and mu / r
_RATE = _FILTERED[0] / 2.0 + _FILTERED[1]  # of xi1 in xi2, over r
_DAMPED = 0.4  # of d (1.8 r d) / (J 1.5 r^2 d), for c
_FUNNEL = 0.1  # times r: the integral is as fast

_HELD = 21.0  # 1/s, d / B of an unknown arm
_HELD_RATE = 4.0  # 1/s, r likewise
_DAMPING_RATIO = 0.4

SURFACE = 0.004
"""Least time constant of the surface filter [s]: noise of alpha2'."""


ALONE, BESIDE = 0.45, 0.15
"""Largest c of an integral by itself, and beside another one."""

GIVEN = 'stiffness', 'damping'
"""Fields of `JointGains` that a configuration gives as `feedback.joint_*`."""


class JointGains(NamedTuple):
    """Stiffness and damping of each joint, from which its gains follow."""

    stiffness: Floats  # (n,) N m/rad
    damping: Floats  # (n,) N m s/rad
    damping_lag: float | Floats = 0.0  # s, of all joints or of each (n,)
    integral_fraction: float = ALONE  # c of the integral, at most

    @property
    def rate(self) -> Floats:
        """The rate r (n,) [1/s] at which an error decays."""
        return self.stiffness / (_POSITION * self.damping)

    def integral(self, inertia: Floats) -> Floats:
        """Return gamma (n,) [N m/rad] with the largest `inertia` of each joint (n,) [kg m^2].

        c is smaller than its limit where the damping is small for the inertia.
        """
        damped = _DAMPED * self.damping / (self.rate * inertia)
        return self.rate * self.damping * np.minimum(damped, self.integral_fraction)

    def scaled(self, factor: float | Floats) -> JointGains:
        """Return stiffness and damping times a factor."""
        return self._replace(
            stiffness=factor * self.stiffness, damping=factor * self.damping
        )


def max_integral_fraction(*, has_torque_loop: bool) -> float:
    """Return the largest c of the integral of an arm, without or with a torque loop."""
    return BESIDE if has_torque_loop else ALONE


def unknown_arm(motors: Floats) -> JointGains:
    """Return gains that hold an arm of which only the motors (n,) [kg m^2] are guessed."""
    damping = _HELD * motors
    return JointGains(_POSITION * _HELD_RATE * damping, damping)


def damped_arm(damping: Floats, inertia: Floats) -> JointGains:
    """Return gains with the damping (n,) that leave the outstretched, loaded arm damped.

    `inertia` (n,) [kg m^2] is the largest of each joint; friction, which damps as well,
    is not counted.
    """
    return JointGains(damping**2 / (4.0 * _DAMPING_RATIO**2 * inertia), damping)


def linear(gains: JointGains, inertia: Floats, postures: int) -> Feedback:
    """Return the law with these gains at small errors, in as many `postures`.

    `inertia` (n,) [kg m^2] is the largest of each joint.
    """
    one = np.broadcast_to(np.eye(len(inertia)), (postures, len(inertia), len(inertia)))
    rate, damping = gains.rate, gains.damping
    return Feedback(
        position=one * (_BARRIER * rate * damping),
        surface=one * damping,
        inertia=0.0 * one,
        integral=one * gains.integral(inertia),
        rate=_RATE * rate,
        time_constant=SURFACE,
        known_rate=True,
        damping_lag=gains.damping_lag,
    )


class Barriers(NamedTuple):
    """Gains (n,) of barrier and surface."""

    weight: Floats  # w, N m/rad
    slope_limit: Floats  # N m/rad
    surface: Floats  # K, 1/s
    mu: Floats  # 1/s


def barriers(gains: JointGains) -> Barriers:
    """Return the gains of barrier and surface that follow from the gains of joints."""
    rate, damping = gains.rate, gains.damping
    barrier_gain, linear_gain = _FILTERED
    return Barriers(
        weight=_BARRIER * rate * damping,
        slope_limit=_STEEPEST * rate * damping,
        surface=barrier_gain * rate,
        mu=linear_gain * rate,
    )


def funnel_rate(gains: JointGains) -> float:
    """Return the rate [1/s] at which a bound may narrow: that of the slowest integral."""
    return float(_FUNNEL * gains.rate.min())
