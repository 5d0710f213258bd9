# SPDX-License-Identifier: Apache-2.0
"""One sample of the proposed law: (13), (15), (18), (28) with the learning (20)-(27), (30)."""

import numpy as np

from blf_dsc_controller.core import (
    adaptation,
    barrier,
    excitation,
    models,
    prediction,
    surface,
    window,
)
from blf_dsc_controller.core.borrowed import borrowed
from blf_dsc_controller.core.kernel import kernel
from blf_dsc_controller.core.settings import EFFORT, Settings, settings_of
from blf_dsc_controller.core.state import Signals, State, signals_of, state_of


@kernel
def saturation(x: float) -> float:
    """Smooth stand-in for the sign: x, cut at -1 and 1."""
    return min(1.0, max(-1.0, x))


@kernel
def track(
    settings: Settings, state: State, signals: Signals, q: np.ndarray, dq: np.ndarray
) -> None:
    """Errors xi1, xi2 and the surface: virtual control beta2 and alpha2' of the filter (13)."""
    first = state.samples[0] == 0.0
    for i in range(settings.n):
        signals.xi1[i] = q[i] - signals.qr[i]
        signals.beta2[i] = surface.virtual_control(
            signals.xi1[i], settings.bound[i], settings.K[i], settings.mu[i], signals.dqr[i]
        )
        if first:
            state.alpha2[i] = signals.beta2[i]
        signals.dalpha2[i] = (signals.beta2[i] - state.alpha2[i]) / settings.time_constant
        signals.xi2[i] = dq[i] - state.alpha2[i]


@kernel
def learn(
    settings: Settings,
    state: State,
    signals: Signals,
    t: float,
    dt: float,
    q: np.ndarray,
    dq: np.ndarray,
    applied: np.ndarray,
) -> None:
    """Take the last interval into the window, and look at the excitation when it is time."""
    models.momentum_regressor(
        settings.model, settings.constants, q, dq, signals.momentum, signals.rest
    )
    prediction.bias_columns(settings, signals.rest)
    if state.samples[0] > 0.0:
        prediction.filter_row(settings, state, signals, dt, applied)
        cursor = window.push(
            state.ring, int(state.cursor[0]), state.running, state.fresh, signals.row
        )
        state.cursor[0] = cursor
        state.rows[0] = min(state.rows[0] + 1.0, float(settings.window))
        if int(state.samples[0]) % settings.interval == 0:
            excitation.look(settings, state, signals, t)
    prediction.remember(settings, state, signals)


@kernel
def command(settings: Settings, state: State, signals: Signals) -> bool:
    """Torque (28), cut at its limit; True if any joint was cut."""
    saturated = False
    for i in range(settings.n):
        torque = state.disturbance[i] - settings.Kp[i] * signals.xi2[i]
        torque -= barrier.gradient(
            signals.xi1[i],
            settings.bound[i],
            settings.weight[i],
            settings.slope_limit[i],
            settings.knee[i],
        )
        torque -= (
            settings.d2[i]
            * abs(signals.xi1[i])
            * saturation(signals.xi2[i] / settings.boundary_layer)
        )
        for j in range(settings.p):
            torque += signals.H[i, j] * state.estimate[j]
        limit = settings.torque_limit[i]
        signals.demand[i] = torque
        signals.torque[i] = min(limit, max(-limit, torque))
        saturated = saturated or signals.torque[i] != torque
    return saturated


@kernel
def update(
    settings_vector: np.ndarray,
    state_vector: np.ndarray,
    signals_vector: np.ndarray,
    t: float,
    dt: float,
    measurement: np.ndarray,
) -> None:
    """Answer one sample.

    Args:
        settings_vector: packed `Settings`.
        state_vector: packed `State`, moved on by one sample.
        signals_vector: packed `Signals`; qr and dqr are read, the torque is left in `torque`.
        t: time since the start [s].
        dt: time since the last sample [s] (at the first: until the next).
        measurement: [q (n,) rad, dq (n,) rad/s, applied torque of the last interval (n,) N m].
    """
    settings = settings_of(borrowed(settings_vector))
    state = state_of(borrowed(state_vector), settings)
    signals = signals_of(borrowed(signals_vector), settings)
    n = settings.n
    q = measurement[:n]
    dq = measurement[n : 2 * n]
    applied = state.torque
    if settings.torque_source == EFFORT:
        applied = measurement[2 * n : 3 * n]
    track(settings, state, signals, q, dq)
    models.regressor(
        settings.model, settings.constants, q, dq, state.alpha2, signals.dalpha2, signals.H
    )
    learn(settings, state, signals, t, dt, q, dq, applied)
    saturated = command(settings, state, signals)
    adaptation.adapt(settings, state, signals, dt, saturated)
    gain = surface.filter_gain(settings.time_constant, dt)
    for i in range(n):
        state.alpha2[i] += gain * (signals.beta2[i] - state.alpha2[i])
        state.torque[i] = signals.torque[i]
    state.samples[0] += 1.0
