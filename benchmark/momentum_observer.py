# SPDX-License-Identifier: Apache-2.0
"""A disturbance observer by momentum, fed forward, as a law of a file.

    tau = - s (K e + D e') + M0 qr'' + C0 qr' + G0 + F0(qr') + r,   e = q - qr
    r' = L (tau - d/dt(M0 q') + C0^T q' - G0 - F0(qr') - r)

K is `barrier.weight` [N m/rad], D `feedback.gain` [N m s/rad]; M0, C0, G0 are those of P^(0), F0
the friction known to the controller.  r is the torque that was sent and that the motion does not
show: the load, and whatever else the model lacks.  It needs neither acceleration nor sensors.

At small errors it is a PID through M0, - (s K + L s D) e - (s D + L M0) e' - L s K int e.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.layout import Array, view_of
from blf_dsc_controller.configuration.schema import positive
from blf_dsc_controller.law.lag import filter_gain
from blf_dsc_controller.law.state import Settings, Signals, State
from blf_dsc_controller.studies.computed_torque import known_friction


class Memory(NamedTuple):
    """What the law keeps from one sample to the next."""

    momentum: Annotated[Array, 'n']  # M0 q', N m s
    rest: Annotated[Array, 'n']  # G0 - C0^T q', N m
    observed: Annotated[Array, 'n']  # r, N m


memory_of = view_of(Memory)


class MomentumObserver(NamedTuple):
    """A PD over the model along the reference, and a disturbance observer."""

    scale: Annotated[float, positive(1.0, 'factor on stiffness and damping', '', 's')]
    bandwidth: Annotated[float, positive(10.0, 'pole of the observer', 'rad/s', 'L')]

    @property
    def has_barrier(self) -> bool:
        """Nothing keeps the error inside a bound."""
        return False

    def compute_demand(
        self, settings: Settings, state: State, signals: Signals, t: float, dt: float
    ) -> None:
        """Write the torque to `signals.demand`."""
        memory = memory_of(state.memory, settings)
        P0, H = settings.initial_estimate, signals.H
        Yp, Yr = signals.scratch.momentum.Yp, signals.scratch.momentum.Yr
        q, dq, dqr = signals.q, signals.dq, signals.dqr
        settings.model.regressor(q, dq, dqr, signals.ddqr, H)
        settings.model.momentum_regressor(q, dq, Yp, Yr)
        gain = filter_gain(1.0 / self.bandwidth, dt)
        for i in range(settings.n):
            friction = known_friction(settings, i, dqr[i])
            modelled = friction
            momentum = rest = 0.0
            for j in range(settings.p):
                modelled += H[i, j] * P0[j]
                momentum += Yp[i, j] * P0[j]
                rest += Yr[i, j] * P0[j]
            if state.samples[0] > 0.0:
                rate = (momentum - memory.momentum[i]) / dt
                shown = rate + 0.5 * (rest + memory.rest[i]) + friction
                lacking = signals.applied[i] - shown
                memory.observed[i] += gain * (lacking - memory.observed[i])
            memory.momentum[i] = momentum
            memory.rest[i] = rest
            K, D = settings.barrier.weight[i], settings.feedback.gain[i]
            feedback = K * signals.xi1[i] + D * (dq[i] - dqr[i])
            signals.demand[i] = modelled - self.scale * feedback + memory.observed[i]

    def finish(
        self,
        settings: Settings,
        state: State,
        signals: Signals,
        dt: float,
        saturated: bool,
    ) -> None:
        """Keep nothing: the observer has the torque that was sent."""


LAW = MomentumObserver
MEMORY = Memory
