# SPDX-License-Identifier: Apache-2.0
"""Noise and steps of the joint sensors by their readings, and velocities that are wrong.

The noise is that of second differences, which a smooth motion hardly changes; the step
is the smallest change of a position.

A velocity that is plausible but not that of the arm (stuck, of the wrong sign, of
another joint) turns damping into its opposite.  Positions and velocities pass the same
filter, 1/(tau s + 1):

    derived = s/(tau s + 1) q,        measured = 1/(tau s + 1) dq

They are equal except for noise and the lag of the velocity: in an interval, the
filter's input is the change of the position over it, or the mean of the velocities at
both ends.  Where readings are missing, these ends show little of what was between them:
the filters skip such an interval.  A velocity is contradicted when the mean square of
their difference exceeds half of the larger one's: one that is stuck at 0 gives 1, the
wrong sign 4, a lag of 6 ms 0.5 at 20 Hz.  What a lag explains is none if the joint
oscillates faster than that.
"""

from __future__ import annotations

from math import sqrt
from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, Cell
from blf_dsc_controller.law import oscillation

_NOISE_TIME = 0.5  # s, over which the noise is averaged
_FILTERED_SIGMAS = 3.0  # of a filtered value
# of a reading: two readings differ by as much only once in a day, at 1 kHz
_MOVED = 8.0
_FLICKER_STEPS = 1.5  # a reading between two steps of the sensor flickers by one
FILTER = 0.03
"""Time constant tau [s] of the filtered velocities."""
_SQUARE_TIME = 0.1  # s, over which the mean squares are
_WRONG_POWER = 0.5  # of the larger mean square
_LATE_POWER = 0.9  # of the larger mean square: a first-order lag has less than 1
_SECOND = 2.0  # readings before that of a second difference
_ROW = 0.01  # s: up to here, the ends of an interval show the velocity within it
LONG_GAP = 2.5  # samples: states are missing in an interval that is longer than this
SLOW = 0.03  # rad/s: slower motion shows nothing


class State(NamedTuple):
    """What is kept of the readings of q and dq."""

    readings: Cell  # in a row so far
    last_read: Annotated[Array, '2 * n']
    read_before: Annotated[Array, '2 * n']
    noise: Annotated[Array, '2 * n']  # mean square
    resolution: Annotated[Array, 'n']  # rad, smallest change of a position; 0: none yet
    derived: Annotated[Array, 'n']  # rad/s, filtered velocity by the positions
    measured: Annotated[Array, 'n']  # rad/s, measured velocity through the same filter
    # (rad/s)^2, mean squares of their difference and of the larger of both
    mismatch: Annotated[Array, 'n']
    speed: Annotated[Array, 'n']


@inner
def restart(state: State) -> None:
    """Begin with the next reading, as after a gap."""
    state.readings[0] = 0.0


@inner
def position_changed(state: State, i: int, change: float) -> bool:
    """Whether a change of the position of joint i [rad] exceeds noise and steps of its sensor."""
    noise = _MOVED * sqrt(state.noise[i])
    return bool(abs(change) > max(noise, _FLICKER_STEPS * state.resolution[i]))


@inner
def measure_noise(state: State, dt: float, measurement: Array) -> None:
    """Update noise and resolution by a reading, `dt` [s] after the last.

    `measurement` is [q, dq, ...] (2 n or more,).
    """
    n = state.resolution.size
    count = state.readings[0]
    gain = max(min(1.0, dt / _NOISE_TIME), 1.0 / max(1.0, count - 1.0))
    for i in range(2 * n):
        reading = measurement[i]
        if count >= _SECOND:
            second = reading - 2.0 * state.last_read[i] + state.read_before[i]
            state.noise[i] += gain * (second * second / 6.0 - state.noise[i])
        change = abs(reading - state.last_read[i])
        if i < n and count >= 1.0 and change > 0.0:
            is_first = state.resolution[i] == 0.0
            smallest = change if is_first else min(change, state.resolution[i])
            state.resolution[i] = smallest
        state.read_before[i] = state.last_read[i]
        state.last_read[i] = reading


@inner
def compare_velocities(
    state: State,
    half_waves: oscillation.State,
    sample_time: float,
    dt: float,
    measurement: Array,
) -> bool:
    """Update with a reading [q, dq, ...]; return whether a velocity contradicts the positions.

    Args:
        half_waves: oscillation of the joints: a lag explains more of a fast one.
        sample_time: usual time between readings [s].
        dt: time since the last reading [s].
        measurement: the reading (2 n or more,), finite.
    """
    n = state.resolution.size
    measure_noise(state, dt, measurement)
    begins = state.readings[0] == 0.0
    state.readings[0] += 1.0
    gain = min(1.0, dt / FILTER)
    square_gain = min(1.0, dt / _SQUARE_TIME)
    is_gap = dt > max(_ROW, LONG_GAP * sample_time)
    is_wrong = False
    for i in range(n):
        if begins:
            state.measured[i] = measurement[n + i]
            state.derived[i] = measurement[n + i]
            state.mismatch[i] = state.speed[i] = 0.0
            continue
        if is_gap:
            continue
        change = (measurement[i] - state.read_before[i]) / dt
        velocity = 0.5 * (measurement[n + i] + state.read_before[n + i])
        state.derived[i] += gain * (change - state.derived[i])
        state.measured[i] += gain * (velocity - state.measured[i])
        difference = state.derived[i] - state.measured[i]
        state.mismatch[i] += square_gain * (difference * difference - state.mismatch[i])
        larger = max(abs(state.derived[i]), abs(state.measured[i]))
        state.speed[i] += square_gain * (larger * larger - state.speed[i])
        is_wrong = is_wrong or is_contradicted(state, half_waves, i, gain)
    return is_wrong


@inner
def is_contradicted(
    state: State, half_waves: oscillation.State, i: int, gain: float
) -> bool:
    """Whether the velocity of joint i contradicts its positions, which no lag explains.

    `gain` is that of the filter 1/(tau s + 1) in a sample.
    """
    threshold = max(_WRONG_POWER * state.speed[i], explained_square(state, i, gain))
    is_lag = oscillation.is_fast(half_waves, i) and is_late(state, i)
    return bool(state.mismatch[i] > threshold and not is_lag)


@inner
def is_late(state: State, i: int) -> bool:
    """Whether a lag of the velocity of joint i would explain how it contradicts the positions.

    One that is stuck has a mean square difference of 1, one of the wrong sign 4.
    """
    return bool(state.mismatch[i] < _LATE_POWER * state.speed[i])


@inner
def explained_square(state: State, i: int, gain: float) -> float:
    """Return the mean square difference [(rad/s)^2] that noise and steps of the sensor explain.

    `gain` is that of the filter 1/(tau s + 1) in a sample.
    """
    n = state.resolution.size
    position = (
        _FILTERED_SIGMAS * _FILTERED_SIGMAS * state.noise[i] + state.resolution[i] ** 2
    )
    velocity = _FILTERED_SIGMAS * _FILTERED_SIGMAS * state.noise[n + i] * 0.5 * gain
    return float(SLOW * SLOW + position / (FILTER * FILTER) + velocity)
