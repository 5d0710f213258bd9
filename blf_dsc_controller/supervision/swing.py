# SPDX-License-Identifier: Apache-2.0
"""Joints that swing under the damping of a stop, and the share of it that they bear.

The damping -D v acts on a velocity behind a low pass, v' = (dq/dt - v)/tau, and behind
the delay T of the loop.  A joint of inertia J then moves as in

    J s (tau s + 1) + D e^(-T s) = 0

It is stable up to D/J of about 1/T, and half critically damped at D/J = 1/tau, which is
about what is configured.  A joint that is lighter than assumed swings at omega with

    omega^2 = D / (J tau),        D / (tau omega)^2 = J / tau

so that 1/(tau omega)^2 of its damping damps it well.  So does the load observer: the
acceleration of a joint that is lighter than its model by m multiplies the observer's gain.
Where this is more than delay and rates bear, it shakes the joint as well.

States that come late make a joint swing more slowly, at a gain that is then too high by itself:
of such a gain at most half stays, whatever the delay is.

A swing is a half wave of v, from one turning point to the next and through zero, that is
more than half as high as the one before, twice in a row.  Noise and steps of the sensor
make none.  The springs of an elastic arm and of its base may also ring by themselves, which
takes damping away that does them no good.  It comes back, twice as much each time that a joint
has moved in one direction for pi tau, or twice its last half wave: what falls is braked, also
while its springs ring.  What a hand moves to and fro is slower than any delay makes a joint.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import pi

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.law import half_waves
from blf_dsc_controller.law.sensor import FILTER

Vector = NDArray[np.float64]

_SWING_RATIO = 0.5  # of the half wave before
_SWINGS_IN_A_ROW = 2
_LEAST_SWING = 0.03  # rad/s, of a half wave
# likewise, of positions in the time of the low pass: standard deviations of the sensor's
# noise, and its steps
_SWING_SIGMAS = 10.0
_SWING_STEPS = 5.0
# of the damping: a fifth of the inertia, behind a drive with a torque loop of gain 4
_LEAST_DAMPING = 0.04
_GAIN_MARGIN = 0.5  # of a gain at which a joint swings
_LONGEST_SWING = pi * FILTER  # s, half period at omega = 1/tau
_SLOWEST_SWING = 0.6  # s, of a joint whose states come 0.25 s late


class Swing:
    """Finds the share of the damping of a stop that each joint bears.

    Attributes:
        share: of the configured damping (n,).
        has_swung: whether a joint has, since the beginning of the stop (n,).
    """

    def __init__(self, n: int) -> None:
        self.share = np.ones(n)
        self.has_swung = np.zeros(n, dtype=np.bool_)
        self._follows = False  # whether the next v follows the last one
        self._present = half_waves.State(*np.zeros((5, n)))  # of v, rad/s
        # rad/s and s, of the half wave before
        self._travel = np.zeros(n)
        self._half = np.zeros(n)
        self._lasting = np.zeros(n)  # half waves in a row
        self._steady = np.zeros(n)  # s, in one direction and without more damping

    def begin(self) -> None:
        """Begin a stop with all of the damping."""
        self.share[:] = 1.0
        self.has_swung[:] = False
        self._follows = False

    def forget(self) -> None:
        """Wait for the next half waves, after a velocity that is unknown."""
        self._follows = False

    def observe(self, v: Vector, noise: Vector, resolution: Vector, dt: float) -> None:
        """Take the velocities v (n,) [rad/s] that are damped, `dt` [s] after the last.

        `noise` (n,) [rad^2] is the mean square of the noise of positions, `resolution` (n,)
        [rad] their steps.
        """
        if not self._follows:
            self._begin_at(v)
            return
        self._present.since[:] += dt
        self._steady += dt
        unsure = np.maximum(_SWING_SIGMAS * np.sqrt(noise), _SWING_STEPS * resolution)
        least = np.maximum(_LEAST_SWING, unsure / FILTER)
        for i in range(v.size):
            self._follow(i, v[i], least[i])

    def _begin_at(self, v: Vector) -> None:
        """Begin with the next half waves at v (n,) [rad/s]."""
        self._follows = True
        self._present.direction[:] = np.where(v > 0.0, -1.0, 1.0)
        for i in range(v.size):
            half_waves.begin(self._present, i, v[i])
        for each in (self._travel, self._half, self._lasting, self._steady):
            each[:] = 0.0

    def _follow(self, i: int, v: float, least: float) -> None:
        """Follow v [rad/s] of joint i, of which the `least` is no noise."""
        back = half_waves.follow(self._present, i, v)
        travel = half_waves.travel(self._present, i)
        if back > max(0.5 * least, half_waves.TURNED_BACK * travel):
            self._count(i, travel, is_clear=travel > least)
            half_waves.end(self._present, i, v)
        steady_for = min(max(2.0 * self._half[i], _LONGEST_SWING), _SLOWEST_SWING)
        if self._steady[i] > steady_for and abs(v) > 0.5 * least:
            self.share[i] = min(1.0, 2.0 * self.share[i])
            self._steady[i] = 0.0

    def _count(self, i: int, travel: float, *, is_clear: bool) -> None:
        """Count the half wave of joint i that ends, over `travel` [rad/s], as one of a swing."""
        _, turn, farthest, _, farthest_at = (each[i] for each in self._present)
        half = max(farthest_at, self._half[i])
        returns = turn * farthest < 0.0
        lasts = is_clear and returns and self._half[i] > 0.0
        lasts = lasts and travel > _SWING_RATIO * self._travel[i]
        self._lasting[i] = self._lasting[i] + 1.0 if lasts else 0.0
        if self._lasting[i] >= _SWINGS_IN_A_ROW and half < _SLOWEST_SWING:
            less = min(_GAIN_MARGIN, (half / _LONGEST_SWING) ** 2)
            self.share[i] = max(_LEAST_DAMPING, self.share[i] * less)
            self.has_swung[i] = True
            self._lasting[i] = 0.0
        self._travel[i], self._half[i] = travel, farthest_at
        if returns:
            self._steady[i] = 0.0


class SwingNames:
    """Names each joint that swings once in a stop."""

    def __init__(self, joints: Sequence[str]) -> None:
        self._joints = joints
        self._named = np.zeros(len(joints), dtype=np.bool_)

    def begin(self) -> None:
        """Begin a stop."""
        self._named[:] = False

    def name(self, has_swung: NDArray[np.bool_]) -> str:
        """Name those joints (n,) that are not named yet, in a text; empty: all are.

        Only the first text of a stop says what that means: the others follow it.
        """
        new = has_swung & ~self._named
        if not new.any():
            return ''
        is_first = not self._named.any()
        self._named |= new
        names = [
            repr(name) for name, is_new in zip(self._joints, new, strict=True) if is_new
        ]
        what = (
            f'joints {", ".join(names)} swing'
            if len(names) > 1
            else f'joint {names[0]} swings'
        )
        if not is_first:
            return f'{what}, too'
        return (
            f'{what} under the damping of the stop, which is taken down there: is a motor lighter '
            'than robot.rotor_inertia, or a torque later than robot.lag?'
        )
