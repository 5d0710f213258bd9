# SPDX-License-Identifier: Apache-2.0
"""What makers of arms run on their joints: a PD over gravity, as a law of a file.

    tau = - s (K e + D e') + G(q),   e = q - qr

K is `feedback.joint_stiffness` [N m/rad], D `feedback.joint_damping` [N m s/rad], G the gravity of
P^(0).
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

from blf_dsc_controller.configuration.schema import positive
from blf_dsc_controller.law.state import Settings, Signals, State


class JointPD(NamedTuple):
    """Stiffness and damping of each joint over gravity."""

    scale: Annotated[float, positive(1.0, 'factor on stiffness and damping', '', 's')]

    @property
    def has_barrier(self) -> bool:
        """Nothing keeps the error inside a bound."""
        return False

    def compute_demand(
        self, settings: Settings, state: State, signals: Signals, t: float, dt: float
    ) -> None:
        """Write the torque to `signals.demand`."""
        at_rest, H = signals.dalpha2, signals.H
        for i in range(settings.n):
            at_rest[i] = 0.0
        settings.model.regressor(signals.q, at_rest, at_rest, at_rest, H)
        for i in range(settings.n):
            D = settings.feedback.gain[i]
            K = settings.barrier.weight[i]
            K += D * (settings.surface.gain[i] / 2.0 + settings.surface.mu[i])
            error, rate = signals.xi1[i], signals.dq[i] - signals.dqr[i]
            signals.demand[i] = -self.scale * (K * error + D * rate)
            for j in range(settings.p):
                signals.demand[i] += H[i, j] * settings.initial_estimate[j]

    def finish(
        self,
        settings: Settings,
        state: State,
        signals: Signals,
        dt: float,
        saturated: bool,
    ) -> None:
        """Keep nothing."""


LAW = JointPD
