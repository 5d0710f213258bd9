# SPDX-License-Identifier: Apache-2.0
"""Torques of the law become commands of the drives here, and back: saturation, what drives add.

*Drives.*  A law computes with the whole torque of a joint.  A drive may add the torque that holds
the arm against gravity itself, by its own model of the arm and of the payload that it knows:

    whole torque = command + G_d(q)

`find_added` computes G_d(q); `saturate` subtracts it from the output, and
`find_applied` adds it to the torque of the last interval.  Friction that a drive
compensates appears on neither side: the friction columns then describe what is left of
it (`Robot.friction`).  A drive that adds nothing has no columns here, and all sums are
with zero, which changes no bit.

*Saturation* is in level and rate.  The level limit holds for the whole torque of the joint, which
is what its motor bears, and for the command alone, which is what its driver may cut: the two differ
by what the drive adds.  The rate is that of the command, and not limited at the first
sample, unless another torque acts by then (`Controller.take_over`).  The level limit takes
precedence, for example if it is lowered below the last torque.

*What the rate limit holds back.*  A torque that always moves towards its demand still climbs to it
while the demand falls already: it lags behind, the more the larger the motion, and a loop that has
met its limit once may run away.  So the torque moves as its demand does, within the limit, and the
difference is released at a share r of the limit:

    |held - held'| <= r R dt,      torque = demand - held', within R dt of the last

It turns round as soon as the demand moves back faster than r R.  For a sinusoid the lag thus stays
below asin r, 30 degrees, whatever the amplitude: the limit lowers the gain of the loop instead.
"""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.arms.model import regressors_at
from blf_dsc_controller.arms.serial_chain import SerialChain, fill_regressor
from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.law.clipping import clip
from blf_dsc_controller.law.state import Settings, Signals, State
from blf_dsc_controller.numerics.elementary import sin

_RELEASED = 0.5  # r

LEVEL_CUT = 1.0
RATE_CUT = 2.0


@inner
def update_feedforward(settings: Settings, signals: Signals, t: float) -> None:
    """Compute the known disturbance `signals.feedforward` (n,) [N m] at time t [s]."""
    if settings.truth_known == 0 and settings.feed_forward == 0:
        return
    d = settings.true_disturbance
    for i in range(settings.n):
        signals.feedforward[i] = d[0, i] + d[1, i] * sin(d[2, i] * t + d[3, i])


@inner
def find_added(settings: Settings, signals: Signals) -> None:
    """Write G_d(q) to `signals.added` (n,) [N m]."""
    if settings.drive == 0:
        return
    zeros = signals.zeros
    fill_regressor(settings.drive_chain, signals.q, zeros, zeros, zeros, signals.drive)
    for i in range(settings.n):
        signals.added[i] = 0.0
        for j in range(settings.drive):
            signals.added[i] += signals.drive[i, j] * settings.drive_inertias[j]


@inner
def find_applied(settings: Settings, state: State, signals: Signals) -> None:
    """Write the mean whole torque of the last interval to `signals.applied` (n,) [N m].

    It is the last command and the mean of G_d at both ends.
    """
    for i in range(settings.n):
        signals.applied[i] = state.torque[i] + 0.5 * (state.added[i] + signals.added[i])
        state.added[i] = signals.added[i]


def added_torque(settings: Settings, q: Array) -> Array:
    """Return G_d(q) (n,) [N m] at a position q (n,)."""
    if settings.drive == 0:
        return np.zeros(settings.n)
    chain = SerialChain(settings.n, settings.drive, settings.drive_chain)
    (H,) = regressors_at(chain, q[np.newaxis], *np.zeros((3, 1, settings.n)))
    return np.asarray(H @ settings.drive_inertias)


@inner
def slow_down(demand: float, last: float, held: float, step: float) -> float:
    """Return the torque [N m] for a demand, by at most `step` from `last`, less what is `held`."""
    released = clip(held, -_RELEASED * step, _RELEASED * step)
    return clip(demand - (held - released), last - step, last + step)


@inner
def saturate(settings: Settings, state: State, signals: Signals, dt: float) -> bool:
    """Limit `signals.demand`, giving the command `signals.torque` [N m]; return whether it is cut.

    `dt` [s] is the time since the last torque.
    """
    saturated = False
    has_last = state.samples[0] > 0.0 or state.takes_over[0] > 0.0
    for i in range(settings.n):
        top = settings.torque_limit[i]
        added = signals.added[i]
        low = max(-top, added - top)
        high = min(top, added + top)
        torque = clip(signals.demand[i], low, high)
        signals.cuts[i] = 0.0
        if torque != signals.demand[i]:
            signals.cuts[i] = LEVEL_CUT
            state.level_cuts[i] += 1.0
        if settings.rate_limit[i] > 0.0 and has_last:
            step = settings.rate_limit[i] * dt
            last = state.torque[i] + added
            slowed = slow_down(torque, last, state.held_back[i], step)
            if slowed != torque:
                signals.cuts[i] += RATE_CUT
                state.rate_cuts[i] += 1.0
            slowed = clip(slowed, low, high)
            state.held_back[i] = torque - slowed
            torque = slowed
        else:
            state.held_back[i] = 0.0
        signals.torque[i] = torque - added
        saturated = saturated or signals.cuts[i] > 0.0
    return saturated
