# SPDX-License-Identifier: Apache-2.0
"""Compiled checks of every joint state and every sample, which only set flags.

The supervisor derives the reason for each flag.
"""

from __future__ import annotations

from math import isfinite

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.law import oscillation
from blf_dsc_controller.law.check_state import OUTSIDE, SUSPECT, Checks
from blf_dsc_controller.law.effect import average_steps, check_effect
from blf_dsc_controller.law.state import Sample, Settings, Signals, State

_BRIDGED = 3.5  # samples, for which a reading may be repeated
_RELAXED = 1.4  # s, in which the least error may double, nearly: an error grows faster
_SMALL = 0.01  # of the bound: an error that has not grown


@inner
def is_valid_state(settings: Settings, checks: Checks, measurement: Array) -> bool:
    """Check that the used values of [q, dq, applied torque] (3 n,) are finite and not too fast."""
    n = settings.n
    for i in range(n):
        if not (
            isfinite(measurement[i])
            and abs(measurement[n + i]) <= checks.velocity_limit[0]
        ):
            return False
    return True


@inner
def bridge_repeats(
    settings: Settings, checks: Checks, state: State, dt: float, measurement: Array
) -> None:
    """Write the measurement (3 n,) that the law uses to `checks.used`.

    Drivers that do not wait for their arm send a reading once more, with a new stamp:
    an arm in motion that seems to stand still for a sample.  It is continued at its
    velocity.
    """
    n = settings.n
    repeats = state.samples[0] > 0.0
    for i in range(2 * n):
        repeats = repeats and measurement[i] == checks.read[i]
        checks.read[i] = measurement[i]
    checks.age[0] = checks.age[0] + dt if repeats else 0.0
    is_bridged = repeats and checks.age[0] < _BRIDGED * checks.sample_time[0]
    for i in range(n):
        checks.used[i] = measurement[i]
        checks.used[n + i] = measurement[n + i]
        checks.used[2 * n + i] = measurement[2 * n + i]
        if is_bridged:
            checks.used[i] += checks.age[0] * measurement[n + i]


@inner
def watch_oscillation(
    settings: Settings, checks: Checks, state: State, signals: Signals, dt: float
) -> bool:
    """Return whether an oscillation of the arm is to be reported."""
    now = checks.oscillation
    if state.samples[0] == 0.0:
        oscillation.begin(now, signals.xi1, signals.applied)
        return False
    oscillation.watch(
        now,
        settings.torque_limit,
        signals.xi1,
        signals.applied,
        checks.noise,
        checks.resolution,
        dt,
    )
    return oscillation.is_due(now, settings.torque_limit, dt)


@inner
def check_error(settings: Settings, checks: Checks, xi1: Array, bound: Array) -> int:
    """Return the flags for the errors (n,) [rad]; update the largest ratio."""
    flags = 0
    error_ratio = checks.error_ratio[0] if settings.has_barrier == 1 else 0.0
    for i in range(settings.n):
        now = abs(xi1[i]) / bound[i]
        if now == now:  # noqa: PLR0124 - not NaN
            checks.ratio[i] = max(checks.ratio[i], now)
        if not now < 1.0:
            flags |= OUTSIDE
        if error_ratio > 0.0 and not now < error_ratio:
            flags |= SUSPECT
    return flags


@inner
def keep_consistent(
    settings: Settings, checks: Checks, state: State, sample: Sample
) -> None:
    """Keep the estimates of the smallest error of late, from before an error grows.

    Commands that do not reach the arm make its error grow, and the disturbance estimate
    with it.  What is learned while the arm may oscillate is as wrong.
    """
    ratio = 0.0
    oscillates = False
    for i in range(settings.n):
        ratio = max(ratio, abs(sample.xi1[i]) / sample.bound[i])
        oscillates = oscillates or checks.oscillation.waves[i] >= oscillation.SOME
    least = checks.least_ratio[0] * (1.0 + checks.sample_time[0] / _RELAXED)
    least = max(_SMALL, least)
    if (ratio > least or oscillates) and state.samples[0] > 1.0:
        checks.least_ratio[0] = least
        return
    checks.least_ratio[0] = ratio
    for j in range(settings.m + settings.n):
        checks.consistent[j] = checks.kept[j]
    for i in range(settings.n):
        checks.consistent_scale[i] = state.rotors.gain_scale[i]


@inner
def check_sample(
    settings: Settings, checks: Checks, state: State, signals: Signals, sample: Sample
) -> int:
    """Return the flags for what the law computed in a sample; update the kept values.

    The estimate of a rejected column is finite in the state but NaN in the sample.
    """
    flags = check_error(settings, checks, sample.xi1, sample.bound)
    for i in range(settings.n):
        demand = signals.demand[i]
        largest = max(abs(demand), abs(demand - signals.added[i]))
        within = largest <= settings.torque_limit[i]
        if not (
            within and isfinite(sample.torque[i]) and isfinite(state.disturbance[i])
        ):
            flags |= SUSPECT
    for j in range(settings.m):
        if not isfinite(state.estimate[j]):
            flags |= SUSPECT
    if flags & SUSPECT == 0:
        for j in range(settings.m):
            checks.kept[j] = state.estimate[j]
        for i in range(settings.n):
            checks.kept[settings.m + i] = state.disturbance[i]
        if checks.sample_time[0] > 0.0:
            average_steps(settings, checks, state, sample)
            keep_consistent(settings, checks, state, sample)
            flags |= check_effect(settings, checks, state, signals, sample)
    return flags
