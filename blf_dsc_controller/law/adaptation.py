# SPDX-License-Identifier: Apache-2.0
"""Composite learning: the update law (20) with the latched prediction error (26).

    eps = b_e - Phi_e theta^                                theta^ = [P^; d^], the current estimate
    theta^' = Proj( -Gamma (H^T xi2 - kappa W eps) )        W = I, or (Phi_e + rho R)^-1 (newton)

    d^3' = -gamma (xi2 + eta d^3) - H (theta^' + Gamma H^T xi2)

As printed, (20) has + kappa eps, which drives P^ to the projection ball as soon as
learning starts.  H^T xi2 and the leakage W_c P^ of the comparison law (35) act on P^
alone.  With the Newton W every excited direction converges at the rate Gamma kappa;
with the gradient update the rates vary with the eigenvalues of Phi_e.

(30) lacks the last term.  While the estimate is wrong, d^3 compensates for it; the
prediction error then corrects the estimate within milliseconds, but d^3 follows only
within seconds, and their sum is wrong in between.  With the term (`bumpless`) learning
does not change the torque H P^ + d^3, and d^3 is left to estimate the disturbance
alone.

The update stays in a ball, in the metric of the adaptation gain.  As printed, (4) acts
where |P^| equals the radius, which a sampled update never hits: it steps over and never
returns.  Here the outward part is removed on and beyond the sphere, in the metric that
the Lyapunov function (29) uses for P~, and a step that leaves the ball ends at the
nearest point of the ball in that metric, which is never farther from a true P inside.
"""

from math import isfinite, sqrt

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.compiled.views import part
from blf_dsc_controller.law import friction
from blf_dsc_controller.law.clipping import clip
from blf_dsc_controller.law.state import NEWTON, Settings, Signals, State
from blf_dsc_controller.numerics.algebra import cholesky_solve

_ON_SPHERE = 1.0 - 1e-12  # of radius^2: `retract` ends within rounding of the sphere
_ROUNDED = 1.0 + 1e-14
# of Newton's method; 12 for Gamma spanning eight decades, ten radii outside
_MOST_STEPS = 20


@inner
def project(estimate: Array, rate: Array, gain: Array, radius: float) -> None:
    """Remove the outward part from `rate` v (p,):  v - Gamma w w^T v / (w^T Gamma w).

    `estimate` P^ (p,) is the direction w, `rate` is modified in place, `gain` (p,) is
    the diagonal of Gamma and `radius` omega_a.
    """
    square = 0.0
    outward = 0.0
    metric = 0.0
    for j in range(gain.size):
        square += estimate[j] * estimate[j]
        outward += estimate[j] * rate[j]
        metric += estimate[j] * gain[j] * estimate[j]
    if square >= _ON_SPHERE * radius * radius and outward > 0.0 and metric > 0.0:
        for j in range(gain.size):
            rate[j] -= gain[j] * estimate[j] * outward / metric


@inner
def retract(estimate: Array, gain: Array, radius: float) -> None:
    """Replace a P^ (p,) outside the ball by the nearest point in it, in the metric of Gamma.

    That is P^_j / (1 + nu Gamma_j) with the nu > 0 that gives it the length omega_a,
    found by Newton's method on 1 / length: exact after one step for equal gains,
    monotone otherwise.
    """
    square = 0.0
    for j in range(gain.size):
        square += estimate[j] * estimate[j]
    if not (square > radius * radius and isfinite(square)):
        return
    nu = 0.0
    length = radius
    for _ in range(_MOST_STEPS):
        # of the length of P^_j / (1 + nu Gamma_j): minus half the slope
        square, slope = 0.0, 0.0
        for j in range(gain.size):
            shrink = 1.0 + nu * gain[j]
            entry = estimate[j] / shrink
            square += entry * entry
            slope += gain[j] * entry * entry / shrink
        length = sqrt(square)
        if not (length > _ROUNDED * radius and slope > 0.0):
            break
        nu += (length / radius - 1.0) * length * length / slope
    rounding = min(1.0, radius / length)
    for j in range(gain.size):
        estimate[j] *= rounding / (1.0 + nu * gain[j])


