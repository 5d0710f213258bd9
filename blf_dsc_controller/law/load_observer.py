# SPDX-License-Identifier: Apache-2.0
"""Load observer: torque on the links beyond the model's, by joint torque sensors.

A sensor behind a gear measures the torque tau_J that reaches the links, whatever motor and
friction do.  With the row X of the last interval (see `prediction`), by the measured
motion, and P_l, the learned parameters less those of the motors,

    r = tau_J,L - X_L P_l - bias,       both passed through the lag of velocities and a pole L

is added to the torque: within some 1 / L it has what d^3 and the learning find in seconds.
It is linear in P^, so that it gives up what is learned at once; d^3 then only has to give
up the rest (`transfer_learned`).  Near the reference it is the feedback

    r = L / (s + L) (M - M_l) s^2 xi1

which vanishes for the right inertia M_l, and is stable for any M > 0 as long as

    |L / (s + L) T (M - M_l) / M| < 1     where its phase is 0,

T being the response of the drives: positive feedback below 1 makes a heavy arm light, and
a pole L below that of the drives leaves no phase for a light one.  |r| is at most
a half of the torque limit, as for a load in the safe torque; beyond that, r takes over what is
learned no longer, until it needs less.

*Bias.*  In the first `_SETTLING_TIMES` / L, r is zero.  What is measured then is subtracted; it
fades within 10 / L if the prior explains it.  A joint whose sensor measures more than
`_PRIOR_SIGMAS` deviations keeps it: it has an offset, or the arm holds something.  It is also
kept if the law continues with a d^3 of its own, which may have that already.

*Lag.*  r passes L, so that after a change of P^ it gives up X_L (P^ - P^_before), and d^3 would
have to give up the rest of H (P^ - P^_before): the torque of a load that has just gone, of an
inertia that accelerates.  That is not of the arm, and fades with L (`hand_over`).

*Friction.*  What is learned describes the torque of the motors, with all their friction.  P_l
is without what P^ has absorbed of that (`motor_friction`), or else r would take it back.
"""

from math import isfinite, sqrt
from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, Cell
from blf_dsc_controller.law.clipping import clip
from blf_dsc_controller.law.lag import filter_gain
from blf_dsc_controller.numerics.algebra import cholesky_factor, whiten

_SETTLING_TIMES = 4.0  # 1/L, until r is that of the arm
_BIAS_RELEASE = 10.0  # 1/L, in which a plausible bias fades
_PRIOR_SIGMAS = 3.0  # of what the prior explains
_MAX_LOAD = 0.5  # of the torque limit
_STEADY_TIME = 0.02  # s: oscillations have 8 Hz or more


def max_load_torque(limit: Array) -> Array:
    """Return the largest |r| (n,) [N m] with a torque limit (n,) [N m]: half of it."""
    return _MAX_LOAD * limit


class Settings(NamedTuple):
    """The parameter `disturbance.observer_bandwidth`, and what it rests on."""

    enabled: int  # 1: there are joint torque sensors, which are used
    observer_bandwidth: float  # L, rad/s
    sensor_lag: float  # of velocities, which the torque waits for, s
    max_torque: Annotated[Array, 'n']  # largest |r|, N m
    unmodelled: Annotated[Array, 'n']  # rms torque that no column describes, N m
    # what the assumed rotors add to P^, kg m^2
    rotors: Annotated[Array, 'p * observer.enabled']


class Links(NamedTuple):
    """What is learned of the links: P_l = P^ - P_r - P_f."""

    estimate: Array  # theta^ = [P^; d^] (m,)
    rotors: Array  # P_r (p,), of the assumed rotors
    absorbed: Array  # P_f (p,), of friction


