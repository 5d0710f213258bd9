# SPDX-License-Identifier: Apache-2.0
"""Torque from outside that the learned model does not explain, its interval, and a contact.

The row X theta = u + tau_ext of each interval (see `prediction`), whole, passes through
a pole L:

    r = X_L theta^ - u_L,        tau_ext passed through the pole

which is a momentum observer, with what has been learned in place of the URDF.  It is
linear in theta, so what the last full window knows of theta, and how well, gives the
covariance of r,

    S = a X_L (Phi_e + rho R)^-1 X_L^T + diag(s^2)

with the variance a of rows that count (before the first window: the prior's), and the
mean square s^2 of r that theta leaves, measured while nothing touches: noise of the
sensors, ripple, friction that its columns do not describe.  A joint that is about to
reverse has an s^2 of its own.

*A contact* is r with r^T S^-1 r > h^2, unless a load explains it.  A load in the tip with phi = D z
adds X_L N D z (see `weighing`).  Once r is past h, z ~ (0, 1) is filtered from r, and only what is
past h of S + X_L N D Cov(z) (X_L N D)^T is a contact: a load follows the arm in every posture and
acceleration, another force does not.  A load cannot have negative mass: an arm that is known to
hold no more than what z takes away presses on something.  A contact ends when r has stayed below
half of h, or when a load has explained it for `_EXPLAINED`.  None is found before half a second
after the first window.

`perception` calls these functions after the torque has been sent, except for the filter.
"""

from math import sqrt
from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, Cell
from blf_dsc_controller.law.clipping import clip
from blf_dsc_controller.law.lag import filter_gain
from blf_dsc_controller.numerics.algebra import cholesky_factor, whiten

_LASTING = 0.2  # s, correlation time of r in the load filter
_FORGETTING = 1.0  # s, in which the filtered load returns to its prior
_FIRST = 0.5  # s since the first window, in which theta^ settles and s^2 is measured
_CALM = 0.2  # s below half of the threshold, after which a contact is over
_EXPLAINED = 0.5  # s, likewise for a load that explains it
_REVERSING = 1.5  # `learning.coulomb_velocity`, below which a joint is about to reverse
_AFTER = 3.0  # 1/L, for which it still counts as reversing
_LEAST_NOISE = 0.01  # of the mean square of the unmodelled torque
_ASSUMED = 0.01  # of a window, for which the unmodelled torque counts
_MOST_NOISE = 4.0  # times the mean square: r^2 is clipped at this multiple
_LIGHTER = 3.0  # standard deviations below zero, from which a mass is negative

QUIET, EXPLAINED, TOUCHED = range(3)
"""Phases: r is small; it is large, but a load explains it; something touches the arm."""

_STEADY, _REVERSAL = range(2)  # rows of `State.noise` and `State.samples`


class Settings(NamedTuple):
    """The parameters `contact.*`, and what they rest on."""

    enabled: int  # 1: the external torque is found
    bandwidth: float  # L, rad/s
    threshold: float  # h
    loads: int  # 1: what a load in the tip explains is no contact
    freezes: int  # 1: nothing is learned while something touches the arm
    window: int  # N, rows in a window of the learning
    row_interval: int  # samples between two of them
    coulomb_velocity: float  # rad/s
    row_variance: float  # of rows that count, where residuals are at their floor
    unmodelled: Annotated[Array, 'n']  # rms torque that no column describes, N m


