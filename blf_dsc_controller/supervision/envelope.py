# SPDX-License-Identifier: Apache-2.0
"""The last function before a torque leaves: what no law may ask of an arm.

Whatever has computed a torque, it leaves finite, within its level and within a step from the
last one (`limited`).  Torques of a law without a barrier are also braked (`Envelope.brake`) where
a joint would become faster than it may be.  The form is that of a URDF's `<safety_controller>`,
as ros2_control applies it, for joints that are coupled: the speed that is allowed falls towards
the end of the range, and the torque that is allowed falls as the speed nears it.

    speed         v <= v_max,   v T_q + v^2 / (2 a_stop) <= distance to the end of the range
    for laws without a barrier, likewise with v - qr' and the distance to the largest error
    acceleration  a <= a_max,   a T_v + a^2 / (2 j)      <= v_allowed - v

with a = M^-1 (tau - C dq - G - load) from the model, and the load that the arm has shown to carry
besides (`ObservedLoad`): a payload, or a hand that holds it.  Where a joint asks for more, a
becomes what is allowed, and the torques become tau + M (a_allowed - a), so that gravity and the
other joints are accounted for.  T_v is the time constant of the braking, M / k_velocity, and T_q
that of the approach to the end, 1 / k_position; both are as long as the delay of the loop asks
for.  a_stop is the deceleration that a joint has left beside gravity, j the change of its
acceleration that the rate limit of its torque allows.

A torque that asks for nothing else is not changed in any bit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.model import ArmModel, inertia_matrices, regressors_at
from blf_dsc_controller.numerics.algebra import inverse, product
from blf_dsc_controller.supervision.comparison import limit_torque
from blf_dsc_controller.supervision.observed_load import OBSERVER, ObservedLoad

Array = NDArray[np.float64]

_FAR = 1e3  # rad, rad/s: farther away no limit acts
_RELIEF_SAMPLES = 4  # samples that make up for one in which a law asks for too much
_TOWARDS = np.array([[-1.0], [1.0]])  # the lower and the upper end
_NOTABLE = 0.01  # of the torque limit: cutting less counts as nothing

LONGEST = 0.05
"""Time [s] for which a law may ask for too much."""


class Limits(NamedTuple):
    """What an arm may do; each array is (n,), if nothing else is said."""

    torque: Array  # N m
    step: Array  # N m, change from one message to the next; infinite: any
    velocity: Array  # v_max, rad/s
    ends: Array  # (2, n) of the range, rad
    error: Array  # from the reference, rad; infinite: any
    braking_time: Array  # T_v, s
    approach_time: Array  # T_q, s
    deceleration: Array  # a_stop, rad/s^2
    jerk: Array  # j, rad/s^3; infinite: any


class Body(NamedTuple):
    """The model of an arm, by which torques are accelerations."""

    model: ArmModel
    parameters: Array  # (p,) of the inertia matrix
    brakes: bool  # whether the inertia is known, and the law keeps no bound itself


class Motion(NamedTuple):
    """Where an arm is, and where it should be."""

    q: Array  # (n,) rad
    dq: Array  # (n,) rad/s
    error: Array  # (n,) q - qr, rad
    dqr: Array  # (n,) rad/s


def limited(torque: Array, last: Array | None, limit: Array, step: Array) -> Array:
    """Return a torque (n,) [N m], finite, within its `limit` and a `step` from the `last` (n,).

    Instead of one that is not finite the last one stays, and zero without any: see
    `limit_torque`.
    """
    leaves = np.array(torque)
    if last is None:
        last, step = np.zeros(torque.size), np.full(torque.size, np.inf)
    limit_torque(leaves, last, limit, step)
    return leaves


class Envelope:
    """Brakes the law of an arm where a joint becomes faster than it may be.

    Attributes:
        braked: samples in which it has changed the torque, since the start.
        joint: the joint that asked for most beyond what is allowed, the last time.
    """

    def __init__(self, limits: Limits, body: Body) -> None:
        self.configure(limits, body)
        self.restart()

    def configure(self, limits: Limits, body: Body) -> None:
        """Use other limits from the next torque on."""
        self.limits, self.body = limits, body
        n = limits.torque.size
        self._still = np.zeros((1, n))
        limited(
            np.zeros(n), None, limits.torque, limits.step
        )  # compiled before the first torque

    def restart(self) -> None:
        """Begin with the next torque, of a law that has asked for nothing yet."""
        self.braked = self.joint = 0
        self._asking = 0
        self._load = ObservedLoad(self.limits.torque.size, OBSERVER)
        self._last: tuple[Array, Array] | None = None  # whole torque, and dq before it

    @property
    def asking(self) -> float:
        """Samples in which too much was asked for, less a quarter of those in which it was not."""
        return self._asking / _RELIEF_SAMPLES

    def brake(self, now: Motion, whole: Array, estimate: Array, dt: float) -> Array:
        """Return the whole torque (n,) [N m] that is allowed now; itself if it is.

        `estimate` (p,) is of the parameters of the model, `dt` [s] the time since the last one.
        """
        self._asking = max(0, self._asking - 1)
        still = self._at_rest_or_moving(now.q, now.dq, estimate)
        (M,) = inertia_matrices(
            self.body.model, self.body.parameters, now.q[np.newaxis]
        )
        limit = self.limits.torque
        if self._last is not None:
            sent, before = self._last
            accelerating = product(M, (now.dq - before)[:, np.newaxis])[:, 0] / dt
            self._load.update(sent - still - accelerating, limit, dt)
        force = whole - still - self._load.load
        most = self._accelerations(now)
        asked = product(inverse(M), force[:, np.newaxis])[:, 0]
        change = _between(-most[0], asked, most[1]) - asked
        allowed = whole
        if change.any():
            allowed = whole + product(M, change[:, np.newaxis])[:, 0]
            allowed = _between(-limit, allowed, limit)
            self.braked += 1
            beyond = np.abs(change) * self.limits.braking_time / self.limits.velocity
            self.joint = int(beyond.argmax())
            if (np.abs(allowed - whole) > _NOTABLE * limit).any():
                self._asking += 1 + _RELIEF_SAMPLES
        self._last = allowed, now.dq.copy()
        return allowed

    def speeds(self, now: Motion) -> Array:
        """Return the highest speeds (2, n) [rad/s], downwards and upwards."""
        limits = self.limits
        to_end = _TOWARDS * (limits.ends - now.q)
        to_error = limits.error - _TOWARDS * now.error
        time, rate = limits.approach_time, limits.deceleration
        beside = _reached(to_error, time, rate) + _TOWARDS * now.dqr
        return np.minimum(
            limits.velocity, np.minimum(_reached(to_end, time, rate), beside)
        )

    def _accelerations(self, now: Motion) -> Array:
        """Return the highest accelerations (2, n) [rad/s^2], downwards and upwards.

        That of a joint which is faster than it may be is negative: it is braked.
        """
        limits = self.limits
        room = self.speeds(now) - _TOWARDS * now.dq
        reached = _reached(room, limits.braking_time, limits.jerk)
        return reached + np.minimum(room, 0.0) / limits.braking_time

    def _at_rest_or_moving(self, q: Array, dq: Array, estimate: Array) -> Array:
        """Return C dq + G (n,) [N m], which accelerates nothing."""
        now = q[np.newaxis], dq[np.newaxis], dq[np.newaxis]
        (H,) = regressors_at(self.body.model, *now, self._still)
        return np.asarray((H * estimate).sum(axis=1))


def _between(low: Array, x: Array, high: Array) -> Array:
    return np.minimum(np.maximum(x, low), high)  # faster than clip


def _reached(distance: Array, time: Array, rate: Array) -> Array:
    """Return x >= 0 that is given up within a `distance`: x time + x^2 / (2 rate) = distance."""
    twice = 2.0 * np.minimum(np.maximum(distance, 0.0), _FAR)
    return np.asarray(twice / (time + np.sqrt(time * time + twice / rate)))
