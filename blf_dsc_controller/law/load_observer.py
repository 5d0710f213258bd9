# SPDX-License-Identifier: Apache-2.0
"""Load observer: what acts on the links and the model lacks, by joint torque sensors.

A sensor behind a gear shows the torque tau_J that reaches the links, whatever motor and
friction do.  With the row X of the last interval (see `prediction`), by the measured
motion, and P_l, the learned parameters less those of the assumed rotors,

    r = tau_J,L - X_L P_l - bias,       both passed through the lag of velocities and a pole L

is added to the torque: within some 1 / L it has what d^3 and the learning find in seconds.
It is linear in P^, so that it gives up what is learned at once; d^3 then only has to give
up the rest (`handed_over`).  Near the reference it is the feedback

    r = L / (s + L) (M - M_l) s^2 xi1

which vanishes for the right inertia M_l, and is stable for any M > 0 as long as

    |L / (s + L) T (M - M_l) / M| < 1     where its phase is 0,

T being the response of the drives: positive feedback below 1 makes a heavy arm light, and
a pole L below that of the drives leaves no phase for a light one.  |r| is at most
a half of the torque limit, as for a load in the safe torque.

*Bias.*  In the first `_SETTLING` / L, r is zero.  What is seen then is subtracted; it fades
within 10 / L if the prior explains it.  A joint whose sensor shows more than `_SIGMAS`
deviations keeps it: it has an offset, or the arm holds something.  It is also kept if the
law continues with a d^3 of its own, which may have that already.

*Threshold.*  What is learned describes the torque of the motors, with all their friction:
r would take back what of it helps the motors alone.  So once a window is learned, only what
exceeds `_THRESHOLD` s is added, s being the rms of r about its mean: at first that of the
unmodelled torque, then measured over the length of a window while nothing touches the
arm.  What r has added below that before is handed to d^3, and so is a load that is not learned, as
at rest, in the seconds in which it becomes the usual r.
"""

from math import isfinite, sqrt
from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, Cell
from blf_dsc_controller.law.clipping import clip
from blf_dsc_controller.law.lag import filter_gain
from blf_dsc_controller.numerics.algebra import cholesky_factor, whiten

_SETTLING = 4.0  # 1/L, until r is that of the arm
_RELEASED = 10.0  # 1/L, in which a plausible bias fades
_SIGMAS = 3.0  # of what the prior explains
_THRESHOLD = 2.0  # s: a sinusoid does not reach it
_FIRST = 0.1  # of a window, for which the unmodelled torque counts as s
_CLIPPED = 2.0  # s, beyond which r says nothing about its mean and its rms
_LEAST = 0.1  # of the unmodelled torque, likewise
_MOST = 0.5  # of the torque limit


def most_load(limit: Array) -> Array:
    """Return the largest |r| (n,) [N m] with a torque limit (n,) [N m]."""
    return _MOST * limit


class Settings(NamedTuple):
    """The parameter `disturbance.observer_bandwidth`, and what it rests on."""

    enabled: int  # 1: there are joint torque sensors, which are used
    observer_bandwidth: float  # L, rad/s
    sensor_lag: float  # of velocities, which the torque waits for, s
    samples: int  # in a window of the learning
    most: Annotated[Array, 'n']  # largest |r|, N m; zero: the observer is off
    unmodelled: Annotated[Array, 'n']  # rms torque that no column describes, N m
    # what the assumed rotors add to P^, kg m^2
    rotors: Annotated[Array, 'p * observer.enabled']


class State(NamedTuple):
    """What it keeps from one sample to the next."""

    torque: Annotated[Array, 'n * observer.enabled']  # r, N m
    late: Annotated[Array, 'n * observer.enabled']  # tau_J behind the lag, N m
    filtered: Annotated[Array, 'n * observer.enabled', 'p + 1']  # [X_L | tau_J,L]
    bias: Annotated[Array, 'n * observer.enabled']  # N m
    # 1: it stays
    keeps_bias: Annotated[Array, 'n * observer.enabled']
    square: Annotated[Array, 'n * observer.enabled']  # s^2, (N m)^2
    faded: Cell  # share of r that is left out, as the sensors are in doubt
    elapsed: Cell  # s, since the first interval
    measured: Cell  # samples of s^2


class Work(NamedTuple):
    """Scratch of one sample."""

    factor: Annotated[Array, 'm * observer.enabled', 'm']  # of R
    row: Annotated[Array, 'm * observer.enabled']


@inner
def has_settled(settings: Settings, state: State) -> bool:
    """Whether the filters have settled, so that r is that of the arm."""
    return bool(state.elapsed[0] * settings.observer_bandwidth >= _SETTLING)


@inner
def is_missing(effort: Array) -> bool:
    """Whether a reading (n,) is missing, NaN: then r stays, and is zero before the first."""
    missing = False
    for i in range(effort.size):
        missing = missing or not isfinite(effort[i])
    return missing


@inner
def filter_interval(
    settings: Settings, state: State, i: int, row: Array, effort: float, dt: float
) -> None:
    """Pass X of `row` and the sensed `effort` [N m] of joint i in an interval through L."""
    passes = state.elapsed[0] == 0.0 or settings.sensor_lag == 0.0
    share = 1.0 if passes else filter_gain(settings.sensor_lag, dt)
    state.late[i] += share * (effort - state.late[i])
    gain = filter_gain(1.0 / settings.observer_bandwidth, dt)
    filtered = state.filtered[i]
    p = filtered.size - 1
    for j in range(p):
        filtered[j] += gain * (row[j] - filtered[j])
    filtered[p] += gain * (state.late[i] - filtered[p])


