# SPDX-License-Identifier: Apache-2.0
"""The linear surface of `backstepping` and `slotine_li`, and adaptation by it alone.

z1 = q - qr,    alpha2 = dqr - lambda_s z1,    z2 = dq - alpha2
P^' = -Gamma (H^T z2 + W_c P^)
"""

from __future__ import annotations

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.views import part
from blf_dsc_controller.law import adaptation
from blf_dsc_controller.law.compensation import (
    compute_regressors_at_state,
    fill_learned,
)
from blf_dsc_controller.law.state import Settings, Signals, State


@inner
def follow(
    settings: Settings,
    state: State,
    signals: Signals,
    gain: float,
    weight: float,
    dt: float,
) -> None:
    """Compute alpha2, its derivative, which needs ddqr, z2, and the torque of the model.

    `gain` is lambda_s [1/s], `weight` w [N m/rad] of the torque by the error, -w z1.
    """
    for i in range(settings.n):
        rate = signals.dq[i] - signals.dqr[i]
        state.alpha2[i] = signals.dqr[i] - gain * signals.xi1[i]
        signals.dalpha2[i] = signals.ddqr[i] - gain * rate
        signals.xi2[i] = signals.dq[i] - state.alpha2[i]
        signals.feedback.restoring[i] = -weight * signals.xi1[i]
    compute_regressors_at_state(settings, state, signals)
    fill_learned(settings, state, signals, dt)


@inner
def adapt(
    settings: Settings,
    state: State,
    signals: Signals,
    given: float,
    leakage: float,
    dt: float,
) -> None:
    """Advance P^ by `dt` [s], inside its ball; `given` is Gamma, 0: that of `blf_dsc`.

    `leakage` is W_c.
    """
    of, H = settings.adaptation, signals.H
    p = settings.p
    for j in range(p):
        gain = of.adaptation_gain[j]
        if gain > 0.0 and given > 0.0:
            gain = given
        tracking = 0.0
        for i in range(settings.n):
            tracking += H[i, j] * signals.xi2[i]
        tracking = of.variance[j] * tracking + leakage * state.estimate[j]
        state.estimate[j] -= dt * gain * tracking
    parameters = part(state.estimate, 0, (p,))
    adaptation.retract(parameters, part(of.adaptation_gain, 0, (p,)), of.radius)
