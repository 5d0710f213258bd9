# SPDX-License-Identifier: Apache-2.0
"""One sample of a law: surface, regressor, learning, torque, adaptation.

The proposed law (28) has the filtered surface (13), (15), (18) and the barrier torque; the
comparison law (35) the linear surface and a position gain.  Every other difference between the laws
that can be configured is a gain that is zero (see `assembly`).
"""

from math import sin

import numpy as np

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.views import part
from blf_dsc_controller.law import (
    adaptation,
    barrier,
    columns,
    excitation,
    funnel,
    prediction,
    surface,
    window,
)
from blf_dsc_controller.law import saturation as limits
from blf_dsc_controller.law.settings import EFFORT, FILTERED, LINEAR, Settings
from blf_dsc_controller.law.state import Signals, State


@inner
def saturation(x: float) -> float:
    """Smooth stand-in for the sign: x, cut at -1 and 1."""
    return min(1.0, max(-1.0, x))


@inner
def known_disturbance(settings: Settings, signals: Signals, t: float) -> None:
    """Leave the disturbance that the law is told of in `signals.known` (n,) [N m]."""
    if settings.truth_known == 0 and settings.feed_forward == 0:
        return
    told = settings.true_disturbance
    for i in range(settings.n):
        signals.known[i] = told[0, i] + told[1, i] * sin(told[2, i] * t + told[3, i])


@inner
def filtered_surface(settings: Settings, state: State, signals: Signals, dt: float) -> None:
    """beta2 of (18) and alpha2' of the filter (13); alpha2 itself is moved on by `advance`.

    beta2 is held for the sample, in which alpha2' falls from (beta2 - alpha2) / lambda by the
    factor exp(-dt / lambda).  The torque is held too, so it is given the mean of alpha2', which is
    what alpha2 then moves by: with lambda = 2 dt the first value would be 27 % too large.
    """
    share = surface.filter_gain(settings.time_constant, dt)
    for i in range(settings.n):
        signals.beta2[i] = surface.virtual_control(
            signals.xi1[i],
            signals.bound[i],
            settings.K[i],
            settings.mu[i],
            signals.dqr[i] + signals.narrowing[i] * signals.xi1[i],
        )
        if state.samples[0] == 0.0:
            state.alpha2[i] = signals.beta2[i]
        signals.dalpha2[i] = share * (signals.beta2[i] - state.alpha2[i]) / dt


@inner
def linear_surface(settings: Settings, state: State, signals: Signals, dq: np.ndarray) -> None:
    """alpha2 = dqr - lambda_s z1 of (35), and its derivative, which needs ddqr."""
    for i in range(settings.n):
        state.alpha2[i] = signals.dqr[i] - settings.K[i] * signals.xi1[i]
        signals.beta2[i] = state.alpha2[i]
        signals.dalpha2[i] = signals.ddqr[i] - settings.K[i] * (dq[i] - signals.dqr[i])


@inner
def track(
    settings: Settings,
    state: State,
    signals: Signals,
    dt: float,
    q: np.ndarray,
    dq: np.ndarray,
) -> None:
    """Errors xi1 and xi2, and the surface between them."""
    for i in range(settings.n):
        signals.xi1[i] = q[i] - signals.qr[i]
    if settings.surface == LINEAR:
        linear_surface(settings, state, signals, dq)
    else:
        filtered_surface(settings, state, signals, dt)
    for i in range(settings.n):
        signals.xi2[i] = dq[i] - state.alpha2[i]


@inner
def regress(
    settings: Settings, state: State, signals: Signals, q: np.ndarray, dq: np.ndarray
) -> None:
    """H(q, dq, alpha2, alpha2') and, for the prediction that needs them, Yp and Yr."""
    model, H = settings.model, signals.H
    if settings.prediction != FILTERED:
        model.regressor(q, dq, state.alpha2, signals.dalpha2, H)
        return
    Yp, Yr = signals.momentum, signals.rest
    model.regressors(q, dq, state.alpha2, signals.dalpha2, H, Yp, Yr)


@inner
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
    columns.fill(settings, t, dq, signals.rest)
    prediction.form_row(settings, state, signals, dt, q, dq, applied)
    if state.samples[0] == 0.0:
        return
    cursor = window.push(state.ring, int(state.cursor[0]), state.running, state.fresh, signals.row)
    state.cursor[0] = cursor
    state.rows[0] = min(state.rows[0] + 1.0, float(settings.window))
    if int(state.samples[0]) % settings.interval == 0:
        excitation.look(settings, state, signals, t)


@inner
def error_torque(settings: Settings, signals: Signals, i: int) -> float:
    """Torque of joint i against its errors: barrier (16), robust term and damping of (28), (35)."""
    robust = settings.d2[i] * abs(signals.xi1[i]) + settings.mu_bar[i]
    torque = settings.Kp[i] * signals.xi2[i]
    torque += robust * saturation(signals.xi2[i] / settings.boundary_layer)
    if settings.surface == LINEAR:
        return float(-torque - settings.weight[i] * signals.xi1[i])
    return float(-torque) - barrier.gradient(
        signals.xi1[i],
        signals.bound[i],
        settings.weight[i],
        settings.slope_limit[i],
        signals.knee[i],
    )


@inner
def command(settings: Settings, state: State, signals: Signals) -> None:
    """Torque (28) or (35), before its limits, in `signals.demand`."""
    for i in range(settings.n):
        torque = error_torque(settings, signals, i) + state.disturbance[i]
        if settings.feed_forward == 1:
            torque += signals.known[i]
        for j in range(settings.p):
            torque += signals.H[i, j] * state.estimate[j]
        signals.demand[i] = torque


@inner
def advance(settings: Settings, state: State, signals: Signals, dt: float) -> None:
    """Move the surface filter (13) on to the next sample, exactly for the held beta2."""
    gain = surface.filter_gain(settings.time_constant, dt)
    for i in range(settings.n):
        state.alpha2[i] += gain * (signals.beta2[i] - state.alpha2[i])
        state.torque[i] = signals.torque[i]
    state.samples[0] += 1.0


@inner
def answer(
    settings: Settings,
    state: State,
    signals: Signals,
    t: float,
    dt: float,
    measurement: np.ndarray,
) -> None:
    """Answer one sample: the torque is left in `signals.torque`, and `state` moved on.

    Args:
        settings: gains and choices.
        state: moved on by one sample.
        signals: qr, dqr and ddqr are read, everything else is computed.
        t: time since the start [s].
        dt: time since the last sample [s] (at the first: until the next).
        measurement: [q (n,) rad, dq (n,) rad/s, applied torque of the last interval (n,) N m].
    """
    n = settings.n
    q = part(measurement, 0, (n,))
    dq = part(measurement, n, (n,))
    applied = state.torque
    if settings.torque_source == EFFORT:
        applied = part(measurement, 2 * n, (n,))
    known_disturbance(settings, signals, t)
    funnel.narrow(settings, signals, t)
    track(settings, state, signals, dt, q, dq)
    regress(settings, state, signals, q, dq)
    learn(settings, state, signals, t, dt, q, dq, applied)
    command(settings, state, signals)
    saturated = limits.cut_torque(settings, state, signals, dt)
    adaptation.adapt(settings, state, signals, dt, saturated)
    advance(settings, state, signals, dt)
