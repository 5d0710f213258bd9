# SPDX-License-Identifier: Apache-2.0
"""The law as the paper prints it, corrected only where it would fail (doc/errata.md).

    tau = -dV/dxi1 - d2 |xi1| sat(xi2 / b) - K_p xi2 + H(q, dq, alpha2, alpha2') P^ + d^3   (28)
    P^' = Proj(-Gamma (H^T xi2 - kappa eps)),    d^3' = -gamma (xi2 + eta d^3)        (20), (30)
    Lambda = x^T y / x^T x,    x = [xi2'^ + alpha2'; xi2 + alpha2; 1],  y = [alpha2'; alpha2; 1]

Its rows (24) are X = H(q, dq, alpha2, alpha2'), u = Lambda tau, with xi2'^ from the filter (8).
Since tau = [M C G] x and H P = [M C G] y, they are exact only where y is parallel to x: their
error is of first order in xi2 and xi2', and depends on the units.  So they contradict each other
on any arm, which is not taken for a change of it.  Disturbance columns get no rows:
`two_link.bias: false`.
"""

from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, view_of
from blf_dsc_controller.configuration.schema import positive
from blf_dsc_controller.law import adaptation, feedback, learning, window
from blf_dsc_controller.law.blf_dsc import (
    advance_surface,
    compute_surface,
    joint_feedback,
)
from blf_dsc_controller.law.compensation import (
    compensated,
    compute_regressors_at_state,
    fill_learned,
)
from blf_dsc_controller.law.state import Settings, Signals, State
from blf_dsc_controller.numerics.elementary import exp


class Memory(NamedTuple):
    """What the filter (8) keeps from one sample to the next."""

    observed: Annotated[Array, 'n']  # xi2, filtered, rad/s
    rate: Annotated[Array, 'n']  # xi2'^, its derivative, rad/s^2


memory_of = view_of(Memory)


@inner
def differentiate(
    memory: Memory, xi2: Array, omega: float, begins: bool, dt: float
) -> None:
    """Step the filter (8) with damping 1, exactly for held xi2 (n,)."""
    decay = exp(-omega * dt)
    for i in range(xi2.size):
        if begins:
            memory.observed[i] = xi2[i]
            memory.rate[i] = 0.0
        else:
            offset = memory.observed[i] - xi2[i]
            slope = memory.rate[i] + omega * offset
            memory.observed[i] = xi2[i] + (offset + slope * dt) * decay
            memory.rate[i] = (memory.rate[i] - omega * slope * dt) * decay


@inner
def lambda_of(rate: Array, dq: Array, dalpha2: Array, alpha2: Array) -> float:
    """Return Lambda of (24), which is dimensionless only if units are ignored."""
    products = 1.0
    squares = 1.0
    for i in range(dq.size):
        ddq = dalpha2[i] + rate[i]
        products += ddq * dalpha2[i] + dq[i] * alpha2[i]
        squares += ddq**2 + dq[i] ** 2
    return products / squares


@inner
def observe(
    settings: Settings,
    state: State,
    signals: Signals,
    omega: float,
    dt: float,
) -> None:
    """Form the row (24)."""
    memory = memory_of(state.memory, settings)
    begins = state.samples[0] == 0.0
    differentiate(memory, signals.xi2, omega, begins, dt)
    scale = lambda_of(memory.rate, signals.dq, signals.dalpha2, state.alpha2)
    row, H = signals.row.Xu, signals.row.Yp
    alpha2, dalpha2 = state.alpha2, signals.dalpha2
    settings.model.regressor(signals.q, signals.dq, alpha2, dalpha2, H)
    for i in range(settings.n):
        for j in range(settings.p):
            row[i, j] = H[i, j]
        row[i, settings.m] = scale * signals.applied[i]


@inner
def learn(settings: Settings, state: State, signals: Signals, dt: float) -> None:
    """Add the row to the window; check the excitation when due."""
    samples = int(state.samples[0])
    if samples == 0:
        return
    if samples % settings.window.row_interval == 0:
        window.push_row(state.window, signals.row.Xu)
    if samples % settings.window.interval == 0:
        learning.check_excitation(settings, state, signals, dt)


class Paper(NamedTuple):
    """The law (28) as printed."""

    layer: Annotated[
        float, positive(0.01, 'xi2 at which the robust term saturates', 'rad/s', 'b')
    ]
    omega: Annotated[float, positive(100.0, 'pole of the filter (8)', 'rad/s')]

    @property
    def learns(self) -> bool:
        """The estimate is that of latched windows."""
        return True

    @property
    def has_barrier(self) -> bool:
        """The error stays inside the bound."""
        return True

    def compute_demand(
        self, settings: Settings, state: State, signals: Signals, t: float, dt: float
    ) -> None:
        """Compute the torque (28)."""
        compute_surface(settings, state, signals, dt)
        compute_regressors_at_state(settings, state, signals)
        fill_learned(settings, state, signals, dt)
        observe(settings, state, signals, self.omega, dt)
        begins = state.samples[0] == 0.0
        feedback.advance(settings.feedback, state.feedback, signals.xi2, begins, dt)
        for i in range(settings.n):
            torque = joint_feedback(settings, state, signals, self.layer, i)
            signals.demand[i] = compensated(settings, state, signals, i, torque)

    def finish(
        self,
        settings: Settings,
        state: State,
        signals: Signals,
        dt: float,
        saturated: bool,
    ) -> None:
        """Adapt P^ along the gradient, and d^3; advance alpha2."""
        work, estimate = signals.scratch.adaptation, state.estimate
        learn(settings, state, signals, dt)
        adaptation.fill_prediction_error(work, state.latch, estimate)
        adaptation.adapt(
            settings.adaptation,
            work,
            estimate,
            signals.H,
            signals.xi2,
            settings.p,
            not saturated,
            dt,
        )
        if not saturated:
            learning.follow_disturbance(settings, state, signals, dt)
        advance_surface(settings, state, signals, dt)


LAW = Paper
MEMORY = Memory