class State(NamedTuple):
    """What is kept from one sample to the next."""

    torque: Annotated[Array, 'n * observer.enabled']  # r, N m
    # r without what oscillates, which a stop may hold, N m
    steady: Annotated[Array, 'n * observer.enabled']
    lagged: Annotated[Array, 'n * observer.enabled']  # tau_J behind the lag, N m
    filtered: Annotated[Array, 'n * observer.enabled', 'p + 1']  # [X_L | tau_J,L]
    bias: Annotated[Array, 'n * observer.enabled']  # N m
    # 1: it stays
    keeps_bias: Annotated[Array, 'n * observer.enabled']
    faded: Cell  # fraction of r that is left out: see `torque_sensors`
    elapsed: Cell  # s, since the first interval
    # beyond the largest |r|, since what it takes over was learned, N m
    over: Annotated[Array, 'n * observer.enabled']
    # what r has not yet given up of a changed estimate, since it lags; it fades, N m
    handover: Annotated[Array, 'n * observer.enabled']


class Workspace(NamedTuple):
    """Scratch of one sample."""

    factor: Annotated[Array, 'm * observer.enabled', 'm']  # of R
    row: Annotated[Array, 'm * observer.enabled']


@inner
def has_settled(settings: Settings, state: State) -> bool:
    """Whether the filters have settled, so that r is valid: after `_SETTLING_TIMES` / L."""
    return bool(state.elapsed[0] * settings.observer_bandwidth >= _SETTLING_TIMES)


@inner
def is_missing(effort: Array) -> bool:
    """Whether a measured effort (n,) is missing, NaN: then r does not change."""
    missing = False
    for i in range(effort.size):
        missing = missing or not isfinite(effort[i])
    return missing


@inner
def filter_interval(
    settings: Settings, state: State, i: int, row: Array, effort: float, dt: float
) -> None:
    """Pass X of `row` and the sensed `effort` [N m] of joint i in an interval, `dt` [s], through L.

    The effort passes the lag of the velocities first.
    """
    passes = state.elapsed[0] == 0.0 or settings.sensor_lag == 0.0
    gain = 1.0 if passes else filter_gain(settings.sensor_lag, dt)
    state.lagged[i] += gain * (effort - state.lagged[i])
    pole_gain = filter_gain(1.0 / settings.observer_bandwidth, dt)
    filtered = state.filtered[i]
    p = filtered.size - 1
    for j in range(p):
        filtered[j] += pole_gain * (row[j] - filtered[j])
    filtered[p] += pole_gain * (state.lagged[i] - filtered[p])


@inner
def residual(state: State, i: int, links: Links) -> float:
    """Return tau_J,L - X_L P_l of joint i [N m]: the torque on the links beyond the model's."""
    filtered = state.filtered[i]
    p = filtered.size - 1
    r = filtered[p]
    for j in range(p):
        P_l = links.estimate[j] - links.rotors[j] - links.absorbed[j]
        r -= filtered[j] * P_l
    return float(r)


@inner
def load_torque(settings: Settings, state: State, i: int, observed: float) -> float:
    """Return r of joint i [N m], for a torque `observed` beyond the model and the bias [N m].

    It is limited, faded by `torque_sensors`, and zero until the filters have settled.
    """
    if not has_settled(settings, state):
        return 0.0
    max_torque = settings.max_torque[i] + state.over[i]
    return float((1.0 - state.faded[0]) * clip(observed, -max_torque, max_torque))


@inner
def take_over(
    settings: Settings, state: State, i: int, observed: float, observed_before: float
) -> None:
    """Raise the limit of |r| by the torque that is learned no longer.

    `observed` [N m] is the torque beyond the model and the bias, and `observed_before` [N m] the
    same with the estimate of before.
    """
    takes_over = has_settled(settings, state) and state.faded[0] == 0.0
    taken = abs(observed) - abs(observed_before)
    if takes_over and taken > 0.0:
        beyond = abs(observed) - settings.max_torque[i]
        state.over[i] = clip(beyond, 0.0, state.over[i] + taken)


