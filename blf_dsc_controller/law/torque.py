# SPDX-License-Identifier: Apache-2.0
"""Torque demand before saturation: (28) of the proposed law and (35) of the comparison law.

    tau = -dV/dxi1 - d2 |xi1| sat(xi2/b) - K_p xi2 + tau_m + d^3                                (28)
    tau = -w z1 - mu_bar sat(z2/b) - K_p z2 + H P^                                             (35)

(28) prints the robust term with sgn; sat is its smooth replacement.  The paper's compensation is
tau_m = H(q, dq, alpha2, alpha2') P^ (`compensation: state`).  alpha2' contains the feedback, which
is thus multiplied by the learned inertia: an estimate of 2.65 times the inertia makes a loop at
1 kHz unstable.  So what is learned acts along the reference only, and the feedback keeps the model
from before the start, as in the desired compensation law of Sadegh and Horowitz (1990):

    tau_m = H(q, dq, alpha2, alpha2' - omega_v xi2) P^(0) + H(qr, dqr, dqr, ddqr) (P^ - P^(0))

A wrong estimate is then a bounded disturbance, never a gain.  Where the inertias are roughly known,
the damping can scale with them: - omega_v M(q, P^(0)) xi2, part of the first term, is added to
- K_p xi2 and damps every direction at the same rate.
"""

from math import sin

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.law import barrier
from blf_dsc_controller.law.settings import LINEAR, Settings
from blf_dsc_controller.law.state import Signals, State


@inner
def smooth_sign(x: float) -> float:
    """Return sat(x): x limited to [-1, 1]."""
    return min(1.0, max(-1.0, x))


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
    torque += robust * smooth_sign(signals.xi2[i] / settings.boundary_layer)
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
