# SPDX-License-Identifier: Apache-2.0
"""One sample of the loop: from the measurement to the torque, and what follows once that is sent.

`update` computes the torque, for which the arm waits, and `advance` what the next sample needs of
this one: the estimate, and the telemetry.  See `interface` for what the loop does for every law,
and what a law does itself.
"""

from __future__ import annotations

from math import nan

from blf_dsc_controller.arms.model import ArmModel
from blf_dsc_controller.compiled.jit import compile_methods, inner, kernel
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.law import (
    barrier,
    oscillation,
    repeats,
    torque,
    torque_sensors,
)
from blf_dsc_controller.law.blf_dsc import BlfDsc
from blf_dsc_controller.law.called_law import CalledLaw
from blf_dsc_controller.law.check_state import (
    CONTRADICTION,
    INVALID,
    NOT_SENSORS,
    OSCILLATES,
    Checks,
    are_on,
    checks_of,
)
from blf_dsc_controller.law.checks import (
    check_sample,
    is_valid_state,
    watch_oscillation,
)
from blf_dsc_controller.law.interface import Law
from blf_dsc_controller.law.payload import DEVIATION, mass_interval
from blf_dsc_controller.law.sensor import compare_velocities
from blf_dsc_controller.law.state import (
    Sample,
    Settings,
    Signals,
    State,
    sample_of,
    settings_of,
    signals_of,
    state_of,
)
from blf_dsc_controller.numerics.intervals import TWO_SIDED
from blf_dsc_controller.reference import terms as reference

compile_methods(Law, ('compute_demand', 'finish'), BlfDsc, CalledLaw)


@inner
def fill_sample(
    settings: Settings, state: State, signals: Signals, sample: Sample
) -> None:
    """Write the telemetry of what is learned to `sample`."""
    for i in range(settings.n):
        sample.disturbance[i] = state.disturbance[i] + signals.friction.torque[i]
        for j in range(settings.p, settings.m):
            sample.disturbance[i] += signals.H[i, j] * state.estimate[j]
        if settings.observer.enabled == 1:
            sample.disturbance[i] += state.observer.torque[i]
    for j in range(settings.m):
        sample.estimate[j] = state.estimate[j] if state.latch.active[j] != 0.0 else nan
    sample.lambda_min[0] = state.latch.lambda_min[0]
    sample.latched[0] = state.latch.latched[0]
    sample.changes[0] = state.change.changes[0]
    load = state.payload.load
    for k in range(load.size):
        is_known = load[DEVIATION + k % DEVIATION] > 0.0
        factor = 1.0 if k < DEVIATION else TWO_SIDED
        sample.load[k] = factor * load[k] if is_known else nan
    if load[DEVIATION] > 0.0:
        sample.load[DEVIATION] = mass_interval(load)


@inner
def check_measurement(checks: Checks, measurement: Array, dt: float) -> int:
    """Return the flags of a measurement (3 n,) that the law must not use, or 0.

    INVALID: it is not finite, or too fast.  CONTRADICTION: velocities contradict the positions.
    `dt` [s] is the time since the last; noise and steps of the sensor are updated.
    """
    if not are_on(checks):
        return 0
    if not is_valid_state(checks, measurement):
        return INVALID
    T = checks.sample_time[0]
    if T > 0.0 and compare_velocities(
        checks.sensor, checks.oscillation, T, dt, measurement
    ):
        return INVALID | CONTRADICTION
    return 0


@inner
def take_measurement(
    checks: Checks, signals: Signals, measurement: Array, begins: bool, dt: float
) -> None:
    """Write q, dq and effort (n,) to the signals, without repeats if there are checks."""
    used = measurement
    if are_on(checks):
        T = checks.sample_time[0]
        repeats.bridge(checks.repeats, measurement, begins, T, dt)
        used = checks.repeats.used
    n = signals.q.size
    for i in range(n):
        signals.q[i] = used[i]
        signals.dq[i] = used[n + i]
        signals.effort[i] = used[2 * n + i]


@inner
def prepare(
    settings: Settings,
    state: State,
    signals: Signals,
    reference_vector: Array,
    t: float,
    dt: float,
) -> None:
    """Compute what every law reads, at t [s]: torque applied, reference, bound and error xi1."""
    signals.t[0], signals.dt[0] = t, dt
    torque.find_added(settings.torque, signals.saturation, signals.q)
    torque.find_applied(
        state.saturation, signals.saturation, state.torque, signals.applied
    )
    reference.evaluate(reference_vector, t, signals.qr, signals.dqr, signals.ddqr)
    barrier.update_bound(settings.barrier, signals.barrier, t, signals.bound)
    for i in range(settings.n):
        signals.xi1[i] = signals.q[i] - signals.qr[i]


