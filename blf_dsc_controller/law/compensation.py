# SPDX-License-Identifier: Apache-2.0
"""Torque of the model in a law: P^(0) at the state, what is learned along the reference.

The paper's compensation is H(q, dq, alpha2, alpha2') P^.
alpha2' contains the feedback, which is thus multiplied by the learned inertia: an
estimate of 2.3 times the inertia makes a loop at 1 kHz unstable.  So what is learned
acts along the reference only, and the feedback keeps the model from before the start,
as in the desired compensation law of Sadegh and Horowitz (1990):

    tau_m = H(q, dq, alpha2, alpha2' - omega_v xi2) P^(0) + H(qr, dqr, dqr, ddqr) (P^ - P^(0))

A wrong estimate is then a bounded disturbance, never a gain.  Where the inertias are roughly known,
the damping can scale with them: - omega_v M(q, P^(0)) xi2, part of the first term, is added to
- K_p xi2 and damps every direction at the same rate.  The torque by the error, the barrier's, may
act through M(q, P^(0)) as well: as the acceleration -dV/dxi1 / m of each joint, m being its least
inertia.

All of this multiplies the feedback by an inertia that motors behind elastic gears do not have.
`decoupled`, the default of an arm from a URDF, has the model along the reference alone,

    tau_m = H(q, dq, dqr, ddqr) P^(0) + H(qr, dqr, dqr, ddqr) (P^ - P^(0))

and the feedback is that of each joint on its own.
"""

from __future__ import annotations

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.law import columns, friction
from blf_dsc_controller.law.state import Settings, Signals, State


@inner
def fill_model(settings: Settings, state: State, signals: Signals) -> None:
    """Compute H, Yp and Yr at the state, and H P^(0) as `signals.model_torque` (n,) [N m].

    v and a of H(q, dq, v, a) are alpha2 and a_f of `feedback`; with `decoupled` joints dqr and
    ddqr, so that no feedback passes the inertia.  Yp and Yr are for the row (`prediction`).
    """
    gains, row = settings.feedback, signals.row
    H, a_f = signals.H, signals.feedback.acceleration
    v, a = state.alpha2, signals.dalpha2
    if gains.decoupled == 1:
        v, a = signals.dqr, signals.ddqr
    for i in range(settings.n):
        a_f[i] = a[i] - gains.damping_rate * signals.xi2[i]
        if gains.follows_inertia == 1:
            a_f[i] += signals.feedback.restoring[i] / settings.joint_inertia[i]
    settings.model.regressors(signals.q, signals.dq, v, a_f, H, row.Yp, row.Yr)
    for i in range(settings.n):
        signals.model_torque[i] = 0.0
        for j in range(settings.p):
            signals.model_torque[i] += H[i, j] * settings.initial_estimate[j]


@inner
def compute_regressors(settings: Settings, state: State, signals: Signals) -> None:
    """Compute H P^(0) of the feedback, Yp and Yr of the row, and H of what is learned.

    The last is H(qr, dqr, dqr, ddqr), along the reference (Sadegh and Horowitz 1990).
    """
    fill_model(settings, state, signals)
    dqr, ddqr = signals.dqr, signals.ddqr
    settings.model.regressor(signals.qr, dqr, dqr, ddqr, signals.H)


@inner
def compute_regressors_at_state(
    settings: Settings, state: State, signals: Signals
) -> None:
    """Compute the same with H(q, dq, alpha2, alpha2') of what is learned: (28) as printed."""
    fill_model(settings, state, signals)
    gains = settings.feedback
    if gains.damping_rate > 0.0 or gains.follows_inertia == 1:
        q, dq = signals.q, signals.dq
        settings.model.regressor(q, dq, state.alpha2, signals.dalpha2, signals.H)


@inner
def fill_learned(settings: Settings, state: State, signals: Signals, dt: float) -> None:
    """Write the known friction to `signals.friction`, and what is linear in theta to H.

    Both are taken where the reference is when the torque acts, 1.5 samples and half of
    `robot.lag` late.  The measured velocity would feed its noise, and chatter at rest,
    into the torque.  The p first columns of H are those along the reference.
    """
    lead = 1.5 * dt + 0.5 * settings.row.lag
    H, friction_values = signals.H, signals.friction
    for i in range(settings.n):
        dqr, ddqr = signals.dqr[i], signals.ddqr[i]
        velocity = dqr + lead * ddqr
        friction.compensate(
            settings.friction,
            state.friction,
            friction_values,
            state.estimate,
            velocity,
            i,
        )
        load = 0.0
        for j in range(settings.p):
            load += H[i, j] * state.estimate[j]
        signals.gear_torque[i] = load
        position = signals.qr[i] + lead * (dqr + 0.5 * lead * ddqr)
        at = columns.Point(0.0, position, velocity, friction_values.sign[i], load)
        columns.fill(settings.columns, columns.COMPENSATED, i, at, H)


@inner
def fill_known_torque(
    settings: Settings, state: State, signals: Signals, v: Array, a: Array, dt: float
) -> None:
    """Write H(q, dq, v, a) P^(0) and the known friction to `signals.model_torque` (n,) [N m].

    v (n,) [rad/s] and a (n,) [rad/s^2] are what a computed-torque law asks for.  The friction is
    that at dqr; `dt` [s] is the sample time.
    """
    H = signals.H
    settings.model.regressor(signals.q, signals.dq, v, a, H)
    fill_learned(settings, state, signals, dt)
    for i in range(settings.n):
        signals.model_torque[i] = signals.friction.torque[i]
        for j in range(settings.m):
            signals.model_torque[i] += H[i, j] * settings.initial_estimate[j]


@inner
def compensated(
    settings: Settings, state: State, signals: Signals, i: int, feedback: float
) -> float:
    """Return the demand of joint i [N m]: feedback, model, d^3, friction and what is learned.

        tau = tau_f + H P^(0) + d^3 + friction + r + H (theta^ - [P^(0); 0])

    `feedback` is tau_f [N m].  r of the `load_observer` is zero without joint torque sensors.
    """
    torque = feedback + signals.model_torque[i]
    torque += state.disturbance[i] + signals.friction.torque[i]
    if settings.observer.enabled == 1:
        torque += state.observer.torque[i]
    for j in range(settings.m):
        learned = state.estimate[j]
        if j < settings.p:
            learned -= settings.initial_estimate[j]
        torque += signals.H[i, j] * learned
    return float(torque)