@inner
def prediction_error(settings: Settings, state: State, signals: Signals) -> None:
    """Write W eps (m,) to `signals.rate`; zero while no window is latched."""
    for i in range(settings.m):
        signals.rate[i] = 0.0
    if state.latched[0] == 0.0:
        return
    for i in range(settings.m):
        signals.rate[i] = state.b[i]
        for j in range(settings.m):
            signals.rate[i] -= state.Phi[i, j] * state.estimate[j]
    if settings.update == NEWTON:
        cholesky_solve(state.factor, signals.rate)
    friction.follow_reversals(
        settings.friction,
        state.friction,
        signals.friction,
        state.active,
        state.estimate,
        signals.rate,
    )


@inner
def hand_over(settings: Settings, state: State, signals: Signals) -> None:
    """Subtract H (theta^ - `work`) from d^3; `work` is theta^ after the tracking error alone."""
    for j in range(settings.m):
        for i in range(settings.n):
            state.disturbance[i] -= signals.H[i, j] * (
                state.estimate[j] - signals.work[j]
            )


@inner
def hand_over_friction(settings: Settings, state: State, signals: Signals) -> None:
    """Subtract from d^3 what this sample has changed in the compensation of Coulomb friction."""
    friction.hand_over(
        settings.friction,
        state.friction,
        signals.friction,
        state.estimate,
        state.disturbance,
    )


@inner
def integrate(settings: Settings, state: State, signals: Signals, dt: float) -> None:
    """Advance d^3 by `dt` [s]: (30), with gamma (M(q, P^(0)) + J~) / m on an arm of a URDF.

    Overwrites Yp and Yr of `signals`.
    """
    for i in range(settings.n):
        error = signals.xi2[i] + settings.eta * state.disturbance[i]
        signals.unit[i] = dt * settings.gamma[i] * error
    if settings.follows_inertia == 1:
        scale_by_inertia(settings, state, signals)
    for i in range(settings.n):
        state.disturbance[i] -= signals.unit[i]
        friction.follow_observer(state.friction, signals.friction, i, -signals.unit[i])


@inner
def scale_by_inertia(settings: Settings, state: State, signals: Signals) -> None:
    """Replace x in `signals.unit` by (M(q, P^(0)) + J~) x / m; overwrites Yp and Yr."""
    x = signals.unit
    for i in range(settings.n):
        x[i] /= settings.joint_inertia[i]
    settings.model.momentum_regressor(signals.q, x, signals.Yp, signals.Yr)
    for i in range(settings.n):
        x[i] *= state.rotors.error[i]
        for j in range(settings.p):
            x[i] += signals.Yp[i, j] * settings.initial_estimate[j]


@inner
def adapt(
    settings: Settings, state: State, signals: Signals, dt: float, saturated: bool
) -> None:
    """Advance theta^ and d^3 by `dt` [s]: (20), (30).

    While a torque is saturated, the tracking error reflects the limit, not the
    parameters, so only the prediction error, which uses the applied torque, adapts the
    estimate.  While a full window is not excited, as at standstill, H^T xi2 is
    correlated noise and ignored (`change_detection`).  While a contact lasts, and
    something reacts to it, only d^3 follows.
    """
    if state.frozen[0] > 0.0:
        if not saturated:
            integrate(settings, state, signals, dt)
        hand_over_friction(settings, state, signals)
        return
    prediction_error(settings, state, signals)
    unexcited = (
        settings.change_detection == 1
        and state.rows[0] == settings.window
        and state.lambda_min[0] < settings.sigma
    )
    for j in range(settings.m):
        tracking = 0.0
        if j < settings.p and not saturated and not unexcited:
            for i in range(settings.n):
                tracking += signals.H[i, j] * signals.xi2[i]
            tracking = settings.variance[j] * tracking + settings.Wc * state.estimate[j]
        signals.work[j] = state.estimate[j] - dt * settings.Gamma[j] * tracking
        signals.rate[j] = settings.Gamma[j] * (
            settings.kappa * signals.rate[j] - tracking
        )
    p = settings.p
    parameters = part(state.estimate, 0, (p,))
    gain = part(settings.Gamma, 0, (p,))
    project(parameters, part(signals.rate, 0, (p,)), gain, settings.radius)
    for j in range(settings.m):
        estimate = state.estimate[j] + dt * signals.rate[j]
        state.estimate[j] = clip(estimate, settings.least[j], settings.most[j])
    retract(parameters, gain, settings.radius)
    if not saturated:
        integrate(settings, state, signals, dt)
    if settings.bumpless == 1 and state.latched[0] == 1.0:
        hand_over(settings, state, signals)
    if state.latched[0] == 1.0:
        friction.adapt_breakaway(
            settings.friction, state.friction, signals.friction, dt
        )
    hand_over_friction(settings, state, signals)
