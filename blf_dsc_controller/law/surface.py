# SPDX-License-Identifier: Apache-2.0
"""Errors and surfaces: virtual control (15), (18) with its filter (13); the linear surface of (35).

xi1 = q - qr,   xi2 = dq - alpha2,   lambda alpha2' = beta2 - alpha2,   alpha2(0) = beta2(0)
"""

from math import exp, pi, sin

import numpy as np

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.law.settings import LINEAR, Settings
from blf_dsc_controller.law.state import Signals, State


@inner
def sinc(x: float) -> float:
    """Return sin(x) / x, by its series where the quotient would lose precision."""
    if abs(x) < 1e-4:
        return 1.0 - x * x / 6.0
    return sin(x) / x


@inner
def virtual_control(
    xi1: float, bound: float, barrier_gain: float, linear_gain: float, reference_velocity: float
) -> float:
    """Return beta2 = -(K/2) xi1 sinc(pi xi1^2 / k_c^2) - mu xi1 + dqr   [rad/s], (15) and (18).

    (15) is printed as a quotient that is 0/0 at xi1 = 0; sin s cos s = sin(2 s)/2 turns it into a
    sinc.  Its barrier part falls to zero at the bound, where only mu acts; beyond, it would change
    sign and is set to zero.
    """
    ratio = xi1 / bound
    barrier_part = 0.0
    if abs(ratio) < 1.0:
        barrier_part = 0.5 * barrier_gain * xi1 * sinc(pi * ratio * ratio)
    return reference_velocity - barrier_part - linear_gain * xi1


@inner
def filter_gain(time_constant: float, dt: float) -> float:
    """Return the exact gain 1 - exp(-dt / time_constant) of a first-order lag with held input."""
    return 1.0 - exp(-dt / time_constant)


@inner
def filtered_surface(settings: Settings, state: State, signals: Signals, dt: float) -> None:
    """Compute beta2 of (18) and alpha2' of the filter (13); `filter_step` advances alpha2.

    beta2 is held for the sample, in which alpha2' decays from (beta2 - alpha2) / lambda by the
    factor exp(-dt / lambda).  The torque is held too, so it uses the mean of alpha2': with
    lambda = 2 dt the initial value would be 27 % too large.
    """
    gain = filter_gain(settings.time_constant, dt)
    for i in range(settings.n):
        signals.beta2[i] = virtual_control(
            signals.xi1[i],
            signals.bound[i],
            settings.K[i],
            settings.mu[i],
            signals.dqr[i] + signals.narrowing[i] * signals.xi1[i],
        )
        if state.samples[0] == 0.0:
            state.alpha2[i] = signals.beta2[i]
        signals.dalpha2[i] = gain * (signals.beta2[i] - state.alpha2[i]) / dt


@inner
def linear_surface(settings: Settings, state: State, signals: Signals, dq: np.ndarray) -> None:
    """Compute alpha2 = dqr - lambda_s z1 of (35), and its derivative, which needs ddqr."""
    for i in range(settings.n):
        state.alpha2[i] = signals.dqr[i] - settings.K[i] * signals.xi1[i]
        signals.beta2[i] = state.alpha2[i]
        signals.dalpha2[i] = signals.ddqr[i] - settings.K[i] * (dq[i] - signals.dqr[i])


@inner
def compute_errors(
    settings: Settings,
    state: State,
    signals: Signals,
    dt: float,
    q: np.ndarray,
    dq: np.ndarray,
) -> None:
    """Compute the errors xi1 and xi2, and the surface between them."""
    for i in range(settings.n):
        signals.xi1[i] = q[i] - signals.qr[i]
    if settings.surface == LINEAR:
        linear_surface(settings, state, signals, dq)
    else:
        filtered_surface(settings, state, signals, dt)
    for i in range(settings.n):
        signals.xi2[i] = dq[i] - state.alpha2[i]


@inner
def filter_step(settings: Settings, state: State, signals: Signals, dt: float) -> None:
    """Advance alpha2 of the filter (13) by `dt` [s], exactly for the held beta2."""
    gain = filter_gain(settings.time_constant, dt)
    for i in range(settings.n):
        state.alpha2[i] += gain * (signals.beta2[i] - state.alpha2[i])
