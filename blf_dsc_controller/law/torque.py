# SPDX-License-Identifier: Apache-2.0
"""Torque: demand (28) of the proposed law or (35) of the comparison law, saturation, drives.

    tau = -dV/dxi1 - d2 |xi1| sat(xi2/b) - K_p xi2 + tau_m + d^3                                (28)
    tau = -w z1 - mu_bar sat(z2/b) - K_p z2 + H P^                                             (35)

(28) prints the robust term with sgn; sat is its smooth replacement.  The paper's compensation is
tau_m = H(q, dq, alpha2, alpha2') P^ (`compensation: state`).  alpha2' contains the feedback, which
is thus multiplied by the learned inertia: an estimate of 2.65 times the inertia makes a loop at 1
kHz unstable.  So what is learned acts along the reference only, and the feedback keeps the model
from before the start, as in the desired compensation law of Sadegh and Horowitz (1990):

    tau_m = H(q, dq, alpha2, alpha2' - omega_v xi2) P^(0) + H(qr, dqr, dqr, ddqr) (P^ - P^(0))

A wrong estimate is then a bounded disturbance, never a gain.  Where the inertias are roughly known,
the damping can scale with them: - omega_v M(q, P^(0)) xi2, part of the first term, is added to
- K_p xi2 and damps every direction at the same rate.

*Drives.*  This is the one place where torques of the law become commands of the drive, and back.
The law reckons with the whole torque of a joint.  A drive may add the torque that holds the arm
against gravity itself, by its own model of the arm and of the payload it has been told of:

    whole torque = command + G_d(q)

`find_added` computes G_d(q); `saturate` subtracts it from what leaves, and `find_applied` adds it
to what enters.  Friction that a drive compensates is not reckoned with on either side: the friction
columns then describe what is left of it (`Robot.friction`).  A drive that adds nothing has no
columns here, and all sums are with zero, which changes no bit.

*Saturation* is in level and rate.  The level limit holds for the whole torque of the joint, which
is what its motor bears, and for the command alone, which is what its driver may cut: the two differ
by what the drive adds.  The rate is that of the command, and not limited at the first
sample after a reset.  The level limit takes precedence, for example if it is lowered below the last
torque.
"""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.arms.model import regressors_at
from blf_dsc_controller.arms.serial_chain import SerialChain, fill_regressor
from blf_dsc_controller.compiled.elementary import sin
from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.law import barrier
from blf_dsc_controller.law.state import LINEAR, Settings, Signals, State

_LAYER = 0.01  # b, rad/s: xi2 at which the robust term saturates

LEVEL_CUT = 1.0
RATE_CUT = 2.0


@inner
def clip(x: float, low: float, high: float) -> float:
    """Limit x to [low, high]; NaN passes through."""
    if x < low:
        return low
    if x > high:
        return high
    return x


@inner
def known_disturbance(settings: Settings, signals: Signals, t: float) -> None:
    """Compute the known disturbance `signals.known` (n,) [N m] at time t [s]."""
    if settings.truth_known == 0 and settings.feed_forward == 0:
        return
    d = settings.true_disturbance
    for i in range(settings.n):
        signals.known[i] = d[0, i] + d[1, i] * sin(d[2, i] * t + d[3, i])


@inner
def feedback(settings: Settings, state: State, signals: Signals, i: int) -> float:
    """Return the feedback of joint i [N m]: barrier (16), robust term and damping of (28), (35)."""
    robust = settings.d2[i] * abs(signals.xi1[i]) + settings.mu_bar[i]
    torque = settings.Kp[i] * signals.xi2[i]
    torque += robust * clip(signals.xi2[i] / _LAYER, -1.0, 1.0)
    if settings.surface == LINEAR:
        return float(-torque - settings.weight[i] * signals.xi1[i])
    slope = barrier.gradient(
        signals.xi1[i],
        signals.bound[i],
        settings.weight[i],
        settings.slope_limit[i],
        signals.knee[i],
    )
    return float(-torque) - float(state.gain_scale[i] * slope)


@inner
def compute_demand(settings: Settings, state: State, signals: Signals) -> None:
    """Compute the torque (28) or (35) before saturation, `signals.demand` (n,) [N m]."""
    for i in range(settings.n):
        torque = feedback(settings, state, signals, i) + signals.model_torque[i]
        torque += state.disturbance[i]
        if settings.feed_forward == 1:
            torque += signals.known[i]
        for j in range(settings.m):
            learned = state.estimate[j]
            if j < settings.p:
                learned -= settings.initial_estimate[j]
            torque += signals.H[i, j] * learned
        signals.demand[i] = torque


@inner
def find_added(settings: Settings, signals: Signals) -> None:
    """Write G_d(q) to `signals.added` (n,) [N m]."""
    if settings.drive == 0:
        return
    still = signals.still
    fill_regressor(settings.drive_chain, signals.q, still, still, still, signals.drive)
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
def saturate(settings: Settings, state: State, signals: Signals, dt: float) -> bool:
    """Limit `signals.demand`, giving the command `signals.torque` [N m]; return whether it is cut.

    `dt` [s] is the time since the last torque.
    """
    saturated = False
    for i in range(settings.n):
        top = settings.torque_limit[i]
        added = signals.added[i]
        low, high = max(-top, added - top), min(top, added + top)
        torque = clip(signals.demand[i], low, high)
        signals.cuts[i] = 0.0
        if torque != signals.demand[i]:
            signals.cuts[i] = LEVEL_CUT
            state.level_cuts[i] += 1.0
        if settings.rate_limit[i] > 0.0 and state.samples[0] > 0.0:
            step = settings.rate_limit[i] * dt
            last = state.torque[i] + added
            slowed = clip(torque, last - step, last + step)
            if slowed != torque:
                signals.cuts[i] += RATE_CUT
                state.rate_cuts[i] += 1.0
            torque = clip(slowed, low, high)
        signals.torque[i] = torque - added
        saturated = saturated or signals.cuts[i] > 0.0
    return saturated
