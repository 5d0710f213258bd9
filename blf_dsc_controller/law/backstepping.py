# SPDX-License-Identifier: Apache-2.0
"""The laws that the paper compares itself with: backstepping (35), and Slotine-Li.

    z1 = q - qr,    alpha2 = dqr - lambda_s z1,    z2 = dq - alpha2
    tau = H P^ - K_p z2 - w z1 - mu_bar sat(z2 / b)                                    (35)
    P^' = -Gamma (H^T z2 + W_c P^)

Slotine and Li's law has neither the position gain w nor mu_bar nor the leakage W_c; it
may have the integral of z2, by (30).  Both adapt by the tracking error alone.
"""

from __future__ import annotations

from typing import NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.law import feedback, learning
from blf_dsc_controller.law.clipping import clip
from blf_dsc_controller.law.compensation import compensated, follow_rotors
from blf_dsc_controller.law.state import Settings, Signals, State


class Backstepping(NamedTuple):
    """The law (35), and Slotine-Li."""

    layer: float = 0.01  # b, rad/s: z2 at which the robust term saturates

    @property
    def has_barrier(self) -> bool:
        """Nothing keeps the error inside a bound."""
        return False

    def compute_demand(
        self, settings: Settings, state: State, signals: Signals, t: float, dt: float
    ) -> None:
        """Compute the torque (35)."""
        compute_surface(settings, state, signals)
        learning.observe(settings, state, signals, t, dt)
        follow_rotors(settings, state, signals, dt)
        of = settings.feedback
        begins = state.samples[0] == 0.0
        feedback.advance(of, state.feedback, signals.xi2, begins, dt)
        for i in range(settings.n):
            torque = of.gain[i] * feedback.damped(of, state.feedback, signals.xi2, i)
            torque += settings.robust_gain[i] * clip(
                signals.xi2[i] / self.layer, -1.0, 1.0
            )
            torque = -torque
            if of.follows_inertia == 0:
                torque += signals.feedback.restoring[i]
            signals.demand[i] = compensated(settings, state, signals, i, torque)

    def finish(
        self,
        settings: Settings,
        state: State,
        signals: Signals,
        dt: float,
        saturated: bool,
    ) -> None:
        """Adapt P^, and the integral of z2 if there is one."""
        learning.adapt(settings, state, signals, dt, saturated)


@inner
def compute_surface(settings: Settings, state: State, signals: Signals) -> None:
    """Compute alpha2 = dqr - lambda_s z1, its derivative, which needs ddqr, and z2."""
    for i in range(settings.n):
        state.alpha2[i] = signals.dqr[i] - settings.surface.gain[i] * signals.xi1[i]
        rate = signals.dq[i] - signals.dqr[i]
        signals.dalpha2[i] = signals.ddqr[i] - settings.surface.gain[i] * rate
        signals.xi2[i] = signals.dq[i] - state.alpha2[i]
        restoring = -settings.barrier.weight[i] * signals.xi1[i]
        signals.feedback.restoring[i] = restoring
