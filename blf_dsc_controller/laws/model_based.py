# SPDX-License-Identifier: Apache-2.0
"""The model-based law (16) of Section III-A: (28) with everything known.

    tau = -dV/dxi1 - K_p xi2 + H(q, dq, alpha2, alpha2') P + d(t)
    d(t) = constant + amplitude sin(frequency t + phase)                              [N m]

The true parameters P are `two_link.initial_estimate`; the disturbance d(t), the same on each
joint, is known, too.  Nothing adapts.
"""

from typing import Annotated, NamedTuple

from blf_dsc_controller.configuration.schema import non_negative, parameter
from blf_dsc_controller.law.blf_dsc import advance_surface, compute_surface
from blf_dsc_controller.law.compensation import (
    compensated,
    compute_regressors_at_state,
    fill_learned,
)
from blf_dsc_controller.law.state import Settings, Signals, State
from blf_dsc_controller.numerics.elementary import sin


class ModelBased(NamedTuple):
    """The law (16)."""

    constant: Annotated[
        float, parameter(0.0, 'constant part of the known disturbance', 'N m')
    ]
    amplitude: Annotated[float, parameter(0.0, 'amplitude of its sinusoid', 'N m')]
    frequency: Annotated[float, non_negative(1.0, 'its frequency', 'rad/s')]
    phase: Annotated[float, parameter(0.0, 'its phase', 'rad')]

    @property
    def has_barrier(self) -> bool:
        """The error stays inside the bound."""
        return True

    def compute_demand(
        self, settings: Settings, state: State, signals: Signals, t: float, dt: float
    ) -> None:
        """Compute the torque (16)."""
        compute_surface(settings, state, signals, dt)
        compute_regressors_at_state(settings, state, signals)
        fill_learned(settings, state, signals, dt)
        known = self.constant + self.amplitude * sin(self.frequency * t + self.phase)
        for i in range(settings.n):
            torque = -settings.feedback.gain[i] * signals.xi2[i]
            if settings.feedback.follows_inertia == 0:  # else it is in `model_torque`
                torque += signals.feedback.restoring[i]
            modelled = compensated(settings, state, signals, i, torque)
            signals.demand[i] = modelled + known

    def finish(
        self,
        settings: Settings,
        state: State,
        signals: Signals,
        dt: float,
        saturated: bool,
    ) -> None:
        """Advance alpha2."""
        advance_surface(settings, state, signals, dt)


LAW = ModelBased