class State(NamedTuple):
    """What it keeps from one sample to the next."""

    filtered: Annotated[Array, 'n * contact.enabled', 'm + 1']  # [X_L | u_L]
    latch_time: Cell  # s, when the window of `factor` was latched; 0: it is the prior's
    factor: Annotated[Array, 'm * contact.enabled', 'm']  # of Phi_e + rho R, or of R
    variance: Cell  # a: that times its inverse is the covariance of theta
    # of r by theta, (N m)^2
    covariance: Annotated[Array, 'n * contact.enabled', 'n']
    spread: Annotated[Array, 'n * contact.enabled', 'n']  # factor of S
    # s^2, in motion and at reversals, (N m)^2
    noise: Annotated[Array, '2 * contact.enabled', 'n']
    samples: Annotated[Array, '2 * contact.enabled', 'n']  # samples of that
    # s, for which a joint still counts as reversing
    reversing: Annotated[Array, 'n * contact.enabled']
    load: Annotated[Array, '10 * contact.enabled']  # z, filtered from r
    load_covariance: Annotated[Array, '10 * contact.enabled', 10]
    torque: Annotated[Array, 'n * contact.enabled']  # r, N m
    phase: Cell  # QUIET, EXPLAINED or TOUCHED
    calm: Cell  # s, since r has been small
    explained: Cell  # s, since a load has explained a contact


class Work(NamedTuple):
    """Scratch of one sample."""

    rows: Annotated[Array, 'n * contact.enabled', 'm']  # X_L, whitened
    white: Annotated[Array, 'n * contact.enabled']  # r, whitened
    columns: Annotated[Array, 'n * contact.enabled', 10]  # X_L N D, whitened
    load: Annotated[Array, '10 * contact.enabled']  # z by this sample alone
    load_covariance: Annotated[Array, '10 * contact.enabled', 10]
    gain: Annotated[Array, '10 * contact.enabled']


class TipLoad(NamedTuple):
    """How a load in the tip acts, and what is known to be held."""

    columns: Array  # N D of `weighing`, (m + 1, 10)
    scale: Array  # rows of D: mass [kg] and moments [kg m], (4, 10)
    mass: float  # kg
    deviation: float  # of the mass, kg; infinite where it is unknown


@inner
def filter_interval(
    settings: Settings, state: State, i: int, row: Array, friction: float, dt: float
) -> None:
    """Pass [X | u] (m + 1,) of joint i in the last interval through the pole L.

    `friction` [N m] is that which no column of X describes: it is on the side of u.
    """
    gain = filter_gain(1.0 / settings.bandwidth, dt)
    filtered = state.filtered[i]
    for j in range(row.size):
        filtered[j] += gain * (row[j] - filtered[j])
    filtered[row.size - 1] -= gain * friction


@inner
def begin(settings: Settings, state: State, information: Array) -> None:
    """Begin with the prior of theta, whose inverse covariance is R (m, m)."""
    copy_upper(information, state.factor)
    cholesky_factor(state.factor)
    state.variance[0] = 1.0
    for i in range(settings.unmodelled.size):
        for k in range(2):
            state.noise[k, i] = settings.unmodelled[i] * settings.unmodelled[i]


@inner
def update_covariance(
    state: State, factor: Array, variance: float, latch_time: float
) -> None:
    """Take the covariance of theta from a window latched at `latch_time` [s].

    It is the `variance` of rows that count, times the inverse of the matrix of which
    `factor` (m, m) is.
    """
    copy_upper(factor, state.factor)
    state.variance[0] = variance
    state.latch_time[0] = latch_time


@inner
def copy_upper(source: Array, target: Array) -> None:
    """Copy the upper triangle of a matrix."""
    for i in range(source.shape[0]):
        for j in range(i, source.shape[0]):
            target[i, j] = source[i, j]


@inner
def update_torque(state: State, estimate: Array) -> None:
    """Compute r = X_L theta^ - u_L."""
    m = estimate.size
    for i in range(state.torque.size):
        r = -state.filtered[i, m]
        for j in range(m):
            r += state.filtered[i, j] * estimate[j]
        state.torque[i] = r


@inner
def follow_reversals(settings: Settings, state: State, dqr: Array, dt: float) -> None:
    """Note which joints are about to reverse, by the velocity dqr (n,) of the reference."""
    lasts = _AFTER / settings.bandwidth
    for i in range(dqr.size):
        is_slow = abs(dqr[i]) < _REVERSING * settings.coulomb_velocity
        left = state.reversing[i] - dt
        state.reversing[i] = lasts if is_slow else max(0.0, left)


