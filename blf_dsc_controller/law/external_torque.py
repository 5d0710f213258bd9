# SPDX-License-Identifier: Apache-2.0
"""Torque from outside that the learned model does not explain, and its interval.

The row X theta = u + tau_ext of each interval (see `prediction`), whole, passes through
a pole L:

    r = X_L theta^ - u_L,        tau_ext passed through the pole

which is a momentum observer, with what has been learned in place of the URDF.  It is
linear in theta, so the covariance of theta by the last full window gives the
covariance of r,

    S = a X_L (Phi_e + rho R)^-1 X_L^T + diag(s^2)

with the variance a of rows that count (before the first window: the prior's), and the
mean square s^2 of r that theta leaves, measured while nothing touches: noise of the
sensors, ripple, friction that its columns do not describe.  A joint that moves slowly, or is
about to reverse, has an s^2 of its own, and so has one that rests.  Both are means over several
windows, since what friction leaves is nearly constant in each slow motion and each rest, and at
least a fraction of the Coulomb friction, which is not estimated better there.

*A tare* keeps the row [X_0 | u_0] of an arm at rest, with S_0 and s_0 of then.  As r_0 = X_0
theta^ - u_0 has the same error of theta as r, it predicts r:

    r - K r_0,    K = C S_0^-1,    S - K C^T,    C = a X_L (Phi_e + rho R)^-1 X_0^T + diag(w s s_0)

take the place of r and S.  w is 1 until the arm moves: until then its friction is that of the
tare.  At the tare, K = 1 and the torque is zero; the further the arm moves from there, the less r
and r_0 have in common, and the less K takes away.  A tare never widens an interval.  It is
forgotten when the arm has changed, and at the next start.

`perception` calls these functions after the torque has been sent, except for the filter.
"""

from math import sqrt
from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, Cell
from blf_dsc_controller.law.clipping import clip
from blf_dsc_controller.law.lag import filter_gain
from blf_dsc_controller.law.sums import copy
from blf_dsc_controller.numerics.algebra import cholesky_factor, whiten

# s since the first window, in which theta^ settles and s^2 is measured
_FIRST_TIME = 0.5
_REVERSING = 1.5  # `learning.coulomb_velocity`, below which a joint is about to reverse
_RESTING = 0.005  # `learning.coulomb_velocity`, below which it rests
# 1/L, for which it still counts as reversing, and does not count as resting
_AFTER = 3.0
_SETTLED = 6.0  # 1/L, of rest before a tare
_MIN_NOISE = 0.01  # of the mean square of the unmodelled torque
_ASSUMED_WINDOWS = (
    0.01,
    0.1,
    0.1,
)  # of a window, for which the unmodelled torque counts
_NOISE_WINDOWS = (1.0, 4.0, 4.0)  # windows, over which the mean square is taken
_MIN_FRICTION = (0.0, 0.15, 0.05)  # of Coulomb friction, which is never known better
_MAX_NOISE = 4.0  # times the mean square: r^2 is clipped at this multiple

_NOISE_STEADY, _NOISE_SLOW, _NOISE_REST = range(
    3
)  # rows of `State.noise` and `State.samples`


class Settings(NamedTuple):
    """The pole of r, and what r rests on."""

    bandwidth: float  # L, rad/s
    window: int  # N, rows in a window of the learning
    row_interval: int  # samples between two of them
    coulomb_velocity: float  # rad/s
    row_variance: float  # of rows that count, where residuals are at their floor
    unmodelled: Annotated[Array, 'n']  # rms torque that no column describes, N m


class State(NamedTuple):
    """What is kept from one sample to the next."""

    filtered: Annotated[Array, 'n * contact.enabled', 'm + 1']  # [X_L | u_L]
    latch_time: Cell  # s, when the window of `factor` was latched; 0: it is the prior's
    factor: Annotated[Array, 'm * contact.enabled', 'm']  # of Phi_e + rho R, or of R
    variance: Cell  # a: that times its inverse is the covariance of theta; 0: it has not begun
    # of r by theta, less what a tare predicts of it, (N m)^2
    covariance: Annotated[Array, 'n * contact.enabled', 'n']
    spread: Annotated[Array, 'n * contact.enabled', 'n']  # factor of S
    # s^2, in motion, in slow motion and at rest, (N m)^2
    noise: Annotated[Array, '3 * contact.enabled', 'n']
    samples: Annotated[Array, '3 * contact.enabled', 'n']  # samples of that
    # s, for which a joint still counts as reversing
    reversing: Annotated[Array, 'n * contact.enabled']
    resting: Cell  # s, for which the arm has rested
    tared: Cell  # 1: a tare is in force
    tare_changes: Cell  # number of changes of the arm before it
    tare: Annotated[Array, 'n * contact.enabled', 'm + 1']  # its row [X_0 | u_0]
    tare_noise: Annotated[Array, 'n * contact.enabled']  # s_0^2, (N m)^2
    at_tare: Cell  # w
    offset: Annotated[Array, 'n * contact.enabled']  # K r_0, N m
    torque: Annotated[Array, 'n * contact.enabled']  # r - K r_0, N m


