# SPDX-License-Identifier: Apache-2.0
"""RISE, the robust integral of the sign of the error, over the model: a law of a file.

    tau = M0 qr'' + C0 qr' + G0 + F0(qr') - s D (e2 - e2(0)) - int s (a2 D e2 + b K sgn(e2)) dt
    e = q - qr,    e2 = e' + D^-1 K e

K is `barrier.weight` [N m/rad], D `feedback.gain` [N m s/rad]; M0, C0, G0 are those of P^(0) along
the reference, F0 the friction known to the controller.  It is the law of Xian, Dawson, de Queiroz
and Chen (2004) with a model as feedforward, k_s + 1 = s D, alpha_1 = D^-1 K, alpha_2 = a2 and
beta = s b K.  Without e2(0), which an approach from the measured posture makes small, nor the
sign, it is the PID - s (K + a2 D) e - s D e' - a2 s K int e.

The integrator is held while any torque is cut.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.layout import Array, view_of
from blf_dsc_controller.configuration.schema import non_negative, positive
from blf_dsc_controller.law.state import Settings, Signals, State
from blf_dsc_controller.studies.computed_torque import known_friction


class Memory(NamedTuple):
    """What the law keeps from one sample to the next."""

    integral: Annotated[Array, 'n']  # N m
    first: Annotated[Array, 'n']  # e2(0), rad/s
    now: Annotated[Array, 'n']  # e2, rad/s


memory_of = view_of(Memory)


class Rise(NamedTuple):
    """A PID over the model along the reference, and the integral of a sign."""

    scale: Annotated[float, positive(1.0, 'factor on stiffness and damping', '', 's')]
    rate: Annotated[float, positive(10.0, 'rate of the integral', '1/s', 'a2')]
    sign: Annotated[
        float, non_negative(0.0, 'rate of the error that the sign is', 'rad/s', 'b')
    ]

    @property
    def has_barrier(self) -> bool:
        """Nothing keeps the error inside a bound."""
        return False

    def compute_demand(
        self, settings: Settings, state: State, signals: Signals, t: float, dt: float
    ) -> None:
        """Write the torque to `signals.demand`."""
        memory = memory_of(state.memory, settings)
        H, P0 = signals.H, settings.initial_estimate
        qr, dqr = signals.qr, signals.dqr
        settings.model.regressor(qr, dqr, dqr, signals.ddqr, H)
        for i in range(settings.n):
            K, D = settings.barrier.weight[i], settings.feedback.gain[i]
            memory.now[i] = signals.dq[i] - dqr[i] + K / D * signals.xi1[i]
            if state.samples[0] == 0.0:
                memory.first[i] = memory.now[i]
            demand = known_friction(settings, i, dqr[i]) - memory.integral[i]
            demand -= self.scale * D * (memory.now[i] - memory.first[i])
            for j in range(settings.p):
                demand += H[i, j] * P0[j]
            signals.demand[i] = demand

    def finish(
        self,
        settings: Settings,
        state: State,
        signals: Signals,
        dt: float,
        saturated: bool,
    ) -> None:
        """Integrate the error and its sign, unless a torque was cut."""
        if saturated:
            return
        memory = memory_of(state.memory, settings)
        for i in range(settings.n):
            K, D = settings.barrier.weight[i], settings.feedback.gain[i]
            error = memory.now[i]
            sign = 1.0 if error > 0.0 else -1.0 if error < 0.0 else 0.0
            rate = self.rate * D * error + self.sign * K * sign
            memory.integral[i] += dt * self.scale * rate


LAW = Rise
MEMORY = Memory
