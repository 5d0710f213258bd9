# SPDX-License-Identifier: Apache-2.0
"""Whether commands have an effect: on the positions, or on measured efforts.

Whether a joint has moved is a matter of its sensor, not of the bound: its position has
changed by more than the sensor's noise and steps explain.  A wide bound makes no
difference.
"""

from __future__ import annotations

from math import isfinite, sqrt

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.law.check_state import NO_EFFECT, SUSPECT, Checks
from blf_dsc_controller.law.sensor import position_changed
from blf_dsc_controller.law.state import Sample, Settings, Signals, State

# of the torque limit: a command that differs by more should have moved something
_CHANGED = 0.1
# of the rms step of the commands, in addition: so much of the chatter by coarse encoders
# is left in their average
_CHATTERED = 0.5
_RECENT = 0.05  # s, past the chatter of encoders' steps in the velocities
_BEFORE = 1.0  # s
_CHATTERS = 0.5  # s
_LASTING = 0.1  # s, for which the efforts have to differ from the commands


@inner
def average_steps(
    settings: Settings, checks: Checks, state: State, sample: Sample
) -> None:
    """Update the mean square step of the commands, which coarse encoders make chatter."""
    share = min(1.0, checks.sample_time[0] / _CHATTERS)
    for i in range(settings.n):
        step = sample.torque[i] - checks.last[i] if state.samples[0] > 1.0 else 0.0
        checks.chatter[i] += share * (step * step - checks.chatter[i])
        checks.last[i] = sample.torque[i]


@inner
def has_moved(checks: Checks, n: int) -> bool:
    """Whether a joint is elsewhere than where one has last moved."""
    moves = False
    for i in range(n):
        moves = moves or position_changed(checks, i, checks.read[i] - checks.q[i])
    return moves


@inner
def asks_for_motion(checks: Checks, sample: Sample, n: int) -> bool:
    """Whether the reference has moved since a joint has, so far that a sensor would show it."""
    asks = False
    for i in range(n):
        asks = asks or position_changed(checks, i, sample.qr[i] - checks.qr[i])
    return asks


@inner
def check_effect(
    settings: Settings, checks: Checks, state: State, signals: Signals, sample: Sample
) -> int:
    """Return the flags for commands without effect; call it once the sample's values are kept.

    The reference has moved on, the commands have changed by more than what overcomes
    stiction, and still no joint has moved: brakes hold the arm, or its effort
    controller is not active, and the law learns what its own commands say.  While the
    reference rests, commands may change without a motion that the sensors resolve: a
    stiff loop takes up a load so.  Slower drifts show in efforts that are torques; an
    effort that follows the commands shows that they have an effect.
    """
    begins = state.samples[0] <= 1.0
    moves = begins or has_moved(checks, settings.n)
    T = checks.sample_time[0]
    flags = compare_effort(settings, checks, signals, sample, begins, moves)
    checks.at_rest[0] = 0.0 if moves else checks.at_rest[0] + T
    has_changed = False
    for i in range(settings.n):
        smooth = 1.0 if begins else min(1.0, T / _RECENT)
        checks.recent[i] += smooth * (sample.torque[i] - checks.recent[i])
        if moves:
            checks.q[i] = checks.read[i]
            checks.qr[i] = sample.qr[i]
            checks.before[i] = checks.recent[i]
        else:
            checks.before[i] += min(1.0, T / _BEFORE) * (
                sample.torque[i] - checks.before[i]
            )
        change = abs(checks.recent[i] - checks.before[i])
        least = _CHANGED * settings.torque_limit[i]
        least += _CHATTERED * sqrt(checks.chatter[i])
        has_changed = has_changed or change > least
    has_changed = has_changed and checks.at_rest[0] > _RECENT
    is_missing = has_changed and asks_for_motion(checks, sample, settings.n)
    if is_missing and not effort_follows(settings, checks):
        flags |= NO_EFFECT | SUSPECT
    if moves and checks.lacking[0] == 0.0:
        for j in range(settings.m + settings.n):
            checks.moved[j] = checks.kept[j]
    return flags


@inner
def effort_follows(settings: Settings, checks: Checks) -> bool:
    """Whether measured efforts are torques and do what is commanded."""
    follows = bool(checks.compares[0] == 1.0) and bool(checks.lacking[0] == 0.0)
    for i in range(settings.n):
        follows = follows and isfinite(checks.used[2 * settings.n + i])
    return follows


@inner
def compare_effort(
    settings: Settings,
    checks: Checks,
    signals: Signals,
    sample: Sample,
    begins: bool,
    moves: bool,
) -> int:
    """Return the flags for efforts that do not follow the commands.

    The drives' own model of what they add may differ from the law's: then what the
    efforts lack must not change while no joint moves.  In motion its usual value
    explains an error past the bound.
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
            checks.usual[i] = checks.lack[i]
        elif isfinite(lack):
            checks.lack[i] += min(1.0, T / _RECENT) * (lack - checks.lack[i])
            checks.usual[i] += min(1.0, T / _BEFORE) * (lack - checks.usual[i])
        if moves:
            checks.lack_in_motion[i] = checks.lack[i] if is_relative else 0.0
        excess = abs(checks.lack[i] - checks.lack_in_motion[i])
        is_lacking = is_lacking or excess > _CHANGED * settings.torque_limit[i]
    checks.lacking[0] = checks.lacking[0] + T if is_lacking else 0.0
    return NO_EFFECT | SUSPECT if checks.lacking[0] > _LASTING else 0
