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
    """The law (28): `compute_demand` is its torque, `finish` the updates (13), (20) and (30)."""

    layer: float = 0.01  # b, rad/s: xi2 at which the robust term saturates

    @property
    def has_barrier(self) -> bool:
        """The error stays inside the bound."""
        return True

    def compute_demand(
        self, settings: Settings, state: State, signals: Signals, t: float, dt: float
    ) -> None:
        """Compute the torque (28) before saturation, `signals.demand` (n,) [N m].

        The order: surface (13) to (18), regressors and row of the learning, lag of the damping,
        then per joint the feedback and what compensates the model.
        """
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
        """Advance theta^ by (20), d^3 by (30), and alpha2 by (13), each by `dt` [s].

        `saturated`: the torque was cut, so the tracking error says nothing about the parameters.
        """
        learning.adapt(settings, state, signals, dt, saturated)
        advance_surface(settings, state, signals, dt)


@inner
def compute_surface(
    settings: Settings, state: State, signals: Signals, dt: float
) -> None:
    """Compute beta2 of (15), (18), alpha2' of the filter (13), xi2 = dq - alpha2, and -dV/dxi1.

    Reads q, dq, reference, error and bound of `signals`; `dt` [s] is the sample time.  Writes
    beta2 and its known rate f to `signals.surface`, alpha2' (mean over the sample), xi2, and the
    torque of the barrier to `signals.feedback.restoring`.
    """
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
        signals.feedback.restoring[i] = -barrier.gradient(
            xi1,
            bound,
            settings.barrier.weight[i],
            settings.barrier.slope_limit[i],
            signals.barrier.knee[i],
        )


@inner
def advance_surface(
    settings: Settings, state: State, signals: Signals, dt: float
) -> None:
    """Advance alpha2 by `dt` [s] with the filter (13), exactly for a beta2 that is held."""
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
    """Return the feedback of joint i in (28) [N m]: barrier, robust term and damping.

    `layer` is b [rad/s].  Where the barrier acts through the inertia matrix, it is in
    `signals.model_torque` instead.
    """
    gains = settings.feedback
    torque = feedback.joint_torque(
        gains, state.feedback, signals.xi1[i], signals.xi2[i], layer, i
    )
    if gains.follows_inertia == 1:  # the barrier is in `model_torque`
        return torque
    return torque + float(signals.feedback.restoring[i])
