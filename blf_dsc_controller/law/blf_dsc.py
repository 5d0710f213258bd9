# SPDX-License-Identifier: Apache-2.0
"""The paper's law: tan-type barrier, dynamic surface control, composite learning.

    xi1 = q - qr                                                                       (rad)
    beta2 = -(K/2) xi1 sinc(pi xi1^2 / k_c^2) - mu xi1 + dqr                           (15), (18)
    lambda alpha2' = beta2 - alpha2 + lambda f,    alpha2(0) = beta2(0)                (13)
    xi2 = dq - alpha2                                                                  (rad/s)
    tau = -dV/dxi1 - d2 |xi1| sat(xi2 / b) - K_p xi2 + tau_m + d^3                     (28)
    theta^' = Proj(-Gamma (H^T xi2 - kappa W eps)),    d^3' = -gamma (xi2 + eta d^3)   (20), (30)

Where it departs from the paper, and why:

- tau_m, the torque of the model, is in `compensation`: what is learned acts along the reference.
- The barrier's torque -dV/dxi1 continues past a stiffness that a sampled loop can hold: `barrier`.
- A bound that narrows adds xi1 k'/k to the virtual control: `barrier`.
- K_p xi2 may lag, where joints are elastic: `feedback`.
- f, zero in the paper, is what is known of beta2' if `known_rate` of `surface.Settings` is 1.
- beta2 is held for a sample, in which alpha2' decays from (beta2 - alpha2) / lambda by the factor
  exp(-dt / lambda).  The torque is held too, so it uses the mean of alpha2': with lambda = 2 dt the
  initial value would be 27 % too large.  With f, it is beta2 - f t that is held.
"""

from __future__ import annotations

from typing import NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.law import barrier, feedback, learning
from blf_dsc_controller.law.compensation import compensated
from blf_dsc_controller.law.lag import filter_gain
from blf_dsc_controller.law.state import Settings, Signals, State
from blf_dsc_controller.law.surface import known_rate, virtual_control


class BlfDsc(NamedTuple):
    """The law (28)."""

    layer: float = 0.01  # b, rad/s: xi2 at which the robust term saturates

    @property
    def has_barrier(self) -> bool:
        """The error stays inside the bound."""
        return True

    def compute_demand(
        self, settings: Settings, state: State, signals: Signals, t: float, dt: float
    ) -> None:
        """Compute the torque (28)."""
        compute_surface(settings, state, signals, dt)
        learning.observe(settings, state, signals, t, dt)
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
        """Adapt theta^ and d^3; advance alpha2."""
        learning.adapt(settings, state, signals, dt, saturated)
        advance_surface(settings, state, signals, dt)


@inner
def compute_surface(
    settings: Settings, state: State, signals: Signals, dt: float
) -> None:
    """Compute beta2 of (15) and (18), alpha2' of the filter (13), xi2, and -dV/dxi1."""
    gains, surface = settings.surface, signals.surface
    gain = filter_gain(gains.time_constant, dt)
    for i in range(settings.n):
        xi1, bound = signals.xi1[i], signals.bound[i]
        dqr, narrowing = signals.dqr[i], signals.barrier.narrowing[i]
        surface.beta2[i] = virtual_control(
            xi1, bound, gains.gain[i], gains.mu[i], dqr + narrowing * xi1
        )
        surface.rate[i] = 0.0
        if gains.known_rate == 1:
            dq, ddqr = signals.dq[i], signals.ddqr[i]
            f, lag_offset = known_rate(gains, xi1, bound, narrowing, dq, dqr, ddqr, i)
            surface.beta2[i] -= lag_offset
            surface.rate[i] = f
        if state.samples[0] == 0.0:
            state.alpha2[i] = surface.beta2[i]
        signals.dalpha2[i] = gain * (surface.beta2[i] - state.alpha2[i]) / dt
        signals.dalpha2[i] += surface.rate[i]
        signals.xi2[i] = signals.dq[i] - state.alpha2[i]
        signals.feedback.restoring[i] = -barrier.joint_gradient(
            settings.barrier, signals.barrier, xi1, bound, i
        )


@inner
def advance_surface(
    settings: Settings, state: State, signals: Signals, dt: float
) -> None:
    """Advance alpha2 of the filter (13) by `dt` [s], exactly for the held beta2."""
    surface = signals.surface
    gain = filter_gain(settings.surface.time_constant, dt)
    for i in range(settings.n):
        state.alpha2[i] += gain * (surface.beta2[i] - state.alpha2[i])
        state.alpha2[i] += dt * surface.rate[i]


def shift_surface(state: State, change: Array) -> None:
    """Shift alpha2 by `change` (n,) [rad/s], and the lagged xi2 with it: no transient follows."""
    lagged = state.feedback.lagged
    state.alpha2[:] += change
    lagged -= change[: lagged.size]


@inner
def joint_feedback(
    settings: Settings, state: State, signals: Signals, layer: float, i: int
) -> float:
    """Return the feedback of joint i [N m]: barrier, robust term and damping of (28)."""
    gains = settings.feedback
    xi1, xi2 = signals.xi1[i], signals.xi2[i]
    lagged_xi2 = feedback.damped_velocity(gains, state.feedback, signals.xi2, i)
    torque = feedback.joint_torque(gains, xi1, xi2, lagged_xi2, layer, i)
    if gains.follows_inertia == 1:  # the barrier is in `model_torque`
        return torque
    return torque + float(signals.feedback.restoring[i])