@inner
def compute_torque(
    law: Law, settings: Settings, state: State, signals: Signals, sample: Sample
) -> None:
    """Let the law compute its torque, cut it at its limits, and fill its telemetry."""
    t, dt = signals.t[0], signals.dt[0]
    has_last = state.samples[0] > 0.0 or state.saturation.takes_over[0] > 0.0
    law.compute_demand(settings, state, signals, t, dt)
    torque.saturate(
        settings.torque,
        state.saturation,
        signals.saturation,
        signals.demand,
        state.torque,
        has_last,
        dt,
        signals.torque,
    )
    for i in range(settings.n):
        state.torque[i] = signals.torque[i]
        sample.qr[i] = signals.qr[i]
        sample.dqr[i] = signals.dqr[i]
        sample.xi1[i] = signals.xi1[i]
        sample.xi2[i] = signals.xi2[i]
        sample.torque[i] = signals.torque[i]
        sample.bound[i] = signals.bound[i]
        sample.cuts[i] = signals.saturation.cuts[i]


@inner
def report_oscillation(
    settings: Settings,
    checks: Checks,
    state: State,
    oscillates: bool,
    had_fault: float,
) -> int:
    """Return the flags of an arm that `oscillates`, and of a load observer that is left out.

    The observer, which may be the cause, is left out before the arm is reported to oscillate,
    unless that is violent.  `had_fault` is what was wrong with it before this sample.
    """
    half_waves, sensors = checks.oscillation, state.sensors
    is_violent = oscillation.is_violent(half_waves, settings.torque.limit)
    if oscillates and not is_violent:
        torque_sensors.leave_out_oscillating(sensors, half_waves)
    flags = OSCILLATES if oscillates else 0
    if sensors.fault[0] == had_fault:
        return flags
    if is_violent:
        return flags | NOT_SENSORS
    oscillation.forget_all(half_waves)
    return NOT_SENSORS


@inner
def step(
    law: Law,
    settings: Settings,
    checks: Checks,
    reference_vector: Array,
    state: State,
    signals: Signals,
    t: float,
    dt: float,
    measurement: Array,
    sample: Sample,
) -> int:
    """Run one sample, from the measurement to the torque; return the flags of its `checks`.

    The measurement is [q (n,) rad, dq (n,) rad/s, effort of the last interval (n,) N
    m], t [s] the time since the start, dt [s] since the last sample (at the first:
    until the next).
    """
    flags = check_measurement(checks, measurement, dt)
    if flags != 0:
        return flags
    begins = state.samples[0] == 0.0
    take_measurement(checks, signals, measurement, begins, dt)
    prepare(settings, state, signals, reference_vector, t, dt)
    oscillates = watch_oscillation(settings, checks, signals, begins, dt)
    had_fault = state.sensors.fault[0]
    compute_torque(law, settings, state, signals, sample)
    if not are_on(checks):
        return 0
    flags = check_sample(settings, checks, state, signals, sample)
    return flags | report_oscillation(settings, checks, state, oscillates, had_fault)


@kernel
def update(
    law: Law,
    model: ArmModel,
    settings_vector: Array,
    state_vector: Array,
    signals_vector: Array,
    sample_vector: Array,
    checks_vector: Array,
    measurement: Array,
    reference_vector: Array,
    t: float,
    dt: float,
) -> int:
    """Run `step` on packed vectors; return its flags."""
    settings = settings_of(settings_vector, model)
    state = state_of(state_vector, settings)
    signals = signals_of(signals_vector, settings)
    sample = sample_of(sample_vector, settings)
    checks = checks_of(checks_vector, settings)
    return step(
        law,
        settings,
        checks,
        reference_vector,
        state,
        signals,
        t,
        dt,
        measurement,
        sample,
    )


@kernel
def advance(
    law: Law,
    model: ArmModel,
    settings_vector: Array,
    state_vector: Array,
    signals_vector: Array,
    sample_vector: Array,
) -> None:
    """Advance the memory of the law by the sample of the last `update`, whose torque is sent."""
    settings = settings_of(settings_vector, model)
    state = state_of(state_vector, settings)
    signals = signals_of(signals_vector, settings)
    dt, saturated = signals.dt[0], torque.is_cut(signals.saturation)
    law.finish(settings, state, signals, dt, saturated)
    state.samples[0] += 1.0
    fill_sample(settings, state, signals, sample_of(sample_vector, settings))


@kernel
def compare(
    model: ArmModel,
    settings_vector: Array,
    checks_vector: Array,
    measurement: Array,
    dt: float,
) -> bool:
    """Run `compare_velocities` on packed vectors, without the law."""
    settings = settings_of(settings_vector, model)
    checks = checks_of(checks_vector, settings)
    T = checks.sample_time[0]
    return compare_velocities(checks.sensor, checks.oscillation, T, dt, measurement)