@inner
def regime(state: State, i: int) -> int:
    """Return the row of the noise of joint i, which depends on whether it reverses."""
    return _REVERSAL if state.reversing[i] > 0.0 else _STEADY


@inner
def variance_of(state: State, i: int) -> float:
    """Return the variance of r of joint i [(N m)^2]."""
    return float(state.covariance[i, i] + state.noise[regime(state, i), i])


@inner
def update_spread(state: State, work: Work) -> None:
    """Compute the covariance of r by theta, and the factor of S."""
    n, m = work.rows.shape
    for i in range(n):
        for k in range(m):
            work.rows[i, k] = state.filtered[i, k]
        whiten(state.factor, work.rows[i])
    for i in range(n):
        for other in range(i, n):
            total = 0.0
            for k in range(m):
                total += work.rows[i, k] * work.rows[other, k]
            state.covariance[i, other] = state.variance[0] * total
            state.spread[i, other] = state.covariance[i, other]
        state.spread[i, i] += state.noise[regime(state, i), i]
    cholesky_factor(state.spread)


@inner
def whiten_torque(state: State, work: Work) -> float:
    """Whiten r by the factor of S; return its length, the distance of r from zero."""
    for i in range(state.torque.size):
        work.white[i] = state.torque[i]
    return sqrt(whiten(state.spread, work.white))


@inner
def is_settled(state: State, dt: float) -> bool:
    """Whether theta^ has settled since the first window, and s^2 is measured."""
    seen = state.samples[_STEADY, 0] + state.samples[_REVERSAL, 0]
    return bool(state.latch_time[0] > 0.0 and seen * dt >= _FIRST)


@inner
def is_touched(state: State) -> bool:
    """Whether something touches the arm."""
    return bool(state.phase[0] == TOUCHED)


@inner
def absorb(
    columns: Array, e: Array, noise: float, z: Array, covariance: Array, work: Array
) -> float:
    """Update z and its covariance by e = columns z + white noise of variance `noise`.

    Returns the sum of the squared innovations, each over its variance.
    """
    size = z.size
    square = 0.0
    for i in range(e.size):
        innovation = e[i]
        variance = noise
        for a in range(size):
            innovation -= columns[i, a] * z[a]
            work[a] = 0.0
            for b in range(size):
                work[a] += covariance[a, b] * columns[i, b]
            variance += columns[i, a] * work[a]
        square += innovation * innovation / variance
        for a in range(size):
            z[a] += work[a] * innovation / variance
            for b in range(size):
                covariance[a, b] -= work[a] * work[b] / variance
    return square


@inner
def forget_load(state: State) -> None:
    """Return to the prior of the load."""
    for a in range(state.load.size):
        state.load[a] = 0.0
        for b in range(state.load.size):
            state.load_covariance[a, b] = 1.0 if a == b else 0.0


@inner
def fill_load_columns(state: State, work: Work, load_columns: Array) -> None:
    """Compute -X_L N D, whitened: the load is missing in X theta^ = u + r."""
    n, m = work.rows.shape
    columns = work.columns
    for a in range(columns.shape[1]):
        for i in range(n):
            columns[i, a] = 0.0
            for j in range(m):
                columns[i, a] -= state.filtered[i, j] * load_columns[j, a]
        for k in range(n):
            columns[k, a] *= state.spread[k, k]
            for i in range(k + 1, n):
                columns[i, a] -= state.spread[k, i] * columns[k, a]


@inner
def filter_load(state: State, work: Work, dt: float) -> float:
    """Filter the load from r, whitened; return how far r is from what any load explains."""
    size = state.load.size
    fade = min(1.0, dt / _FORGETTING)
    for a in range(size):
        state.load[a] -= fade * state.load[a]
        work.load[a] = state.load[a]
        for b in range(size):
            prior = 1.0 if a == b else 0.0
            state.load_covariance[a, b] += fade * (prior - state.load_covariance[a, b])
            work.load_covariance[a, b] = state.load_covariance[a, b]
    square = absorb(
        work.columns, work.white, 1.0, work.load, work.load_covariance, work.gain
    )
    absorb(
        work.columns,
        work.white,
        _LASTING / dt,
        state.load,
        state.load_covariance,
        work.gain,
    )
    return sqrt(square)


