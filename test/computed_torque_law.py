# SPDX-License-Identifier: Apache-2.0
"""A law of a file for tests: computed torque with an integrator, which has a memory."""

from __future__ import annotations

from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.layout import Array, view_of
from blf_dsc_controller.configuration.schema import positive
from blf_dsc_controller.law.compensation import fill_known_torque
from blf_dsc_controller.law.state import Settings, Signals, State


class Memory(NamedTuple):
    """What the law keeps from one sample to the next."""

    integral: Annotated[Array, 'n']  # rad s, of the error


memory_of = view_of(Memory)


class ComputedTorque(NamedTuple):
    """tau = M0 (qr'' - k_p e - k_d e' - k_i int e) + C0 q' + G0 + F0(qr'),   e = q - qr."""

    position: Annotated[float, positive(900.0, 'gain on the error', '1/s^2', 'k_p')]
    velocity: Annotated[float, positive(60.0, 'gain on its rate', '1/s', 'k_d')]
    integral: Annotated[float, positive(4500.0, 'gain on its integral', '1/s^3', 'k_i')]

    @property
    def has_barrier(self) -> bool:
        """Nothing keeps the error inside a bound."""
        return False

    def compute_demand(
        self, settings: Settings, state: State, signals: Signals, t: float, dt: float
    ) -> None:
        """Write the torque to `signals.demand`."""
        memory = memory_of(state.memory, settings)
        a = signals.dalpha2
        for i in range(settings.n):
            a[i] = signals.ddqr[i] - self.position * signals.xi1[i]
            a[i] -= self.velocity * (signals.dq[i] - signals.dqr[i])
            a[i] -= self.integral * memory.integral[i]
        fill_known_torque(settings, state, signals, signals.dq, a, dt)
        for i in range(settings.n):
            signals.demand[i] = signals.model_torque[i]

    def finish(
        self,
        settings: Settings,
        state: State,
        signals: Signals,
        dt: float,
        saturated: bool,
    ) -> None:
        """Integrate the error, unless a torque was cut."""
        if saturated:
            return
        memory = memory_of(state.memory, settings)
        for i in range(settings.n):
            memory.integral[i] += dt * signals.xi1[i]


LAW = ComputedTorque
MEMORY = Memory
