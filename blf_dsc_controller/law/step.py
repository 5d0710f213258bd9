# SPDX-License-Identifier: Apache-2.0
"""One sample of a law: reference, errors, regressors, learning, torque, adaptation.

The proposed law (28) has the filtered surface (13), (15), (18) and the barrier torque; the
comparison law (35) has the linear surface and a position gain.  All other differences between the
laws are gains that are zero (see `factory`).
"""

from math import nan

import numpy as np

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import part
from blf_dsc_controller.law import (
    adaptation,
    apparent_inertia,
    barrier,
    consistency,
    excitation,
    friction,
    prediction,
    surface,
    torque,
    window,
)
from blf_dsc_controller.law.settings import FILTERED, REFERENCE, Settings
from blf_dsc_controller.law.state import Sample, Signals, State
from blf_dsc_controller.law.weighing import DEVIATION, TWO_SIDED
from blf_dsc_controller.reference import terms as reference


@inner
def compute_regressors(
    settings: Settings, state: State, signals: Signals, q: np.ndarray, dq: np.ndarray
) -> None:
    """Compute H P^(0) of the feedback, H of what is learned; if the row needs them, Yp and Yr."""
    model, H = settings.model, signals.H
    for i in range(settings.n):
        signals.damped[i] = signals.dalpha2[i] - settings.damping_rate * signals.xi2[i]
    if settings.prediction == FILTERED:
        Yp, Yr = signals.momentum, signals.rest
        model.regressors(q, dq, state.alpha2, signals.damped, H, Yp, Yr)
    else:
        model.regressor(q, dq, state.alpha2, signals.damped, H)
    for i in range(settings.n):
        signals.model_torque[i] = 0.0
        for j in range(settings.p):
            signals.model_torque[i] += H[i, j] * settings.initial_estimate[j]
    if settings.compensation == REFERENCE:
        model.regressor(signals.qr, signals.dqr, signals.dqr, signals.ddqr, H)
    elif settings.damping_rate > 0.0:
        model.regressor(q, dq, state.alpha2, signals.dalpha2, H)


@inner
def update_window(
    settings: Settings,
    state: State,
    signals: Signals,
    t: float,
    dt: float,
    q: np.ndarray,
    dq: np.ndarray,
    applied: np.ndarray,
) -> None:
    """Add the row of the last interval to the window; check the excitation when due."""
    prediction.fill_columns(settings, t, dq, signals.rest)
    prediction.form_row(settings, state, signals, dt, q, dq, applied)
    if state.samples[0] == 0.0:
        return
    if int(state.samples[0]) % settings.row_interval == 0:
        cursor = window.push_row(
            state.ring,
            int(state.cursor[0]),
            state.running,
            state.fresh,
            state.half,
            signals.row,
            int(state.rows[0]),
        )
        state.cursor[0] = cursor
        state.rows[0] = min(state.rows[0] + 1.0, float(settings.window))
        friction.measure_flips(settings, state, settings.row_interval * dt)
    if settings.change_detection == 1:
        consistency.detect_change(settings, state, signals, t, dt)
    if int(state.samples[0]) % settings.interval == 0:
        excitation.update_excitation(settings, state, signals, t, dt, q)


@inner
def fill_sample(settings: Settings, state: State, signals: Signals, sample: Sample) -> None:
    """Fill the telemetry sample, except for the terms of (29)."""
    for i in range(settings.n):
        sample.qr[i] = signals.qr[i]
        sample.dqr[i] = signals.dqr[i]
        sample.xi1[i] = signals.xi1[i]
        sample.xi2[i] = signals.xi2[i]
        sample.torque[i] = signals.torque[i]
        sample.disturbance[i] = state.disturbance[i]
        for j in range(settings.p, settings.m):
            sample.disturbance[i] += signals.H[i, j] * state.estimate[j]
        sample.bound[i] = signals.bound[i]
        sample.cuts[i] = signals.cuts[i]
    for j in range(settings.m):
        sample.estimate[j] = state.estimate[j] if state.active[j] != 0.0 else nan
    sample.lambda_min[0] = state.lambda_min[0]
    sample.latched[0] = state.latched[0]
    sample.changes[0] = state.changes[0]
    for k in range(state.load.size):
        is_known = state.load[DEVIATION + k % DEVIATION] > 0.0
        factor = 1.0 if k < DEVIATION else TWO_SIDED
        sample.load[k] = factor * state.load[k] if is_known else nan


@inner
def step(
    settings: Settings,
    reference_vector: np.ndarray,
    state: State,
    signals: Signals,
    t: float,
    dt: float,
    measurement: np.ndarray,
    sample: Sample,
) -> None:
    """Run one sample, from the measurement to the torque; `lyapunov.fill_energies` is separate.

    The measurement is [q (n,) rad, dq (n,) rad/s, effort of the last interval (n,) N m],
    t [s] the time since the start, dt [s] since the last sample (at the first: until the next).
    """
    n = settings.n
    q = part(measurement, 0, (n,))
    dq = part(measurement, n, (n,))
    torque.find_added(settings, signals, q)
    torque.find_applied(settings, state, signals, measurement)
    reference.evaluate(reference_vector, t, signals.qr, signals.dqr, signals.ddqr)
    torque.known_disturbance(settings, signals, t)
    barrier.update_bound(settings, signals, t)
    surface.compute_errors(settings, state, signals, dt, q, dq)
    compute_regressors(settings, state, signals, q, dq)
    friction.fill_compensation(settings, signals)
    update_window(settings, state, signals, t, dt, q, dq, signals.applied)
    if settings.rotors_unsure == 1:
        apparent_inertia.measure(settings, state, signals, dt, q, dq)
        apparent_inertia.correct_feedback(settings, state, signals)
    torque.compute_demand(settings, state, signals)
    saturated = torque.saturate(settings, state, signals, dt)
    adaptation.adapt(settings, state, signals, dt, saturated)
    surface.filter_step(settings, state, signals, dt)
    for i in range(n):
        state.torque[i] = signals.torque[i]
    state.samples[0] += 1.0
    fill_sample(settings, state, signals, sample)
