# SPDX-License-Identifier: Apache-2.0
"""Gains by what was measured: the stiffest with a modulus margin, in every posture.

With small gains the loop is stable.  Raised step by step, they can only make it unstable
where a singular value of I + L (`margin`) passes zero, so every step on the way must have
the margin.

First the stiffness and damping of all joints grow together, then those of each joint by
itself, in turns, as far as the margin allows.  Then the damping of one joint after the other
may lag (`feedback.joint_damping_lag`), where that lets gains grow further.  A lag pays where
encoders are at the links and motors are heavy, and costs elsewhere.  Gains of joints without a
lag stay, since lighter joints may be limited by what is faster than the motion shows.  A lag
that gives next to nothing is none.

A rigid joint of the measured inertia and lags must have the margin, too (`RigidArm`).  What is
measured is stable with more only where friction damps it, or where it is not seen.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.joint_gains import JointGains
from blf_dsc_controller.arms.known_gears import MARGIN
from blf_dsc_controller.commissioning.margin import Loops, Margin, RigidArm

Floats = NDArray[np.float64]

LAGS = (0.002, 0.003, 0.005, 0.008, 0.012)
"""Lags of the damping of a joint [s] that are tried, one after the other."""

_STEP = 1.1  # from one factor on the gains that is tried to the next
_PAYS = 2  # steps of gains, of all joints together, for which a lag is chosen
_LEAST, _MOST = 0.05, 100.0  # times the damping of the measurement
_RAISED = _STEP ** np.arange(-30.0, 0.0)  # of gains, from small ones
# Of one joint by itself, times that of all joints, or that of the measurement, if this is more.
_OF_ONE = 5.0


class Choice(NamedTuple):
    """Chosen gains, and what limits them."""

    gains: JointGains
    factors: Floats  # (n,) on the damping of the measurement
    without_lag: Floats  # (n,) likewise, of the gains if no damping lagged
    margin: Margin
    measured: Margin  # of the gains with which the arm was measured
    # (n,), joints for which more is too much for a rigid arm
    by_inertia: NDArray[np.bool_]


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