@inner
def is_negative_mass(mass: float, variance: float) -> bool:
    """Whether a mass [kg] is below zero beyond doubt, with its variance [kg^2]."""
    return bool(mass < -_LIGHTER * sqrt(variance))


@inner
def takes_away_too_much(state: State, load: TipLoad) -> bool:
    """Whether the filtered load takes away more mass than is held."""
    mass = load.mass
    variance = load.deviation * load.deviation
    for a in range(state.load.size):
        mass += load.scale[0, a] * state.load[a]
        for b in range(state.load.size):
            scale = load.scale[0, a] * load.scale[0, b]
            variance += scale * state.load_covariance[a, b]
    return is_negative_mass(mass, variance)


@inner
def explain_by_load(
    settings: Settings,
    state: State,
    work: Work,
    load: TipLoad,
    distance: float,
    dt: float,
) -> float:
    """Return the distance of r from what a load explains, or its `distance` without one."""
    if settings.loads == 0:
        return distance
    fill_load_columns(state, work, load.columns)
    remaining = filter_load(state, work, dt)
    return distance if takes_away_too_much(state, load) else remaining


@inner
def is_small(phase: float, distance: float, threshold: float) -> bool:
    """Whether r is too small for a contact, or for one that lasts."""
    return bool(distance <= (0.5 if phase == TOUCHED else 1.0) * threshold)


@inner
def next_phase(
    phase: float,
    distance: float,
    remaining: float,
    calm: float,
    explained: float,
    threshold: float,
) -> int:
    """Return the phase that follows.

    r is at a `distance`, which a load leaves `remaining`.  It has been small for `calm`
    [s]; a load has explained a contact for `explained` [s].
    """
    if is_small(phase, distance, threshold):
        return TOUCHED if phase == TOUCHED and calm < _CALM else QUIET
    if remaining > threshold:
        return TOUCHED
    return TOUCHED if phase == TOUCHED and explained < _EXPLAINED else EXPLAINED


@inner
def update_contact(
    settings: Settings,
    state: State,
    work: Work,
    load: TipLoad,
    distance: float,
    dt: float,
) -> float:
    """Update the phase; return the distance of r from what explains it."""
    phase = state.phase[0]
    remaining = distance
    if is_small(phase, distance, settings.threshold):
        state.calm[0] += dt
        state.explained[0] = 0.0
    else:
        state.calm[0] = 0.0
        remaining = explain_by_load(settings, state, work, load, distance, dt)
        is_explained = phase == TOUCHED and not remaining > settings.threshold
        state.explained[0] = state.explained[0] + dt if is_explained else 0.0
    state.phase[0] = next_phase(
        phase,
        distance,
        remaining,
        state.calm[0],
        state.explained[0],
        settings.threshold,
    )
    if state.phase[0] == QUIET or remaining > settings.threshold:
        forget_load(state)
    return remaining


@inner
def update_noise(settings: Settings, state: State) -> None:
    """Update s^2, over a window, from the first one on while nothing touches the arm.

    At first it is the mean since the first window, with the unmodelled torque as a
    small part of it.
    """
    if state.latch_time[0] == 0.0 or is_touched(state):
        return
    least = 1.0 / (settings.window * settings.row_interval)
    first = _ASSUMED * settings.window * settings.row_interval
    for i in range(state.torque.size):
        k = regime(state, i)
        noise = state.noise[k]
        state.samples[k, i] += 1.0
        share = max(least, 1.0 / (first + state.samples[k, i]))
        floor = settings.unmodelled[i] * settings.unmodelled[i]
        left = state.torque[i] * state.torque[i] - state.covariance[i, i]
        noise[i] += share * (clip(left, 0.0, _MOST_NOISE * noise[i]) - noise[i])
        noise[i] = max(noise[i], _LEAST_NOISE * floor)
