# SPDX-License-Identifier: Apache-2.0
"""The adaptive law of Slotine and Li, with an integral if one is given.

    tau = H(q, dq, alpha2, alpha2') P^ - K_p z2 + d^3
    P^' = -Gamma H^T z2,    d^3' = -gamma z2

z2 and alpha2 are those of `linear_surface`, K_p is that of `blf_dsc`, and gamma is
`disturbance.gain`: 0 as published.  It adapts by the tracking error alone.
"""

from typing import Annotated, NamedTuple

from blf_dsc_controller.configuration.schema import non_negative, positive
from blf_dsc_controller.law.compensation import compensated
from blf_dsc_controller.law.learning import follow_disturbance
from blf_dsc_controller.law.state import Settings, Signals, State
from blf_dsc_controller.laws import linear_surface


class SlotineLi(NamedTuple):
    """Slotine and Li's law."""

    surface_gain: Annotated[
        float, positive(70.0, 'gain of the linear surface', '1/s', 'lambda_s')
    ]
    adaptation_gain: Annotated[
        float,
        non_negative(
            0.0, 'adaptation gain of each parameter; 0: that of blf_dsc', symbol='Gamma'
        ),
    ]

    @property
    def has_barrier(self) -> bool:
        """Nothing keeps the error inside a bound."""
        return False

    def compute_demand(
        self, settings: Settings, state: State, signals: Signals, t: float, dt: float
    ) -> None:
        """Compute the torque."""
        linear_surface.follow(settings, state, signals, self.surface_gain, 0.0, dt)
        for i in range(settings.n):
            torque = -settings.feedback.gain[i] * signals.xi2[i]
            signals.demand[i] = compensated(settings, state, signals, i, torque)

    def finish(
        self,
        settings: Settings,
        state: State,
        signals: Signals,
        dt: float,
        saturated: bool,
    ) -> None:
        """Adapt P^ and the integral of z2, unless a torque was cut."""
        if saturated:
            return
        gain = self.adaptation_gain
        linear_surface.adapt(settings, state, signals, gain, 0.0, dt)
        follow_disturbance(settings, state, signals, dt)


LAW = SlotineLi
