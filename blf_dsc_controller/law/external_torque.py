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
acceleration, another force does not.  Nor is a load lighter than nothing: an arm that is known to
hold no more than what z takes away presses on something.  A contact ends when r has stayed below
half of h, or when a load has explained it for `_EXPLAINED`.  None is found before half a second
after the first window.

Everything here but the filter runs after the torque has been sent.
"""

from math import sqrt

from blf_dsc_controller.arms.model import ArmModel
from blf_dsc_controller.compiled.jit import inner, kernel
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.law import barrier, friction
from blf_dsc_controller.law.state import (
    Sample,
    Settings,
    Signals,
    State,
    sample_of,
    settings_of,
    signals_of,
    state_of,
)
from blf_dsc_controller.law.torque import clip
from blf_dsc_controller.law.weighing import DEVIATION, MASS, TWO_SIDED, is_first
from blf_dsc_controller.numerics.algebra import cholesky_factor, whiten

_LASTING = 0.2  # s, correlation length of r, as far as a load is concerned
_FORGETTING = 1.0  # s, in which the filtered load returns to what is not known of it
_FIRST = 0.5  # s since the first window, in which theta^ settles and s^2 is measured
_CALM = 0.2  # s below half of the threshold, after which a contact is over
_EXPLAINED = 0.5  # s, likewise for a load that explains it
_SETTLED = 6.0  # time constants of the row filters, until learning goes on
_REVERSING = 1.5  # `learning.coulomb_velocity`, below which a joint is about to reverse
_AFTER = 3.0  # 1/L, for which it still counts as reversing
_LEAST_NOISE = 0.01  # of the mean square of `residual_floor`
_ASSUMED = 0.01  # of a window, for which `residual_floor` counts
_MOST_NOISE = 4.0  # times the mean square: what more is in r counts as that
_LIGHTER = 3.0  # standard deviations below nothing that no load is

CONTACT, DISTANCE = 0, 1  # in `sample.contact`


@inner
def filter_interval(
    settings: Settings, state: State, signals: Signals, i: int, dt: float
) -> None:
    """Pass [X | u] of joint i, before its other filters in `signals.row`, through the pole L.

    What friction at breakaway adds to Coulomb friction is on the side of u.
    """
    if settings.senses == 0:
        return
    gain = barrier.filter_gain(1.0 / settings.contact_pole, dt)
    felt = state.felt[i]
    row = signals.row[i]
    for j in range(settings.m + 1):
        felt[j] += gain * (row[j] - felt[j])
    if settings.coulomb == 1:
        j = friction.first_coulomb(settings) + i
        extra = state.estimate[j] * state.breakaway[i] * state.shape_lags[1, 0, i]
        felt[settings.m] -= gain * extra


@inner
def know(settings: Settings, state: State) -> None:
    """Keep the factor of the latched window, if it is full and new; before the first, that of R."""
    m = settings.m
    begins = state.samples[0] <= 1.0
    is_full = state.rows[0] == settings.window and state.latched[0] == 1.0
    if not begins and not (is_full and state.latch_time[0] != state.felt_latch[0]):
        return
    for i in range(m):
        for j in range(i, m):
            known = settings.information[i, j] if begins else state.factor[i, j]
            state.felt_factor[i, j] = known
    if begins:
        cholesky_factor(state.felt_factor)
        state.felt_variance[0] = 1.0
        for i in range(settings.n):
            floor = friction.unmodelled(settings, i)
            for k in range(2):
                state.felt_noise[k, i] = floor * floor
        return
    state.felt_latch[0] = state.latch_time[0]
    excess = max(1.0, state.residual[0] / settings.residual_floor)
    state.felt_variance[0] = settings.row_variance * excess


@inner
def find_spread(settings: Settings, state: State, signals: Signals) -> None:
    """Write the covariance of r by theta to `state.felt_doubt` (n, n), and the factor of S."""
    m = settings.m
    n = settings.n
    U = state.felt_factor
    for i in range(n):
        y = signals.felt_rows[i]
        for k in range(m):
            y[k] = state.felt[i, k]
        whiten(U, y)
    for i in range(n):
        for other in range(i, n):
            total = 0.0
            for k in range(m):
                total += signals.felt_rows[i, k] * signals.felt_rows[other, k]
            state.felt_doubt[i, other] = state.felt_variance[0] * total
            state.felt_spread[i, other] = state.felt_doubt[i, other]
        state.felt_spread[i, i] += state.felt_noise[regime(state, i), i]
    cholesky_factor(state.felt_spread)


@inner
def regime(state: State, i: int) -> int:
    """Return 1 for a joint that reverses, else 0: the row of its noise."""
    return 1 if state.felt_reversing[i] > 0.0 else 0


@inner
def absorb(
    columns: Array, e: Array, noise: float, z: Array, doubt: Array, work: Array
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
                work[a] += doubt[a, b] * columns[i, b]
            variance += columns[i, a] * work[a]
        square += innovation * innovation / variance
        for a in range(size):
            z[a] += work[a] * innovation / variance
            for b in range(size):
                doubt[a, b] -= work[a] * work[b] / variance
    return square


@inner
def forget_load(state: State) -> None:
    """Return to a load of which only the prior is known."""
    for a in range(state.felt_load.size):
        state.felt_load[a] = 0.0
        for b in range(state.felt_load.size):
            state.felt_load_doubt[a, b] = 1.0 if a == b else 0.0


@inner
def distance_from_load(
    settings: Settings, state: State, signals: Signals, dt: float
) -> float:
    """Return how far r is from what any load in the tip explains; filter the load from it.

    `signals.felt_white` is r, whitened.
    """
    n = settings.n
    columns = signals.felt_columns
    for a in range(columns.shape[1]):
        for i in range(n):
            columns[i, a] = 0.0
            for j in range(settings.m):
                # the load is missing in X theta^ = u + r
                columns[i, a] -= state.felt[i, j] * settings.load_columns[j, a]
        for k in range(n):
            columns[k, a] *= state.felt_spread[k, k]
            for i in range(k + 1, n):
                columns[i, a] -= state.felt_spread[k, i] * columns[k, a]
    size = state.felt_load.size
    fade = min(1.0, dt / _FORGETTING)
    for a in range(size):
        state.felt_load[a] -= fade * state.felt_load[a]
        signals.felt_trial[a] = state.felt_load[a]
        for b in range(size):
            prior = 1.0 if a == b else 0.0
            state.felt_load_doubt[a, b] += fade * (prior - state.felt_load_doubt[a, b])
            signals.felt_trial_doubt[a, b] = state.felt_load_doubt[a, b]
    e = signals.felt_white
    work = signals.felt_work
    square = absorb(columns, e, 1.0, signals.felt_trial, signals.felt_trial_doubt, work)
    absorb(columns, e, _LASTING / dt, state.felt_load, state.felt_load_doubt, work)
    return sqrt(square)


@inner
def is_lighter_than_nothing(settings: Settings, state: State) -> bool:
    """Whether the filtered load takes away more than is held, as far as that is known."""
    held = state.load[MASS]
    deviation = state.load[DEVIATION]
    if deviation == 0.0 and not is_first(state):
        return False
    mass = 0.0
    square = deviation * deviation
    for a in range(state.felt_load.size):
        mass += settings.load_scale[0, a] * state.felt_load[a]
        for b in range(state.felt_load.size):
            square += (
                settings.load_scale[0, a]
                * settings.load_scale[0, b]
                * state.felt_load_doubt[a, b]
            )
    return bool(held + mass < -_LIGHTER * sqrt(square))


@inner
def remaining_distance(
    settings: Settings, state: State, signals: Signals, dt: float, distance: float
) -> float:
    """Return the distance of r from the arm with a load, or its `distance` without one."""
    if settings.expects_loads == 0:
        return distance
    explained = distance_from_load(settings, state, signals, dt)
    if is_lighter_than_nothing(settings, state):
        return distance
    return explained


@inner
def judge(
    settings: Settings, state: State, signals: Signals, dt: float, distance: float
) -> float:
    """Update whether something touches the arm; return the distance that counts."""
    threshold = settings.contact_threshold
    if distance <= (0.5 if state.contact[0] == 1.0 else 1.0) * threshold:
        state.contact_explained[0] = 0.0
        state.contact_calm[0] += dt
        if state.contact[0] == 0.0 or state.contact_calm[0] >= _CALM:
            state.contact[0] = 0.0
            forget_load(state)
        return distance
    state.contact_calm[0] = 0.0
    remaining = remaining_distance(settings, state, signals, dt, distance)
    if remaining > threshold:
        state.contact[0] = 1.0
        state.contact_explained[0] = 0.0
        forget_load(state)
        return remaining
    if state.contact[0] == 1.0:
        state.contact_explained[0] += dt
        if state.contact_explained[0] >= _EXPLAINED:
            state.contact[0] = 0.0
    return remaining


@inner
def measure_noise(settings: Settings, state: State) -> None:
    """Update the mean square of r that theta leaves, over a window, while nothing touches.

    At first it is the mean since the first window, with `residual_floor` as a small
    part of it.
    """
    least = 1.0 / (settings.window * settings.row_interval)
    for i in range(settings.n):
        k = regime(state, i)
        noise = state.felt_noise[k]
        state.felt_count[k, i] += 1.0
        first = _ASSUMED * settings.window * settings.row_interval
        share = max(least, 1.0 / (first + state.felt_count[k, i]))
        floor = friction.unmodelled(settings, i)
        left = state.external[i] * state.external[i] - state.felt_doubt[i, i]
        noise[i] += share * (clip(left, 0.0, _MOST_NOISE * noise[i]) - noise[i])
        noise[i] = max(noise[i], _LEAST_NOISE * floor * floor)


@inner
def feel(
    settings: Settings, state: State, signals: Signals, dt: float, sample: Sample
) -> bool:
    """Find r of the last sample, its interval, and whether something touches the arm.

    Returns whether a contact begins.
    """
    if settings.senses == 0:
        return False
    n = settings.n
    know(settings, state)
    reversing = _AFTER / settings.contact_pole
    for i in range(n):
        r = -state.felt[i, settings.m]
        for j in range(settings.m):
            r += state.felt[i, j] * state.estimate[j]
        state.external[i] = r
        signals.felt_white[i] = r
        is_slow = abs(signals.dqr[i]) < _REVERSING * settings.coulomb_velocity
        left = state.felt_reversing[i] - dt
        state.felt_reversing[i] = reversing if is_slow else max(0.0, left)
    samples = int(state.samples[0])
    interval = settings.row_interval
    if samples <= 1 or samples % interval == interval // 4:
        find_spread(settings, state, signals)
    was = state.contact[0]
    distance = sqrt(whiten(state.felt_spread, signals.felt_white))
    is_known = state.felt_latch[0] > 0.0
    if is_known:
        seen = state.felt_count[0, 0] + state.felt_count[1, 0]
        if seen * dt >= _FIRST:
            distance = judge(settings, state, signals, dt, distance)
        if state.contact[0] == 0.0:
            measure_noise(settings, state)
    if settings.freezes == 1 and state.contact[0] == 1.0:
        state.frozen[0] = _SETTLED / settings.pole
    for i in range(n):
        variance = state.felt_doubt[i, i] + state.felt_noise[regime(state, i), i]
        sample.external[i] = state.external[i]
        sample.external_interval[i] = TWO_SIDED * sqrt(variance)
    sample.contact[CONTACT] = state.contact[0]
    sample.contact[DISTANCE] = distance
    return bool(state.contact[0] > was)


@kernel
def sense(
    model: ArmModel,
    settings_vector: Array,
    state_vector: Array,
    signals_vector: Array,
    sample_vector: Array,
    dt: float,
) -> bool:
    """Run `feel` on packed vectors: of the last sample, `dt` [s] long."""
    settings = settings_of(settings_vector, model)
    return feel(
        settings,
        state_of(state_vector, settings),
        signals_of(signals_vector, settings),
        dt,
        sample_of(sample_vector, settings),
    )