@inner
def update(
    settings: Settings,
    state: State,
    workspace: Workspace,
    links: Links,
    information: Array,
    dt: float,
) -> None:
    """Compute r after an interval of `dt` [s], and its bias once the filters have settled.

    `information` is R (m, m), the inverse covariance of the prior of theta.
    """
    settling = _SETTLING_TIMES / settings.observer_bandwidth
    before = state.elapsed[0]
    state.elapsed[0] = before + dt
    if before < settling <= state.elapsed[0]:
        find_bias(settings, state, workspace, links, information)
    gain = filter_gain(1.0 / settings.observer_bandwidth, dt)
    release_gain = filter_gain(_BIAS_RELEASE / settings.observer_bandwidth, dt)
    steady_gain = filter_gain(_STEADY_TIME, dt)
    for i in range(state.torque.size):
        if state.keeps_bias[i] == 0.0:
            state.bias[i] -= release_gain * state.bias[i]
        state.handover[i] -= gain * state.handover[i]
        observed = residual(state, i, links) - state.bias[i]
        state.over[i] = clip(abs(observed) - settings.max_torque[i], 0.0, state.over[i])
        r = load_torque(settings, state, i, observed)
        state.torque[i] = r + state.handover[i]
        state.steady[i] += steady_gain * (state.torque[i] - state.steady[i])


@inner
def find_bias(
    settings: Settings,
    state: State,
    workspace: Workspace,
    links: Links,
    information: Array,
) -> None:
    """Take r at the start as its bias; keep the bias of joints where the prior does not explain it.

    `information` is R (m, m).
    """
    m = information.shape[0]
    for j in range(m):
        for k in range(j, m):
            workspace.factor[j, k] = information[j, k]
    cholesky_factor(workspace.factor)
    p = state.filtered.shape[1] - 1
    for i in range(state.bias.size):
        state.bias[i] = residual(state, i, links)
        for j in range(m):
            workspace.row[j] = state.filtered[i, j] if j < p else 0.0
        f = settings.unmodelled[i]
        variance = whiten(workspace.factor, workspace.row) + f * f
        if abs(state.bias[i]) > _PRIOR_SIGMAS * sqrt(variance):
            state.keeps_bias[i] = 1.0


@inner
def begin(state: State, disturbance: Array) -> None:
    """Begin with d^3 (n,) [N m]; if it may contain what the sensors measure, the bias is kept."""
    continues = 0.0
    for i in range(disturbance.size):
        if disturbance[i] != 0.0:
            continues = 1.0
    for i in range(state.keeps_bias.size):
        state.keeps_bias[i] = continues


@inner
def transfer_learned(
    settings: Settings,
    state: State,
    disturbance: Array,
    links: Links,
    before: Links,
) -> None:
    """Add to d^3, the `disturbance` (n,) [N m], what r has given up since the links `before`."""
    for i in range(state.torque.size):
        observed_before = residual(state, i, before) - state.bias[i]
        observed = residual(state, i, links) - state.bias[i]
        transferred = load_torque(settings, state, i, observed_before)
        take_over(settings, state, i, observed, observed_before)
        transferred -= load_torque(settings, state, i, observed)
        disturbance[i] += transferred
        state.steady[i] -= transferred


def expect(settings: Settings, state: State, change: Array) -> None:
    """Hold what r gives up by an expected `change` (p,) of P^ until the sensors measure it.

    It fades with L, as r would catch up, whether or not the load comes.
    """
    if state.torque.size and has_settled(settings, state):
        transferred = state.filtered[:, : change.size] @ change
        state.handover[:] += (1.0 - state.faded[0]) * transferred


@inner
def hand_over(
    settings: Settings,
    state: State,
    disturbance: Array,
    H: Array,
    links: Links,
    before: Links,
) -> None:
    """Move from d^3 (n,) [N m] to r what d^3 has given up only because r lags.

    By a change of theta^ since `before`, d^3 has given up (H - X_L) (theta^ - before) too much,
    with H (n, m) at the reference, now.  It is not the arm's and fades as r catches up.
    """
    if not has_settled(settings, state):
        return
    p = state.filtered.shape[1] - 1
    for i in range(state.torque.size):
        lag_error = 0.0
        for j in range(p):
            change = links.estimate[j] - before.estimate[j]
            lag_error += (H[i, j] - state.filtered[i, j]) * change
        lag_error *= 1.0 - state.faded[0]
        disturbance[i] += lag_error
        state.handover[i] -= lag_error
        state.steady[i] -= lag_error
