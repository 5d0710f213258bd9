# SPDX-License-Identifier: Apache-2.0
"""What readings show of their sensor: its noise and steps, and velocities that are wrong.

The noise is that of second differences, in which a smooth motion hardly shows; the step
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

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.law.check_state import Checks
from blf_dsc_controller.law.oscillation import is_fast

_NOISE = 0.5  # s, over which the noise is averaged
_SIGMAS = 3.0  # of a filtered value
# of a reading: two readings differ by as much only once in a day, at 1 kHz
_MOVED = 8.0
_STEPS = 1.5  # a reading between two steps of the sensor flickers by one
FILTER = 0.03
"""Time constant tau [s] of the filtered velocities."""
_POWER = 0.1  # s, over which the mean squares are
_WRONG = 0.5  # of the larger mean square
_LATE = 0.9  # of the larger mean square: a first-order lag has less than 1
_SECOND = 2.0  # readings before that of a second difference
_ROW = 0.01  # s: up to here, the ends of an interval show the velocity within it
_GAP = 2.5  # samples: readings are missing in an interval that is also longer than this
_SLOW = 0.03  # rad/s: slower motion shows nothing


@inner
def position_changed(checks: Checks, i: int, change: float) -> bool:
    """Whether noise and steps of the sensor of joint i do not explain a change [rad]."""
    noise = _MOVED * sqrt(checks.noise[i])
    return bool(abs(change) > max(noise, _STEPS * checks.resolution[i]))


@inner
def measure_noise(checks: Checks, dt: float, measurement: Array, n: int) -> None:
    """Update noise and resolution by a reading [q, dq, ...], `dt` [s] after the last."""
    count = checks.readings[0]
    share = max(min(1.0, dt / _NOISE), 1.0 / max(1.0, count - 1.0))
    for i in range(2 * n):
        reading = measurement[i]
        if count >= _SECOND:
            second = reading - 2.0 * checks.last_read[i] + checks.read_before[i]
            checks.noise[i] += share * (second * second / 6.0 - checks.noise[i])
        change = abs(reading - checks.last_read[i])
        if i < n and count >= 1.0 and change > 0.0:
            is_first = checks.resolution[i] == 0.0
            least = change if is_first else min(change, checks.resolution[i])
            checks.resolution[i] = least
        checks.read_before[i] = checks.last_read[i]
        checks.last_read[i] = reading


@inner
def compare_velocities(checks: Checks, dt: float, measurement: Array, n: int) -> bool:
    """Update with a reading [q, dq, ...]; return whether a velocity is contradicted.

    The readings are finite, and `dt` [s] apart.
    """
    measure_noise(checks, dt, measurement, n)
    begins = checks.readings[0] == 0.0
    checks.readings[0] += 1.0
    share = min(1.0, dt / FILTER)
    slow = min(1.0, dt / _POWER)
    is_gap = dt > max(_ROW, _GAP * checks.sample_time[0])
    is_wrong = False
    for i in range(n):
        if begins:
            checks.measured[i] = measurement[n + i]
            checks.derived[i] = measurement[n + i]
            checks.mismatch[i] = checks.speed[i] = 0.0
            continue
        if is_gap:
            continue
        change = (measurement[i] - checks.read_before[i]) / dt
        velocity = 0.5 * (measurement[n + i] + checks.read_before[n + i])
        checks.derived[i] += share * (change - checks.derived[i])
        checks.measured[i] += share * (velocity - checks.measured[i])
        difference = checks.derived[i] - checks.measured[i]
        checks.mismatch[i] += slow * (difference * difference - checks.mismatch[i])
        larger = max(abs(checks.derived[i]), abs(checks.measured[i]))
        checks.speed[i] += slow * (larger * larger - checks.speed[i])
        least = max(_WRONG * checks.speed[i], unseen(checks, i, share, n))
        is_lag = is_fast(checks.oscillation, i) and is_late(checks, i)
        is_wrong = is_wrong or (checks.mismatch[i] > least and not is_lag)
    return is_wrong


@inner
def is_late(checks: Checks, i: int) -> bool:
    """Whether a lag of the velocity of joint i would explain how it contradicts the positions.

    One that is stuck has a mean square difference of 1, one of the wrong sign 4.
    """
    return bool(checks.mismatch[i] < _LATE * checks.speed[i])


@inner
def unseen(checks: Checks, i: int, share: float, n: int) -> float:
    """Return the mean square [(rad/s)^2] of the difference that noise and steps explain."""
    position = _SIGMAS * _SIGMAS * checks.noise[i] + checks.resolution[i] ** 2
    velocity = _SIGMAS * _SIGMAS * checks.noise[n + i] * 0.5 * share
    return float(_SLOW * _SLOW + position / (FILTER * FILTER) + velocity)