class Workspace(NamedTuple):
    """Scratch of one sample."""

    rows: Annotated[Array, 'n * contact.enabled', 'm']  # X_L, whitened
    tare_rows: Annotated[Array, 'n * contact.enabled', 'm']  # X_0, whitened
    tare_torque: Annotated[Array, 'n * contact.enabled']  # r_0, whitened by S_0
    tare_spread: Annotated[Array, 'n * contact.enabled', 'n']  # factor of S_0
    shared: Annotated[Array, 'n * contact.enabled', 'n']  # rows of C, whitened by S_0
    coulomb: Annotated[Array, 'n * contact.enabled']  # c^, N m
    white: Annotated[Array, 'n * contact.enabled']  # r, whitened


@inner
def filter_interval(
    settings: Settings, state: State, i: int, row: Array, friction: float, dt: float
) -> None:
    """Pass the row [X | u] (m + 1,) of joint i in the last interval, `dt` [s], through the pole L.

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
    copy(information, state.factor)
    cholesky_factor(state.factor)
    state.variance[0] = 1.0
    forget_tare(state)
    for i in range(settings.unmodelled.size):
        for k in range(3):
            state.noise[k, i] = settings.unmodelled[i] * settings.unmodelled[i]


@inner
def update_covariance(
    state: State, factor: Array, variance: float, latch_time: float
) -> None:
    """Replace the covariance of theta by that of a window latched at `latch_time` [s].

    It is `variance` times the inverse of the matrix with the Cholesky `factor` (m, m).
    """
    copy(factor, state.factor)
    state.variance[0] = variance
    state.latch_time[0] = latch_time


@inner
def update_torque(state: State, estimate: Array) -> None:
    """Compute r - K r_0 (n,) [N m] with theta^, the `estimate` (m,), as `state.torque`."""
    for i in range(state.torque.size):
        state.torque[i] = residual(state.filtered[i], estimate) - state.offset[i]


@inner
def residual(row: Array, estimate: Array) -> float:
    """Return X theta^ - u of a row [X | u] (m + 1,) [N m]."""
    m = estimate.size
    r = -row[m]
    for j in range(m):
        r += row[j] * estimate[j]
    return float(r)


@inner
def follow_reversals(settings: Settings, state: State, dqr: Array, dt: float) -> bool:
    """Update which joints reverse and how long the arm rests; return whether it begins to move.

    dqr (n,) is the velocity of the reference [rad/s], `dt` [s] the sample time.
    """
    duration = _AFTER / settings.bandwidth
    fastest = 0.0
    for i in range(dqr.size):
        speed = abs(dqr[i])
        fastest = max(fastest, speed)
        is_slow = speed < _REVERSING * settings.coulomb_velocity
        remaining = state.reversing[i] - dt
        state.reversing[i] = duration if is_slow else max(0.0, remaining)
    if fastest < _RESTING * settings.coulomb_velocity:
        state.resting[0] += dt
        return False
    begins = state.resting[0] > 0.0
    state.resting[0] = 0.0
    state.at_tare[0] -= filter_gain(1.0 / settings.bandwidth, dt) * state.at_tare[0]
    return bool(begins)


@inner
def regime(settings: Settings, state: State, i: int) -> int:
    """Return the row of `State.noise` of joint i: at rest, slow, or in steady motion."""
    if state.resting[0] * settings.bandwidth > _AFTER:
        return _NOISE_REST
    return _NOISE_SLOW if state.reversing[i] > 0.0 else _NOISE_STEADY


@inner
def min_variance(settings: Settings, workspace: Workspace, k: int, i: int) -> float:
    """Return the smallest variance of r of joint i in a regime k [(N m)^2].

    It has a hundredth of the unmodelled torque's square and, at low speed, a fraction of Coulomb
    friction.
    """
    floor = settings.unmodelled[i]
    friction = _MIN_FRICTION[k] * workspace.coulomb[i]
    return float(_MIN_NOISE * floor * floor + friction * friction)


@inner
def residual_variance(
    settings: Settings, state: State, workspace: Workspace, i: int
) -> float:
    """Return the variance of r - K r_0 of joint i [(N m)^2]."""
    k = regime(settings, state, i)
    minimum = min_variance(settings, workspace, k, i)
    return float(max(minimum, state.covariance[i, i] + state.noise[k, i]))


@inner
def tare(state: State, changes: float) -> None:
    """Take r for zero from now on: the arm rests, and nothing touches it.

    `changes` is how many changes of the arm have been detected so far; the next one ends the tare.
    """
    state.tared[0] = 1.0
    state.tare_changes[0] = changes
    state.at_tare[0] = 1.0
    for i in range(state.torque.size):
        for j in range(state.tare.shape[1]):
            state.tare[i, j] = state.filtered[i, j]
        state.tare_noise[i] = state.noise[_NOISE_REST, i]
        state.offset[i] += state.torque[i]
        state.torque[i] = 0.0


@inner
def forget_tare(state: State) -> None:
    """Go on without a tare."""
    state.tared[0] = 0.0
    for i in range(state.offset.size):
        state.offset[i] = 0.0


@inner
def settling_time(settings: Settings) -> float:
    """Return how long [s] an arm rests before a tare."""
    return _SETTLED / settings.bandwidth


@inner
def update_spread(
    settings: Settings, state: State, workspace: Workspace, estimate: Array
) -> None:
    """Compute the covariance of r - K r_0 by theta, the factor of S, and K r_0.

    `estimate` is theta^ (m,).
    """
    whiten_rows(state, state.filtered, workspace.rows)
    fill_products(state, workspace.rows, workspace.rows, state.covariance)
    if state.tared[0] == 1.0:
        condition_on_tare(settings, state, workspace, estimate)
    n = state.torque.size
    for i in range(n):
        for j in range(i, n):
            state.spread[i, j] = state.covariance[i, j]
        state.spread[i, i] = residual_variance(settings, state, workspace, i)
    cholesky_factor(state.spread)


@inner
def whiten_rows(state: State, source: Array, rows: Array) -> None:
    """Write X of `source` (n, m + 1) to `rows` (n, m), whitened by the covariance of theta."""
    n, m = rows.shape
    for i in range(n):
        for k in range(m):
            rows[i, k] = source[i, k]
        whiten(state.factor, rows[i])


@inner
def fill_products(state: State, rows: Array, others: Array, target: Array) -> None:
    """Compute a X (Phi_e + rho R)^-1 Y^T (n, n) of whitened rows X and Y (n, m) as `target`."""
    n, m = rows.shape
    for i in range(n):
        for j in range(n):
            total = 0.0
            for k in range(m):
                total += rows[i, k] * others[j, k]
            target[i, j] = state.variance[0] * total


@inner
def condition_on_tare(
    settings: Settings, state: State, workspace: Workspace, estimate: Array
) -> None:
    """Subtract from the covariance of r what r_0 predicts; compute K r_0 as `state.offset`.

    `estimate` is theta^ (m,).
    """
    n = state.torque.size
    whiten_rows(state, state.tare, workspace.tare_rows)
    fill_products(
        state, workspace.tare_rows, workspace.tare_rows, workspace.tare_spread
    )
    fill_products(state, workspace.rows, workspace.tare_rows, workspace.shared)
    for i in range(n):
        noise = state.noise[regime(settings, state, i), i]
        tare_noise = state.tare_noise[i]
        workspace.tare_spread[i, i] += tare_noise
        workspace.shared[i, i] += state.at_tare[0] * sqrt(
            tare_noise * min(tare_noise, noise)
        )
        workspace.tare_torque[i] = residual(state.tare[i], estimate)
    cholesky_factor(workspace.tare_spread)
    whiten(workspace.tare_spread, workspace.tare_torque)
    for i in range(n):
        whiten(workspace.tare_spread, workspace.shared[i])
        state.offset[i] = 0.0
        for k in range(n):
            state.offset[i] += workspace.shared[i, k] * workspace.tare_torque[k]
    for i in range(n):
        for j in range(n):
            for k in range(n):
                state.covariance[i, j] -= (
                    workspace.shared[i, k] * workspace.shared[j, k]
                )


@inner
def whiten_torque(state: State, workspace: Workspace) -> float:
    """Whiten r by the factor of S, as `workspace.white`; return its length.

    That is the distance of r from zero, in standard deviations.
    """
    for i in range(state.torque.size):
        workspace.white[i] = state.torque[i]
    return sqrt(whiten(state.spread, workspace.white))


@inner
def is_settled(state: State, dt: float) -> bool:
    """Whether theta^ has settled since the first window, so that s^2 is measured from now on."""
    samples = 0.0
    for k in range(3):
        samples += state.samples[k, 0]
    return bool(samples * dt >= _FIRST_TIME)


@inner
def update_noise(
    settings: Settings, state: State, workspace: Workspace, is_touched: bool
) -> None:
    """Update s^2 (n,) [(N m)^2] after the first window, while nothing touches the arm.

    At first it is the mean since the first window, with the unmodelled torque as a small part of
    it.  At rest after a tare, r contains no information on it.
    """
    if state.latch_time[0] == 0.0 or is_touched:
        return
    window = settings.window * settings.row_interval
    for i in range(state.torque.size):
        k = regime(settings, state, i)
        noise = state.noise[k]
        state.samples[k, i] += 1.0
        if k == _NOISE_REST and state.tared[0] == 1.0:
            continue
        first = _ASSUMED_WINDOWS[k] * window
        min_gain = 1.0 / (_NOISE_WINDOWS[k] * window)
        gain = max(min_gain, 1.0 / (first + state.samples[k, i]))
        unexplained = state.torque[i] * state.torque[i] - state.covariance[i, i]
        noise[i] += gain * (clip(unexplained, 0.0, _MAX_NOISE * noise[i]) - noise[i])
        noise[i] = max(noise[i], min_variance(settings, workspace, k, i))