@inner
def residual(settings: Settings, state: State, i: int, estimate: Array) -> float:
    """Return tau_J,L - X_L P_l of joint i [N m] for an `estimate` theta (m,)."""
    filtered = state.filtered[i]
    p = filtered.size - 1
    r = filtered[p]
    for j in range(p):
        r -= filtered[j] * (estimate[j] - settings.rotors[j])
    return float(r)


@inner
def load_torque(settings: Settings, state: State, i: int, estimate: Array) -> float:
    """Return r of joint i [N m] for an `estimate` theta (m,)."""
    if not has_settled(settings, state):
        return 0.0
    return excess(settings, state, i, residual(settings, state, i, estimate))


@inner
def excess(settings: Settings, state: State, i: int, seen: float) -> float:
    """Return r of joint i [N m] for a `seen` residual [N m]: what its threshold leaves of it."""
    r = seen - state.bias[i]
    usual = _THRESHOLD * sqrt(state.square[i])
    most = settings.most[i]
    share = 1.0 - state.faded[0]
    return float(share * clip(r - clip(r, -usual, usual), -most, most))


@inner
def update(
    settings: Settings,
    state: State,
    work: Work,
    estimate: Array,
    information: Array,
    disturbance: Array,
    is_learned: bool,
    dt: float,
) -> None:
    """Compute r after an interval of `dt` [s], and its bias once the filters have settled.

    The `information` (m, m) is the inverse covariance of the prior of theta, which
    `is_learned` by now, while nothing touches the arm, or not.  d^3, the `disturbance` (n,)
    [N m], takes what bias and threshold then keep out of r.
    """
    settling = _SETTLING / settings.observer_bandwidth
    before = state.elapsed[0]
    state.elapsed[0] = before + dt
    if before < settling <= state.elapsed[0]:
        find_bias(settings, state, work, estimate, information)
    if is_learned:
        if state.measured[0] == 0.0:
            begin_threshold(settings, state, estimate, disturbance)
        measure(settings, state, estimate, disturbance)
    elif state.measured[0] == 0.0:
        release_bias(settings, state, dt)
    for i in range(state.torque.size):
        state.torque[i] = load_torque(settings, state, i, estimate)


@inner
def release_bias(settings: Settings, state: State, dt: float) -> None:
    """Let the bias fade where it is not kept."""
    share = filter_gain(_RELEASED / settings.observer_bandwidth, dt)
    for i in range(state.bias.size):
        if state.keeps_bias[i] == 0.0:
            state.bias[i] -= share * state.bias[i]


@inner
def begin_threshold(
    settings: Settings, state: State, estimate: Array, disturbance: Array
) -> None:
    """Begin with the unmodelled torque as s; d^3 takes what r loses."""
    for i in range(state.square.size):
        disturbance[i] += load_torque(settings, state, i, estimate)
        state.square[i] = settings.unmodelled[i] * settings.unmodelled[i]
        disturbance[i] -= load_torque(settings, state, i, estimate)


@inner
def measure(
    settings: Settings, state: State, estimate: Array, disturbance: Array
) -> None:
    """Update the mean of r, which is the bias, and its mean square about that.

    d^3, the `disturbance` (n,) [N m], takes what r loses.
    """
    state.measured[0] += 1.0
    first = _FIRST * settings.samples + state.measured[0]
    share = max(1.0 / settings.samples, 1.0 / first)
    for i in range(state.bias.size):
        seen = residual(settings, state, i, estimate)
        before = excess(settings, state, i, seen)
        r = seen - state.bias[i]
        least = _LEAST * settings.unmodelled[i]
        most = _CLIPPED * max(least, sqrt(state.square[i]))
        r = clip(r, -most, most)
        state.bias[i] += share * r
        state.square[i] += share * (r * r - state.square[i])
        if has_settled(settings, state):
            disturbance[i] += before - excess(settings, state, i, seen)


@inner
def find_bias(
    settings: Settings,
    state: State,
    work: Work,
    estimate: Array,
    information: Array,
) -> None:
    """Subtract what the sensors show at the start; keep it where the prior does not explain it."""
    m = information.shape[0]
    for j in range(m):
        for k in range(j, m):
            work.factor[j, k] = information[j, k]
    cholesky_factor(work.factor)
    for i in range(state.bias.size):
        state.bias[i] = residual(settings, state, i, estimate)
        p = state.filtered.shape[1] - 1
        for j in range(m):
            work.row[j] = state.filtered[i, j] if j < p else 0.0
        rest = settings.unmodelled[i]
        variance = whiten(work.factor, work.row) + rest * rest
        if abs(state.bias[i]) > _SIGMAS * sqrt(variance):
            state.keeps_bias[i] = 1.0


@inner
def begin(state: State, disturbance: Array) -> None:
    """Begin with d^3 (n,) [N m]: if it is not zero, it may have what the sensors show."""
    continues = 0.0
    for i in range(disturbance.size):
        if disturbance[i] != 0.0:
            continues = 1.0
    for i in range(state.keeps_bias.size):
        state.keeps_bias[i] = continues


@inner
def hand_over(
    settings: Settings, state: State, disturbance: Array, theta: Array, before: Array
) -> None:
    """Add to d^3, the `disturbance` (n,) [N m], what r has given up to theta since `before`."""
    for i in range(state.torque.size):
        disturbance[i] += load_torque(settings, state, i, before)
        disturbance[i] -= load_torque(settings, state, i, theta)
