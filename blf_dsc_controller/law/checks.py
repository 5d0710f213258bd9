# SPDX-License-Identifier: Apache-2.0
"""Compiled checks of every joint state and every sample, which only set flags.

The supervisor derives the reason for each flag.
"""

from __future__ import annotations

from math import isfinite

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.law import (
    effect,
    kept_estimates,
    oscillation,
    torque_sensors,
)
from blf_dsc_controller.law.check_state import (
    NO_EFFECT,
    OUTSIDE,
    SUSPECT,
    Checks,
    are_on,
)
from blf_dsc_controller.law.state import Sample, Settings, Signals, State


@inner
def is_valid_state(checks: Checks, measurement: Array) -> bool:
    """Whether q and dq of [q, dq, effort] (3 n,) are finite, and dq within the velocity limit."""
    n = measurement.size // 3
    for i in range(n):
        if not (
            isfinite(measurement[i])
            and abs(measurement[n + i]) <= checks.velocity_limit[i]
        ):
            return False
    return True


@inner
def watch_oscillation(
    settings: Settings, checks: Checks, signals: Signals, begins: bool, dt: float
) -> bool:
    """Update the half waves of the joints; return whether an oscillation is to be reported now.

    It is False while nothing is checked, and at the first sample, which `begins`.  `dt` [s] is
    the time since the last sample.
    """
    if not are_on(checks) or checks.sample_time[0] <= 0.0:
        return False
    half_waves = checks.oscillation
    limit = settings.torque.limit
    if begins:
        oscillation.begin(half_waves, signals.xi1, signals.applied)
        return False
    oscillation.watch(
        half_waves,
        limit,
        signals.xi1,
        signals.applied,
        checks.sensor.noise,
        checks.sensor.resolution,
        dt,
    )
    return oscillation.count_down(half_waves, limit, dt)


@inner
def check_error(
    checks: Checks, has_barrier: bool, xi1: Array, bound: Array
) -> tuple[int, float]:
    """Return the flags for the errors xi1 (n,) [rad] and their bound (n,) [rad], and max |xi1| / k.

    Updates `checks.ratio`.  OUTSIDE: an error is at its bound or beyond.  SUSPECT: one is at
    `error_ratio` times its bound or beyond, if the law has a barrier.
    """
    flags = 0
    largest = 0.0
    error_ratio = checks.error_ratio[0] if has_barrier else 0.0
    for i in range(xi1.size):
        ratio = abs(xi1[i]) / bound[i]
        largest = max(largest, ratio)
        if ratio == ratio:  # noqa: PLR0124 - not NaN
            checks.ratio[i] = max(checks.ratio[i], ratio)
        if not ratio < 1.0:
            flags |= OUTSIDE
        if error_ratio > 0.0 and not ratio < error_ratio:
            flags |= SUSPECT
    return flags, largest


@inner
def may_oscillate(checks: Checks) -> bool:
    """Whether a joint may oscillate: it has made two half waves in a row or more."""
    is_any = False
    for i in range(checks.oscillation.waves.size):
        is_any = is_any or checks.oscillation.waves[i] >= oscillation.SOME
    return is_any


@inner
def is_valid_sample(
    settings: Settings, state: State, signals: Signals, sample: Sample
) -> bool:
    """Whether torque and estimates are finite, and the demand is within the torque limit.

    The estimate of a rejected column is finite in the state but NaN in the sample.
    """
    is_valid = True
    for i in range(settings.n):
        demand = signals.demand[i]
        largest = max(abs(demand), abs(demand - signals.saturation.added[i]))
        is_within = largest <= settings.torque.limit[i]
        is_finite = isfinite(sample.torque[i]) and isfinite(state.disturbance[i])
        is_valid = is_valid and is_within and is_finite
    for j in range(settings.m):
        is_valid = is_valid and isfinite(state.estimate[j])
    return is_valid


@inner
def check_sample(
    settings: Settings, checks: Checks, state: State, signals: Signals, sample: Sample
) -> int:
    """Return the flags for what the law computed in a sample; keep the estimates of a valid one.

    SUSPECT and OUTSIDE are those of `check_error`; a value that is not finite is SUSPECT as well.
    NO_EFFECT: commands do not reach the arm (`effect`).
    """
    flags, ratio = check_error(
        checks, settings.has_barrier == 1, sample.xi1, sample.bound
    )
    if not is_valid_sample(settings, state, signals, sample):
        flags |= SUSPECT
    if flags & SUSPECT != 0:
        return flags
    estimates = checks.estimates
    is_sound = not torque_sensors.is_fading(state.observer.faded)
    if is_sound:
        kept_estimates.keep(
            estimates, state.estimate, state.disturbance, state.observer.steady
        )
    T = checks.sample_time[0]
    if not T > 0.0:
        return flags
    n = settings.n
    begins = state.samples[0] == 0.0
    effect_sample = effect.Sample(
        q=checks.repeats.read[:n],
        qr=sample.qr,
        effort=checks.repeats.used[2 * n :],
        command=sample.torque,
        added=signals.saturation.added,
        begins=begins,
        dt=T,
    )
    effect.average_steps(checks.effect, effect_sample)
    is_sound = is_sound and not may_oscillate(checks)
    kept_estimates.keep_consistent(estimates, ratio, is_sound, begins, T)
    is_missing, moves = effect.check_effect(
        settings.torque, checks.effect, checks.sensor, effect_sample
    )
    if is_missing:
        flags |= NO_EFFECT | SUSPECT
    if moves:
        kept_estimates.keep_moved(estimates)
    return flags
