# SPDX-License-Identifier: Apache-2.0
"""Whether a joint oscillates: half waves of its error that are regular and do not die out.

The band begins at 8 Hz, where a motion ends, and ends at a third of the sample rate.
In it, the error e and the applied torque tau of each joint are

    p = (s/(s + w))^2 e,      u = s/(s + w) tau,      w = 2 pi 8 Hz

A half wave of p ends where p has turned back by a quarter of it.  It counts if it is
longer than what noise and steps of the sensor explain, if the amplitude
sqrt(2 mean (u - m)^2) of the torque is a twentieth of its limit, if it takes about as
long as those before it, and if it is not shorter than four half waves earlier.  m is the
mean of u in this half wave and the one before.  Six in a row are an oscillation, or four
of which the last two grow:

- Noise, also that of coarse encoders, is irregular, or its half waves are too short.
- A push, a load that is picked up, a reversal of friction, or a step of the reference
  excites what dies out, in any loop that is not about to oscillate.
- Where friction reverses, its compensation sweeps the torque by more than a twentieth,
  and a light link may rattle in the play of its gear.  m takes that sweep away.
- Torque ripple has about a hundredth of the limit.
- A reference of fast tones is followed: it is not in the error.

It is taken from the positions: a velocity of the wrong sign changes nothing.
"""

from __future__ import annotations

from math import inf, pi, sqrt
from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, Cell
from blf_dsc_controller.law import half_waves
from blf_dsc_controller.law.lag import filter_gain

WAVES = 6
"""Half waves in a row that are an oscillation."""

SOME = 2
"""Half waves in a row from which on a joint may oscillate."""

FEW = 3
"""Half waves in a row that explain a stop: an oscillation may grow fast."""

VIOLENT = 0.5
"""Part of the torque limit, as amplitude of its torque, from which nothing may wait."""

PATIENCE = 0.25
"""Time [s] from one report to the next, in which an oscillation can die out."""

_LOWEST_FREQUENCY = 8.0  # Hz
_TIME_CONSTANT = 0.5 / (pi * _LOWEST_FREQUENCY)  # s, of the lags
_LONGEST_HALF_WAVE = 0.5 / _LOWEST_FREQUENCY  # s, half period
_FORGOTTEN = 1.5 * _LONGEST_HALF_WAVE  # s, with the quarter to turn back
_FAST_FREQUENCY = 20.0  # Hz, from which a velocity may lag far behind its positions
_MIN_AMPLITUDE = 0.05  # of the torque limit, amplitude of its torque
# a half wave that is longer is one of the arm: standard deviations of the sensor's
# noise, which the loop makes larger, and steps of the sensor
_NOISE_SIGMAS = 10.0
_SENSOR_STEPS = 2.0
_REGULAR_RATIO = 1.6  # ratio of two half periods
_LASTING_RATIO = 0.85  # of the half wave four earlier
_WAVES_EARLIER = 4
_GROWING_RATIO = 1.25  # times the half wave two earlier, of the same sign
_GROWING_WAVES = 2.0  # half waves in a row
_AVERAGED_WAVES = 4.0  # half periods


class State(NamedTuple):
    """What is kept of each joint from sample to sample."""

    slow: Annotated[Array, 2, 'n']  # rad, lags of e
    torque: Annotated[Array, 'n']  # N m, lag of tau
    square: Annotated[Array, 'n']  # (N m)^2 s, int u^2 since the last half wave ended
    sum: Annotated[Array, 'n']  # N m s, int u since then
    span: Annotated[Array, 'n']  # s, since then
    before: Annotated[Array, 2, 'n']  # N m s and s, `sum` and `span` of that half wave
    amplitude: Annotated[Array, 'n']  # N m, of u in the last half wave
    present: half_waves.State  # of p, rad
    travel: Annotated[Array, 4, 'n']  # rad, of the last half waves
    half: Annotated[Array, 'n']  # s, mean half period
    waves: Annotated[Array, 'n']  # half waves in a row that count
    grown: Annotated[Array, 'n']  # of them, the last ones that grow
    calm: Annotated[Array, 'n']  # s, since there were FEW or more
    wait: Cell  # s, until an oscillation may be reported


@inner
def watch(
    state: State,
    limit: Array,
    error: Array,
    torque: Array,
    noise: Array,
    resolution: Array,
    dt: float,
) -> None:
    """Update the half waves by the errors and torques of the last interval, `dt` [s].

    Args:
        limit: torque limit (n,) [N m].
        error: e (n,) [rad].
        torque: tau (n,) [N m].
        noise: mean square of the sensor's noise (n,) [rad^2].
        resolution: step of the sensor (n,) [rad].
    """
    gain = filter_gain(_TIME_CONSTANT, dt)
    for i in range(limit.size):
        first = error[i] - state.slow[0, i]
        state.slow[0, i] += gain * first
        p = first - state.slow[1, i]
        state.slow[1, i] += gain * p
        u = torque[i] - state.torque[i]
        state.torque[i] += gain * u
        state.square[i] += dt * u * u
        state.sum[i] += dt * u
        state.span[i] += dt
        state.present.since[i] += dt
        state.calm[i] += dt
        if state.present.since[i] > _FORGOTTEN:
            forget(state, i, p)
        back = half_waves.follow(state.present, i, p)
        if back == 0.0:
            continue
        threshold = max(_NOISE_SIGMAS * sqrt(noise[i]), _SENSOR_STEPS * resolution[i])
        travel = half_waves.travel(state.present, i)
        if back > max(threshold, half_waves.TURNED_BACK * travel):
            count(state, i, travel, travel > threshold, _MIN_AMPLITUDE * limit[i])
            half_waves.end(state.present, i, p)


