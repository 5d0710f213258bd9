# SPDX-License-Identifier: Apache-2.0
"""Whether commands have an effect: on the positions, or on measured efforts.

Whether a joint has moved is a matter of its sensor, not of the bound: its position has
changed by more than the sensor's noise and steps explain.  A wide bound makes no
difference.
"""

from __future__ import annotations

from math import isfinite, sqrt
from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, Cell
from blf_dsc_controller.law import sensor, torque

# of the torque limit: a command that differs by more should have moved something
_CHANGED_TORQUE = 0.1
# of the rms step of the commands, in addition: so much of the chatter by coarse encoders
# is left in their average
_CHATTERED = 0.5
_RECENT_TIME = 0.05  # s, past the chatter of encoders' steps in the velocities
_EARLIER_TIME = 1.0  # s
_CHATTER_TIME = 0.5  # s
_SHORTFALL_TIME = 0.1  # s, for which the efforts have to differ from the commands


class State(NamedTuple):
    """What is kept from past samples."""

    last: Annotated[Array, 'n']  # N m, command of the last sample
    # (N m)^2, mean square step of the commands over _CHATTER_TIME
    chatter: Annotated[Array, 'n']
    at_rest: Cell  # s, since a joint has last moved
    q: Annotated[Array, 'n']  # rad, where it has
    qr: Annotated[Array, 'n']  # rad, the reference of then
    recent: Annotated[Array, 'n']  # N m, average of the commands over _RECENT_TIME
    before: Annotated[Array, 'n']  # N m, average of them over _EARLIER_TIME
    compares: Cell  # 1: measured efforts are torques, to be compared with the commands
    # N m, average of commands less efforts over _RECENT_TIME
    shortfall: Annotated[Array, 'n']
    # N m, of it the error of the model of what the drives add
    shortfall_in_motion: Annotated[Array, 'n']
    mean_shortfall: Annotated[Array, 'n']  # N m, average of it over _EARLIER_TIME
    short_for: Cell  # s, for which the shortfall has been too large


class Sample(NamedTuple):
    """What the check reads of a sample."""

    q: Array  # (n,) rad, as read
    qr: Array  # (n,) rad
    effort: Array  # (n,) as measured
    command: Array  # (n,) N m
    added: Array  # (n,) N m, what the drives add to it
    begins: bool  # there is none before it
    dt: float  # s, a sample time


@inner
def average_steps(state: State, sample: Sample) -> None:
    """Update the mean square step of the commands [(N m)^2], which coarse encoders make chatter."""
    gain = min(1.0, sample.dt / _CHATTER_TIME)
    for i in range(sample.q.size):
        step = 0.0 if sample.begins else sample.command[i] - state.last[i]
        state.chatter[i] += gain * (step * step - state.chatter[i])
        state.last[i] = sample.command[i]


@inner
def is_elsewhere(readings: sensor.State, position: Array, earlier: Array) -> bool:
    """Whether a joint is farther from an `earlier` position (n,) [rad] than its sensor explains."""
    moves = False
    for i in range(position.size):
        moves = moves or sensor.position_changed(readings, i, position[i] - earlier[i])
    return moves


@inner
def check_effect(
    limits: torque.Settings, state: State, readings: sensor.State, sample: Sample
) -> tuple[bool, bool]:
    """Update; return whether commands have no effect, and whether a joint moves as it should.

    Commands have no effect where the reference has moved on, they have changed by more than
    what overcomes stiction, and still no joint has moved: brakes hold the arm, or its effort
    controller is not active, and the law would learn from its own commands.

    While the reference rests, commands may change without a motion that the sensors resolve:
    a stiff loop takes up a load so.  Slower drifts are found by efforts that are torques.  An
    effort that follows the commands proves their effect.
    """
    moves = sample.begins or is_elsewhere(readings, sample.q, state.q)
    falls_short = compare_effort(limits, state, sample, moves)
    state.at_rest[0] = 0.0 if moves else state.at_rest[0] + sample.dt
    has_changed = follow_commands(limits, state, sample, moves)
    has_changed = has_changed and state.at_rest[0] > _RECENT_TIME
    is_missing = has_changed and is_elsewhere(readings, sample.qr, state.qr)
    is_missing = is_missing and not effort_follows(state, sample.effort)
    return falls_short or is_missing, moves and state.short_for[0] == 0.0


@inner
def follow_commands(
    limits: torque.Settings, state: State, sample: Sample, moves: bool
) -> bool:
    """Average the commands; return whether they have changed since a joint last moved.

    They have if their average over 50 ms differs from that over a second, or of when a joint
    moved, by a tenth of the torque limit and half of their chatter.
    """
    has_changed = False
    for i in range(sample.q.size):
        command = sample.command[i]
        gain = 1.0 if sample.begins else min(1.0, sample.dt / _RECENT_TIME)
        state.recent[i] += gain * (command - state.recent[i])
        if moves:
            state.q[i] = sample.q[i]
            state.qr[i] = sample.qr[i]
            state.before[i] = state.recent[i]
        else:
            slow_gain = min(1.0, sample.dt / _EARLIER_TIME)
            state.before[i] += slow_gain * (command - state.before[i])
        change = abs(state.recent[i] - state.before[i])
        threshold = _CHANGED_TORQUE * limits.limit[i]
        threshold += _CHATTERED * sqrt(state.chatter[i])
        has_changed = has_changed or change > threshold
    return has_changed


@inner
def effort_follows(state: State, effort: Array) -> bool:
    """Whether measured efforts (n,) are torques, and equal to the commands so far."""
    follows = bool(state.compares[0] == 1.0) and bool(state.short_for[0] == 0.0)
    for i in range(effort.size):
        follows = follows and isfinite(effort[i])
    return follows


@inner
def compare_effort(
    limits: torque.Settings, state: State, sample: Sample, moves: bool
) -> bool:
    """Average commands less efforts; return whether the difference has been too large for too long.

    The drives' own model of what they add may differ from the law's: then the difference must
    not change while no joint moves.  In motion, its excess over the mean explains an error past
    the bound.
    """
    if state.compares[0] == 0.0:
        return False
    is_short = False
    is_relative = limits.drive > 0 and limits.effort_is_whole == 1
    for i in range(sample.q.size):
        shortfall = sample.command[i] - sample.effort[i]
        if is_relative:
            shortfall += sample.added[i]
        if sample.begins:
            state.shortfall[i] = shortfall if is_relative else 0.0
            state.mean_shortfall[i] = state.shortfall[i]
        elif isfinite(shortfall):
            change = shortfall - state.shortfall[i]
            state.shortfall[i] += min(1.0, sample.dt / _RECENT_TIME) * change
            change = shortfall - state.mean_shortfall[i]
            state.mean_shortfall[i] += min(1.0, sample.dt / _EARLIER_TIME) * change
        if moves:
            state.shortfall_in_motion[i] = state.shortfall[i] if is_relative else 0.0
        excess = abs(state.shortfall[i] - state.shortfall_in_motion[i])
        is_short = is_short or excess > _CHANGED_TORQUE * limits.limit[i]
    state.short_for[0] = state.short_for[0] + sample.dt if is_short else 0.0
    return bool(state.short_for[0] > _SHORTFALL_TIME)
