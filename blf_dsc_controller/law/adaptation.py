# SPDX-License-Identifier: Apache-2.0
"""Composite learning: the update law (20) with the latched prediction error (26).

    eps = b_e - Phi_e theta^                                theta^ = [P^; d^], the current one
    theta^' = Proj( -Gamma (H^T xi2 - kappa W eps) )        W = I, or (Phi_e + rho I)^-1 (newton)

    d^3' = -gamma (xi2 + eta d^3) - H (theta^' + Gamma H^T xi2)

(20) prints + kappa eps, which drives P^ to the projection ball as soon as learning starts.
H^T xi2, with the leakage W_c P^ of the comparison law (35), acts on P^ alone.  With Newton's W
every excited direction converges at the rate Gamma kappa; the gradient's rates are spread as the
eigenvalues of Phi_e.

(30) lacks the last term.  As long as the estimate is wrong, d^3 makes up for it; the prediction
error then corrects the estimate within milliseconds but d^3 follows within seconds, and their sum
is wrong in between.  With the term (`bumpless`) learning does not change the torque H P^ + d^3,
and d^3 is left with the disturbance.
"""

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.views import part
from blf_dsc_controller.law import cholesky, projection
from blf_dsc_controller.law.settings import NEWTON, Settings
from blf_dsc_controller.law.state import Signals, State


@inner
def prediction_error(settings: Settings, state: State, signals: Signals) -> None:
    """Compute W eps (m,) in `signals.rate`; zero before the first latch."""
    for i in range(settings.m):
        signals.rate[i] = 0.0
    if state.latched[0] == 0.0:
        return
    for i in range(settings.m):
        signals.rate[i] = state.b[i]
        for j in range(settings.m):
            signals.rate[i] -= state.Phi[i, j] * state.estimate[j]
    if settings.update == NEWTON:
        cholesky.solve(state.factor, signals.rate)


@inner
def hand_over(settings: Settings, state: State, signals: Signals) -> None:
    """Take off d^3 what the estimate differs from `signals.work`, that by the tracking error."""
    for j in range(settings.m):
        for i in range(settings.n):
            state.disturbance[i] -= signals.H[i, j] * (state.estimate[j] - signals.work[j])


@inner
def adapt(settings: Settings, state: State, signals: Signals, dt: float, saturated: bool) -> None:
    """Step theta^ and d^3 by `dt` [s]: (20), (30).

    While a torque is saturated the tracking error reflects the limit, not the parameters: then only
    the prediction error, which uses the applied torque, adapts.  Where a full window is not
    excited, as in standing still, H^T xi2 is correlated noise and P^ is held (`change_detection`).
    """
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
        signals.rate[j] = settings.Gamma[j] * (settings.kappa * signals.rate[j] - tracking)
    p = settings.p
    parameters = part(state.estimate, 0, (p,))
    gain = part(settings.Gamma, 0, (p,))
    projection.project(parameters, part(signals.rate, 0, (p,)), gain, settings.radius)
    for j in range(settings.m):
        state.estimate[j] += dt * signals.rate[j]
    projection.retract(parameters, gain, settings.radius)
    if not saturated:
        for i in range(settings.n):
            state.disturbance[i] -= (
                dt * settings.gamma[i] * (signals.xi2[i] + settings.eta * state.disturbance[i])
            )
    if settings.bumpless == 1 and state.latched[0] == 1.0:
        hand_over(settings, state, signals)
