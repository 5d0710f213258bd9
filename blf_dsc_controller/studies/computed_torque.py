# SPDX-License-Identifier: Apache-2.0
"""Computed torque with an integrator: the law that the studies compare with.

    tau = M0 (qr'' - k_p e - k_d e' - k_i int e) + C0 q' + G0 + F0(qr'),   e = q - qr

M0, C0, G0 are those of P0, the initial estimate; F0 is the friction known to the
controller, at the velocity of the reference.  The integrator is held while any torque
is cut.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

from blf_dsc_controller.arms.friction import sliding
from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, view_of
from blf_dsc_controller.configuration.schema import positive
from blf_dsc_controller.law import columns
from blf_dsc_controller.law.state import Settings, Signals, State


class Memory(NamedTuple):
    """What the law keeps from one sample to the next."""

    integral: Annotated[Array, 'n']  # rad s, of the error


memory_of = view_of(Memory)


@inner
def known_friction(settings: Settings, i: int, velocity: float) -> float:
    """Return the friction of joint i [N m] that the initial estimate has at a velocity."""
    of, known = settings.columns, settings.initial_estimate
    sign = sliding(velocity, of.coulomb_velocity)
    at = columns.Point(0.0, 0.0, velocity, sign, 0.0)
    return columns.torque_of(of, columns.FRICTION, i, at, known, settings.n)


class ComputedTorque(NamedTuple):
    """Computed torque with an integrator."""

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
        H = signals.H
        settings.model.regressor(signals.q, signals.dq, signals.dq, a, H)
        for i in range(settings.n):
            signals.demand[i] = known_friction(settings, i, signals.dqr[i])
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
        """Integrate the error, unless a torque was cut."""
        if saturated:
            return
        memory = memory_of(state.memory, settings)
        for i in range(settings.n):
            memory.integral[i] += dt * signals.xi1[i]


LAW = ComputedTorque
MEMORY = Memory
