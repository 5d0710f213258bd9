# SPDX-License-Identifier: Apache-2.0
"""Gains by what was measured: the stiffest with a modulus margin, in every posture.

With responses G_y, G_v and the law's C_y, C_v (`arms.linear_loop`) the loop, cut at the
torques of all joints, is L = C_y G_y + C_v G_v, and the modulus margin is the least
singular value of I + L over the frequencies, less what noise may make of it.  With small
gains the loop is stable.  Raised step by step, they can only make it unstable where a
singular value passes zero, so every step on the way must have the margin.

First the stiffness and damping of all joints grow together, then those of each joint by
itself, in turns, as far as the margin allows.  Then the damping of one joint after the other
may lag (`feedback.joint_damping_lag`), where that lets gains grow further.  A lag pays where
encoders are at the links and motors are heavy, and costs elsewhere.  Gains of joints without a
lag stay, since lighter joints may be limited by what is faster than the motion shows.  A lag
that gives next to nothing is none.

A rigid joint of the measured inertia and lags must have the margin, too (`RigidArm`).  What is
measured bears more only where friction damps it, or where it is not seen.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.joint_gains import JointGains, linear
from blf_dsc_controller.arms.known_gears import MARGIN
from blf_dsc_controller.arms.linear_loop import (
    SLOWEST,
    Joints,
    Loop,
    Timing,
    law_responses,
)
from blf_dsc_controller.commissioning.response import DEVIATIONS, Response

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

BARELY = 0.1
"""Modulus margin, noise not counted, with which an arm nearly oscillates."""

LAGS = (0.002, 0.003, 0.005)
"""Lags of the damping of a joint [s] that are tried, one after the other."""

_STEP = 1.1
_PAYS = 2  # steps of gains, of all joints together, for which a lag is chosen
_LEAST, _MOST = 0.05, 100.0  # times the damping of the measurement
_RAISED = _STEP ** np.arange(-30.0, 0.0)  # of gains, from small ones
# Of one joint by itself, times that of all joints, or that of the measurement, if this is more.
_OF_ONE = 5.0


class Margin(NamedTuple):
    """A modulus margin, and where it is least."""

    value: float
    frequency: float  # Hz
    posture: int
    joint: int  # with the largest part in it


class Choice(NamedTuple):
    """Chosen gains, and what limits them."""

    gains: JointGains
    factors: Floats  # (n,) on the damping of the measurement
    without_lag: Floats  # (n,) likewise, of the gains if no damping lagged
    margin: Margin
    measured: Margin  # of the gains with which the arm was measured
    by_inertia: NDArray[
        np.bool_
    ]  # (n,) of which joints more is too much for a rigid arm


class RigidArm(NamedTuple):
    """Rigid joints without friction, the others held: what inertias and lags alone bear."""

    inertias: Floats  # (n,) kg m^2, the least of each joint
    timing: Timing

    def margin(self, gains: JointGains, inertia: Floats) -> float:
        """Return the modulus margin of gains; 0 if a loop is unstable.

        `inertia` (n,) [kg m^2] is the largest of each joint.
        """
        nothing = np.zeros(len(inertia))
        M = np.diag(self.inertias)[None]
        joints = Joints(motors=nothing, viscous=nothing)
        return Loop(M, joints, self.timing, linear(gains, inertia, 1)).margin().value


class Loops(NamedTuple):
    """Measured arms in k postures, and the law by its gains."""

    responses: Sequence[Response]
    inertia: Floats  # (n,) kg m^2, the largest of each joint
    sample_time: float  # s

    def singular_values(self, gains: JointGains) -> list[tuple[Floats, Floats]]:
        """Return for each posture the least singular value of I + L (f,), and its doubt."""
        return [self._least(each, gains)[:2] for each in self.responses]

    def margin(self, gains: JointGains, *, noise: bool = True) -> Margin:
        """Return the margin of gains, `noise` counted against it or not."""
        margins = []
        for k, response in enumerate(self.responses):
            value, doubt, direction = self._least(response, gains)
            counts = response.seen & (response.frequency >= SLOWEST)
            counted = np.where(counts, value - noise * doubt, np.inf)
            at = int(counted.argmin())
            joint = int(np.abs(direction[at]).argmax())
            frequency = float(response.frequency[at])
            margins.append(Margin(float(counted[at]), frequency, k, joint))
        return min(margins)

    def _least(
        self, response: Response, gains: JointGains
    ) -> tuple[Floats, Floats, Complex]:
        """Return least singular values (f,), their doubt (f,) and directions (f, n)."""
        C_y, C_v = self.law(response, gains)
        L = C_y @ response.position + C_v @ response.velocity
        position, velocity = response.deviations()
        dL = np.abs(np.diagonal(C_y, axis1=1, axis2=2))[:, :, None] * position
        dL += np.abs(np.diagonal(C_v, axis1=1, axis2=2))[:, :, None] * velocity
        return least_singular_values(L, dL, response.shared)

    def law(self, response: Response, gains: JointGains) -> tuple[Complex, Complex]:
        """Return C_y [N m/rad] and C_v [N m s/rad] (f, n, n) at the frequencies of a response."""
        s: Complex = np.asarray(2j * np.pi * response.frequency, complex)
        feedback = linear(gains, self.inertia, 1)
        C_y, C_v = (each[0] for each in law_responses(feedback, self.sample_time, s))
        return C_y, C_v


def least_singular_values(
    L: Complex, dL: Floats, shared: NDArray[np.bool_]
) -> tuple[Floats, Floats, Complex]:
    """Return the least singular values (f,) of I + L, their doubt (f,) and directions (f, n).

    `dL` (f, n, n) are the standard deviations of L, and `shared` as in `Response`.
    """
    left, values, right = np.linalg.svd(np.eye(L.shape[-1]) + L)
    # u^H (I + L) v changes by u^H dL v; what two share changes in both at once
    parts = np.abs(left[:, :, -1, None]) * dL * np.abs(right[:, -1, None, :])
    both = parts + np.swapaxes(parts, 1, 2)
    squares = np.where(shared, 0.5 * both**2, parts**2)
    doubt = DEVIATIONS * np.sqrt(squares.sum(axis=(1, 2)))
    return values[:, -1], np.asarray(doubt), right[:, -1].conj()


def choose(
    loops: Loops,
    start: JointGains,
    by_factors: Callable[[Floats], JointGains],
    rigid: RigidArm,
    margin: float = MARGIN,
    lags: Sequence[float] = LAGS,
) -> Choice:
    """Return the stiffest gains with the margin, of the measured and of the rigid arm.

    `start` are the gains of the measurement, `by_factors` the gains for factors (n,) on
    its damping, `lags` [s] those of the damping to try.
    """
    n = len(start.damping)

    def gains(lag: Floats, factors: Floats) -> JointGains:
        return by_factors(factors)._replace(damping_lag=lag)

    def is_borne(lag: Floats, factors: Floats) -> bool:
        return rigid.margin(gains(lag, factors), loops.inertia) >= margin

    def has_margin(lag: Floats, factors: Floats) -> bool:
        measured = loops.margin(gains(lag, factors)).value
        return measured >= margin and is_borne(lag, factors)

    lag = np.zeros(n)
    without_lag = factors = _without_lag(n, partial(has_margin, lag))
    if has_margin(lag, factors):
        fastest = min(each.frequency[-1] for each in loops.responses)
        factors, lag = _with_lags(factors, has_margin, lags, fastest)
    chosen = gains(lag, factors)
    raised = factors * np.where(np.eye(n, dtype=bool), _STEP, 1.0)
    return Choice(
        gains=chosen,
        factors=factors,
        without_lag=without_lag,
        margin=loops.margin(chosen),
        measured=loops.margin(start),
        by_inertia=np.array([not is_borne(lag, each) for each in raised]),
    )


def _without_lag(n: int, has_margin: Callable[[Floats], bool]) -> Floats:
    """Return the largest factors (n,) with the margin, of all joints and then of each."""
    factors = _LEAST * np.ones(n)
    while factors[0] * _STEP <= _MOST and has_margin(_STEP * factors):
        factors *= _STEP
    return _one_by_one(factors, has_margin, _most(factors))


def _most(factors: Floats) -> Floats:
    """Return the most (n,) that a factor may be where all joints have `factors` (n,)."""
    return np.minimum(_OF_ONE * np.maximum(factors, 1.0), _MOST)


def _with_lags(
    without: Floats,
    has_margin: Callable[[Floats, Floats], bool],
    lags: Sequence[float],
    fastest: float,
) -> tuple[Floats, Floats]:
    """Return the factors (n,) that lags of the damping allow, and these lags (n,) [s].

    Above the `fastest` frequency that is seen [Hz] a joint has no more damping than `without`
    (n,) a lag, so without one its gains stay.  Gains with lags are raised together from small
    ones, for every step to have the margin.
    """
    factors, lag = without, np.zeros(len(without))
    pays = True
    while pays:
        pays = False
        for j, more in product(range(len(factors)), lags):
            tried = lag.copy()
            tried[j] = more
            has_it = partial(has_margin, tried)
            if more <= lag[j] or not has_it(factors):
                continue
            most = without * np.hypot(1.0, 2.0 * np.pi * fastest * tried)
            grown = _one_by_one(factors, has_it, np.minimum(most, _MOST))
            gained = np.prod(grown / factors) > _STEP ** (_PAYS - 0.5)
            if gained and all(has_it(part * grown) for part in _RAISED):
                factors, lag, pays = grown, tried, True
    return factors, lag


def _one_by_one(
    factors: Floats, has_margin: Callable[[Floats], bool], most: Floats
) -> Floats:
    """Raise the factor (n,) of each joint in turns, to `most` (n,)."""
    grows = np.ones(len(factors), bool)
    while grows.any():
        for j in np.flatnonzero(grows):
            more = factors.copy()
            more[j] *= _STEP
            grows[j] = more[j] <= most[j] and has_margin(more)
            if grows[j]:
                factors = more
    return factors
