# SPDX-License-Identifier: Apache-2.0
"""Compiled checks of every joint state and every sample, which only set flags.

The supervisor derives the reason for each flag.
"""

from __future__ import annotations

from math import isfinite
from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, Cell, size_of, view_of
from blf_dsc_controller.law.state import LINEAR, Sample, Settings, Signals, State

SUSPECT = 1
"""A value that is not finite, a torque demand past its limit, or too large an error."""

OUTSIDE = 2
"""An error outside its bound."""

NO_EFFECT = 8
"""Commands that have changed without any joint moving: they do not reach the arm, or it is held."""

INVALID = 4
"""A joint state that is not finite or too fast; the law did not use it."""


class Checks(NamedTuple):
    """Limits of the checks, and the values that they keep from past samples."""

    velocity_limit: Cell  # rad/s, of each joint; 0 disables all checks
    error_ratio: Cell  # |xi1| / k from which an error is suspect; 0: never
    ratio: Annotated[Array, 'n']  # largest |xi1| / k so far
    kept: Annotated[Array, 'm + n']  # estimates and d^3 of the last sample that was not suspect
    sample_time: Cell  # s, for the check of the effect of commands; 0: none
    last: Annotated[Array, 'n']  # N m, command of the last sample
    chatter: Annotated[Array, 'n']  # (N m)^2, mean square step of the commands over _CHATTERS
    still: Cell  # s, since a joint has last moved
    q: Annotated[Array, 'n']  # rad, where it has
    moved: Annotated[Array, 'm + n']  # estimates and d^3 of then
    recent: Annotated[Array, 'n']  # N m, average of the commands over _RECENT
    before: Annotated[Array, 'n']  # N m, average of them over _BEFORE
    compares: Cell  # 1: measured efforts are torques, to be compared with the commands
    lack: Annotated[Array, 'n']  # N m, average of commands less efforts over _RECENT
    known: Annotated[Array, 'n']  # N m, of it the error of the model of what the drives add
    lacking: Cell  # s, since a lack has become too large
    read: Annotated[Array, '2 * n']  # q and dq as last read
    age: Cell  # s, since they were new
    used: Annotated[Array, '3 * n']  # the measurement that the law uses


_STILL = 0.02  # of the bound: a joint that stays within has not moved
_CHANGED = 0.1  # of the torque limit: a command that differs by more should have moved something
_RECENT = 0.05  # s, past the chatter of encoders' steps in the velocities
_BEFORE = 1.0  # s
_CHATTERS = 0.5  # s
_LASTING = 0.1  # s, for which the efforts have to differ from the commands
_BRIDGED = 3.5  # samples, for which a reading may be repeated

checks_of, checks_size = view_of(Checks), size_of(Checks)


@inner
def is_valid_state(settings: Settings, checks: Checks, measurement: Array) -> bool:
    """Check that the used values of [q, dq, applied torque] (3 n,) are finite and not too fast."""
    n = settings.n
    for i in range(n):
        if not (isfinite(measurement[i]) and abs(measurement[n + i]) <= checks.velocity_limit[0]):
            return False
    return True


@inner
def bridge_repeats(
    settings: Settings, checks: Checks, state: State, dt: float, measurement: Array
) -> None:
    """Write the measurement (3 n,) that the law uses to `checks.used`.

    Drivers that do not wait for their arm send a reading once more, with a new stamp: an arm in
    motion that seems to stand still for a sample.  It is continued at its velocity.
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
def check_error(settings: Settings, checks: Checks, xi1: Array, bound: Array) -> int:
    """Return the flags for the errors (n,) [rad]; update the largest ratio."""
    flags = 0
    error_ratio = checks.error_ratio[0] if settings.surface != LINEAR else 0.0
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
def check_effect(
    settings: Settings, checks: Checks, state: State, signals: Signals, sample: Sample
) -> int:
    """Return the flags for commands without effect; call it once the sample's values are kept.

    While no joint moves, gravity does not change: the commands should not either, except by what
    overcomes stiction. Otherwise brakes hold the arm, or its effort controller is not active, and
    the law learns what its own commands say. Slower drifts show in efforts that are torques.
    """
    begins = state.samples[0] <= 1.0
    moves = begins
    for i in range(settings.n):
        moved = abs(sample.qr[i] + sample.xi1[i] - checks.q[i])
        moves = moves or not moved < _STILL * sample.bound[i]
    T = checks.sample_time[0]
    flags = compare_effort(settings, checks, signals, sample, begins, moves)
    checks.still[0] = 0.0 if moves else checks.still[0] + T
    for i in range(settings.n):
        smooth = 1.0 if begins else min(1.0, T / _RECENT)
        checks.recent[i] += smooth * (sample.torque[i] - checks.recent[i])
        if moves:
            checks.q[i] = sample.qr[i] + sample.xi1[i]
            checks.before[i] = checks.recent[i]
        else:
            checks.before[i] += min(1.0, T / _BEFORE) * (sample.torque[i] - checks.before[i])
        change = abs(checks.recent[i] - checks.before[i])
        if checks.still[0] > _RECENT and change > _CHANGED * settings.torque_limit[i]:
            flags |= NO_EFFECT | SUSPECT
    if moves and checks.lacking[0] == 0.0:
        for j in range(settings.m + settings.n):
            checks.moved[j] = checks.kept[j]
    return flags


@inner
def compare_effort(
    settings: Settings, checks: Checks, signals: Signals, sample: Sample, begins: bool, moves: bool
) -> int:
    """Return the flags for efforts that do not follow the commands.

    The drives' own model of what they add may differ from the law's: then what the efforts lack
    must not change while no joint moves.
    """
    if checks.compares[0] == 0.0:
        return 0
    T, is_lacking = checks.sample_time[0], False
    is_relative = settings.drive > 0 and settings.effort_is_whole == 1
    for i in range(settings.n):
        lack = sample.torque[i] - checks.used[2 * settings.n + i]
        if is_relative:
            lack += signals.added[i]
        if begins:
            checks.lack[i] = lack if is_relative else 0.0
        elif isfinite(lack):
            checks.lack[i] += min(1.0, T / _RECENT) * (lack - checks.lack[i])
        if moves:
            checks.known[i] = checks.lack[i] if is_relative else 0.0
        excess = abs(checks.lack[i] - checks.known[i])
        is_lacking = is_lacking or excess > _CHANGED * settings.torque_limit[i]
    checks.lacking[0] = checks.lacking[0] + T if is_lacking else 0.0
    return NO_EFFECT | SUSPECT if checks.lacking[0] > _LASTING else 0


@inner
def average_steps(settings: Settings, checks: Checks, state: State, sample: Sample) -> None:
    """Update the mean square step of the commands, which coarse encoders make chatter."""
    share = min(1.0, checks.sample_time[0] / _CHATTERS)
    for i in range(settings.n):
        step = sample.torque[i] - checks.last[i] if state.samples[0] > 1.0 else 0.0
        checks.chatter[i] += share * (step * step - checks.chatter[i])
        checks.last[i] = sample.torque[i]


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
        if not (within and isfinite(sample.torque[i]) and isfinite(state.disturbance[i])):
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
            flags |= check_effect(settings, checks, state, signals, sample)
    return flags
