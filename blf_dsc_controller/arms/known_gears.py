# SPDX-License-Identifier: Apache-2.0
"""Design rule for an arm whose gears are known: the stiffest gains with a modulus margin of 0.5.

The margin is that of the linear loop (`linear_loop`) above the frequencies of the rigid
arm, in several postures, with and without the rated payload, with motors that are lighter
and heavier than stated, and with encoders on either side of the gears.

The gains are those of joints, each on its own, with damping in proportion to the motors.
A torque loop makes the motors follow the links: the inertia that a drive then adds is that
of its motor over 1 + k_T.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.joint_gains import (
    JointGains,
    damped_arm,
    linear,
    max_integral_fraction,
)
from blf_dsc_controller.arms.linear_loop import (
    Feedback,
    Joints,
    Loop,
    Margin,
    Timing,
    TorqueLoop,
)

Floats = NDArray[np.float64]

MARGIN = 0.5
"""Modulus margin of the gains."""

_SPREAD = (0.7, 1.3)  # of the motors, relative to what is stated
_SLOWEST, _FASTEST = 1.0, 1000.0  # 1/s, damping over the inertia of the motors
_BISECTIONS = 8


class Gears(NamedTuple):
    """Gears and drives: stiffness (n,) [N m/rad], and the inertia that the drives add."""

    stiffness: Floats | None  # None: rigid
    motors: Floats  # (n,) kg m^2, as the torques see them
    viscous: Floats  # (n,) N m s/rad
    has_torque_loop: bool
    unknown: Floats | None = (
        None  # (n,) kg m^2, what rigid drives may be beyond a guess
    )

    def variants(self) -> tuple[Joints, ...]:
        """Return the joints that these gears may have: other motors, encoders on either side."""
        if self.stiffness is None:
            guessed = Joints(motors=self.motors, viscous=self.viscous)
            if self.unknown is None:
                return (guessed,)
            return guessed, guessed._replace(motors=self.motors + self.unknown)
        loop = TorqueLoop() if self.has_torque_loop else None
        hidden = 1.0 + (loop.gain if loop else 0.0)
        sides = (False,) if loop else (False, True)  # the sensors are at the links
        return tuple(
            Joints(
                motors=factor * hidden * self.motors,
                viscous=self.viscous,
                stiffness=self.stiffness,
                torque_loop=loop,
                motor_side=side,
            )
            for factor in _SPREAD
            for side in sides
        )


class GearedArm(NamedTuple):
    """Links M (k, n, n) [kg m^2] in k postures, some of them loaded, with their gears."""

    links: Floats
    gears: Gears
    timing: Timing

    @property
    def inertia(self) -> Floats:
        """The largest inertia (n,) [kg m^2] of each joint."""
        links = np.diagonal(self.links, axis1=1, axis2=2).max(axis=0)
        inertia = links + self.gears.motors
        if self.gears.unknown is not None:
            inertia = inertia + self.gears.unknown
        return np.asarray(inertia)

    def loops(self, feedback: Feedback) -> list[Loop]:
        """Return the loops of a law with the gears that these may be."""
        return [
            Loop(self.links, joints, self.timing, feedback)
            for joints in self.gears.variants()
        ]

    def margin(self, feedback: Feedback) -> Margin:
        """Return the smallest modulus margin of a law over the variants of the gears."""
        return min(loop.margin() for loop in self.loops(feedback))

    def joint_gains(self) -> JointGains:
        """Return the stiffest gains of joints, each on its own, that keep the margin.

        Found by bisection over the rate of the damping.
        """
        integral_fraction = max_integral_fraction(
            has_torque_loop=self.gears.has_torque_loop
        )

        def gains(rate: float) -> JointGains:
            gains = damped_arm(rate * self.gears.motors, self.inertia)
            return gains._replace(integral_fraction=integral_fraction)

        def feedback(rate: float) -> Feedback:
            return linear(gains(rate), self.inertia, len(self.links))

        low, high = _SLOWEST, _FASTEST
        for _ in range(_BISECTIONS):
            middle = math.sqrt(low * high)
            if self.margin(feedback(middle)).value >= MARGIN:
                low = middle
            else:
                high = middle
        return gains(low)