@inner
def begin(state: State, error: Array, torque: Array) -> None:
    """Begin with an error (n,) [rad] and a torque (n,) [N m], without any half wave."""
    state.wait[0] = 0.0
    for i in range(error.size):
        state.slow[0, i] = error[i]
        state.slow[1, i] = state.present.direction[i] = 0.0
        state.torque[i] = torque[i]
        state.calm[i] = inf
        forget(state, i, 0.0)


@inner
def oscillates(state: State, i: int) -> bool:
    """Whether joint i oscillates: WAVES half waves in a row, or fewer that grow."""
    return bool(state.waves[i] >= WAVES or grows(state, i))


@inner
def grows(state: State, i: int) -> bool:
    """Whether the last two half waves of joint i grow."""
    return bool(state.grown[i] >= _GROWING_WAVES)


@inner
def is_violent(state: State, limit: Array) -> bool:
    """Whether a joint oscillates with more than VIOLENT of its torque limit (n,) [N m]."""
    is_any = False
    for i in range(limit.size):
        is_strong = state.amplitude[i] > VIOLENT * limit[i]
        is_any = is_any or (is_strong and oscillates(state, i))
    return is_any


@inner
def count_down(state: State, limit: Array, dt: float) -> bool:
    """Count down to the next report; return whether an oscillation is to be reported now.

    `dt` [s] is the time since the last call, `limit` (n,) [N m] the torque limit.  A violent
    oscillation does not wait.
    """
    state.wait[0] = max(0.0, state.wait[0] - dt)
    is_any = False
    for i in range(limit.size):
        is_any = is_any or oscillates(state, i)
    if not is_any or (state.wait[0] > 0.0 and not is_violent(state, limit)):
        return False
    state.wait[0] = PATIENCE
    return True


@inner
def forget(state: State, i: int, p: float) -> None:
    """Forget the half waves of joint i; the next begins at p [rad]."""
    state.waves[i] = state.grown[i] = state.amplitude[i] = 0.0
    state.square[i] = state.sum[i] = state.span[i] = 0.0
    state.before[0, i] = state.before[1, i] = 0.0
    half_waves.begin(state.present, i, p)


@inner
def forget_all(state: State) -> None:
    """Forget the half waves of all joints; the next begin where they are."""
    state.wait[0] = 0.0
    for i in range(state.waves.size):
        forget(state, i, state.present.farthest[i])
        state.calm[i] = inf


@inner
def end_span(state: State, i: int) -> float:
    """Return the amplitude of the torque [N m] in the half wave that ends, and begin another.

    It is about the mean of two half waves; of a first one, which may be half of a wave about
    nothing, it is about 0.
    """
    own_mean = state.sum[i] / state.span[i]
    mean = 0.0
    if state.before[1, i] > 0.0:
        mean = (state.before[0, i] + state.sum[i]) / (
            state.before[1, i] + state.span[i]
        )
    square = state.square[i] / state.span[i] - mean * (2.0 * own_mean - mean)
    state.before[0, i], state.before[1, i] = state.sum[i], state.span[i]
    state.square[i] = state.sum[i] = state.span[i] = 0.0
    return sqrt(2.0 * max(0.0, square))


@inner
def count(state: State, i: int, travel: float, is_clear: bool, strong: float) -> None:
    """Count the half wave of joint i that has ended if it is one of an oscillation.

    Args:
        travel: its height in p [rad].
        is_clear: it is larger than noise and steps of the sensor.
        strong: smallest amplitude of its torque [N m].
    """
    half = state.present.farthest_at[i]
    state.amplitude[i] = end_span(state, i)
    k = int(state.waves[i])
    counts = is_clear and half < _LONGEST_HALF_WAVE and state.amplitude[i] > strong
    ratio = half / state.half[i] if k > 0 else 1.0
    is_regular = 1.0 / _REGULAR_RATIO < ratio < _REGULAR_RATIO
    lasts = (
        k < _WAVES_EARLIER
        or travel > _LASTING_RATIO * state.travel[k % _WAVES_EARLIER, i]
    )
    if not (counts and is_regular and lasts):
        k = 0
    grows = (
        k > 1 and travel > _GROWING_RATIO * state.travel[(k - 2) % _WAVES_EARLIER, i]
    )
    state.grown[i] = state.grown[i] + 1.0 if grows else 0.0
    state.travel[k % _WAVES_EARLIER, i] = travel
    state.half[i] = (
        half
        if k == 0
        else state.half[i] + (half - state.half[i]) / min(k + 1.0, _AVERAGED_WAVES)
    )
    state.waves[i] = k + 1.0 if counts else 0.0
    if state.waves[i] >= FEW:
        state.calm[i] = 0.0


@inner
def is_fast(state: State, i: int) -> bool:
    """Whether joint i seems to oscillate so fast that a filtered velocity lags far behind."""
    return bool(state.waves[i] >= SOME and state.half[i] < 0.5 / _FAST_FREQUENCY)
