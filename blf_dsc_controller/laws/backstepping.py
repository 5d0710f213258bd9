# SPDX-License-Identifier: Apache-2.0
"""The law (35) that the paper compares itself with: backstepping on a linear surface.

    tau = H(q, dq, alpha2, alpha2') P^ - K_p z2 - w z1 - mu_bar sat(z2 / b)            (35)
    P^' = -Gamma (H^T z2 + W_c P^)

z1, z2 and alpha2 are those of `linear_surface`, K_p and Gamma those of `blf_dsc`.  It adapts
by the tracking error alone.
"""

from typing import Annotated, NamedTuple

from blf_dsc_controller.configuration.schema import non_negative, positive
from blf_dsc_controller.law.clipping import clip
from blf_dsc_controller.law.compensation import compensated
from blf_dsc_controller.law.state import Settings, Signals, State
from blf_dsc_controller.laws import linear_surface


class Backstepping(NamedTuple):
    """The law (35)."""

    surface_gain: Annotated[
        float, positive(70.0, 'gain of the linear surface', '1/s', 'lambda_s')
    ]
    position_gain: Annotated[
        float, non_negative(1.0, 'gain on the tracking error', 'N m/rad', 'w')
    ]
    robust_gain: Annotated[
        float, non_negative(0.0, 'amplitude of the robust term', 'N m', 'mu_bar')
    ]
    leakage: Annotated[float, non_negative(0.001, 'leakage of P^', symbol='W_c')]
    layer: Annotated[
        float, positive(0.01, 'z2 at which the robust term saturates', 'rad/s', 'b')
    ]

    @property
    def has_barrier(self) -> bool:
        """Nothing keeps the error inside a bound."""
        return False

    def compute_demand(
        self, settings: Settings, state: State, signals: Signals, t: float, dt: float
    ) -> None:
        """Compute the torque (35)."""
        gains = self.surface_gain, self.position_gain
        linear_surface.follow(settings, state, signals, *gains, dt)
        for i in range(settings.n):
            z2 = signals.xi2[i]
            torque = -settings.feedback.gain[i] * z2
            torque -= self.robust_gain * clip(z2 / self.layer, -1.0, 1.0)
            if settings.feedback.follows_inertia == 0:  # else it is in `model_torque`
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
        """Adapt P^, unless a torque was cut."""
        if not saturated:
            linear_surface.adapt(settings, state, signals, 0.0, self.leakage, dt)


LAW = Backstepping
