# SPDX-License-Identifier: Apache-2.0
"""Friction along the reference: its compensation, within what reversals and d^3 allow.

Coulomb friction changes its sign where a joint reverses, faster than d^3 can follow: an
error of the estimate pushes the joint by twice that in each reversal.  In geared joints
it is larger at breakaway (Stribeck).  Its model, at the velocity v that the reference
has when the torque acts, is

    c^ g(v) s(v),    s(v) = tanh(v / v_c),    g(v) = 1 + k^ exp(-(v / v_s)^2)          [N m]

with the shapes of `arms.friction`.

*Learned from reversals.*  What only friction has is the step.  So the rows, and s and g s of the
measured velocity, pass a band around the pole p of the row's filter, x_h = (s / (s + p))^2 x, and
`reversals` finds c^ and k^ from what the other columns leave of the torque.

*Used within the evidence.*  What is learned of friction must not cost more than not knowing it,
an error of |c_0 - c|.  Two things may contradict c^ before the sums do: the friction c_1 of the
last reversal, or c_2 of the one before; and the observer.  If d^3 rises by delta along the motion
since the last reversal, either the friction has risen by that much, which changes sign at the next
reversal, or a push has begun, which stays.  delta is counted until v crosses zero: d^3 takes some
0.05 s to follow, and what it adds while the joint slows down changes sign all the same.  The
compensation at v is the value nearest to c_0

    C(v) = clip(c_0, g(v) min E, g(v) max E),
    E = c^ + {0, z(c_1 - c^), z(c_2 - c^), z(delta), z(delta_min), z(delta_max)}

among all that they allow, with the dead zone z of f and the extremes of delta in
earlier motions since a reversal was last measured.  It lies between c_0 and each of
them, so that whichever is true, the error of C is no larger than that of c_0.  C is handed over to
d^3 like everything that is learned: it changes no torque until the joint reverses.
"""

from typing import Annotated, NamedTuple

from blf_dsc_controller.arms.friction import STRIBECK_SPEED, fading, sliding
from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, Cell
from blf_dsc_controller.law import reversals
from blf_dsc_controller.law.clipping import clip
from blf_dsc_controller.law.lag import filter_gain
from blf_dsc_controller.law.reversals import beyond

_MOVING_SIGN = 0.9  # of |s|: below it a joint reverses


class Settings(NamedTuple):
    """The columns of Coulomb friction in theta, and what is known of it."""

    coulomb: int  # 1: theta has a column of Coulomb friction per joint
    first_coulomb: int  # index of the first such column
    coulomb_velocity: float  # v_c, rad/s
    pole: float  # p of the row filters, rad/s
    reversals: reversals.Settings
    gain: Annotated[Array, 'n']  # Gamma kappa of its columns, 1/s


class State(NamedTuple):
    """What is kept from one sample to the next."""

    since_latch: Cell  # s, for which a window has been latched
    # s and b: now, behind one pole, behind both
    shape_lags: Annotated[Array, 2, 3, 'n']
    column_lags: Annotated[Array, 2, 2, 'n']  # of s_h and b_h
    torque_lags: Annotated[Array, 2, 'n']  # of e_h, N m
    reversals: reversals.State
    # k^, breakaway torque relative to Coulomb friction
    breakaway: Annotated[Array, 'n']
    moves: Annotated[Array, 'n']  # 1 while the joint does not reverse
    direction: Annotated[Array, 'n']  # of its motion since the last reversal, 1 or -1
    # delta, what d^3 has added along the motion since then, N m
    observer_drift: Annotated[Array, 'n']
    # least and largest delta of earlier motions, or 0, since a reversal was last
    # measured, N m
    drift_extremes: Annotated[Array, 2, 'n']


class Workspace(NamedTuple):
    """Values of one sample."""

    sign: Annotated[Array, 'n']  # s(v)
    stribeck: Annotated[Array, 'n']  # exp(-(v / v_s)^2)
    torque: Annotated[Array, 'n']  # C(v) s(v), N m
    breakaway_error: Annotated[Array, 'n']  # k - k^
    unexplained: Annotated[Array, 'n']  # e, N m


@inner
def is_coulomb(settings: Settings, j: int) -> bool:
    """Whether entry j of theta is Coulomb friction, which reversals identify, not the window."""
    at = j - settings.first_coulomb
    return bool(settings.coulomb == 1 and 0 <= at < settings.reversals.initial.size)


@inner
def coulomb_torque(
    settings: Settings, state: State, workspace: Workspace, learned: float, i: int
) -> float:
    """Return the compensation C(v) s(v) of joint i [N m], with c^ `learned` [N m].

    `workspace` has s(v) and exp(-(v / v_s)^2) of the joint.
    """
    low = learned
    high = learned
    if settings.coulomb == 1:
        dead_zone = settings.reversals.unmodelled[i]
        coulomb = state.reversals.evidence.coulomb
        for offset in (
            beyond(coulomb[0, i] - learned, dead_zone),
            beyond(coulomb[1, i] - learned, dead_zone),
            beyond(state.observer_drift[i], dead_zone),
            beyond(state.drift_extremes[0, i], dead_zone),
            beyond(state.drift_extremes[1, i], dead_zone),
        ):
            low = min(low, learned + offset)
            high = max(high, learned + offset)
    scale = 1.0 + state.breakaway[i] * workspace.stribeck[i]
    level = clip(settings.reversals.initial[i], scale * low, scale * high)
    return float(level * workspace.sign[i])


@inner
def compensate(
    settings: Settings,
    state: State,
    workspace: Workspace,
    estimate: Array,
    velocity: float,
    i: int,
) -> None:
    """Compute C(v) s(v) of joint i [N m] as `workspace.torque`, at the `velocity` v [rad/s].

    `estimate` is theta^ (m,).
    """
    if settings.coulomb == 1:
        workspace.sign[i] = sliding(velocity, settings.coulomb_velocity)
        workspace.stribeck[i] = fading(velocity, STRIBECK_SPEED)
        learned = estimate[settings.first_coulomb + i]
        workspace.torque[i] = coulomb_torque(settings, state, workspace, learned, i)


@inner
def transfer_learned(
    settings: Settings,
    state: State,
    workspace: Workspace,
    estimate: Array,
    disturbance: Array,
) -> None:
    """Subtract from d^3 (n,) [N m] the change of the friction compensation in this sample.

    `estimate` is theta^ (m,) after the sample.  The torque thus does not change by learning.
    """
    if settings.coulomb == 0:
        return
    for i in range(disturbance.size):
        learned = estimate[settings.first_coulomb + i]
        torque = coulomb_torque(settings, state, workspace, learned, i)
        disturbance[i] -= torque - workspace.torque[i]
        workspace.torque[i] = torque


@inner
def follow_observer(state: State, workspace: Workspace, i: int, step: float) -> None:
    """Add a step of d^3 of joint i [N m] to delta, until v crosses zero."""
    if workspace.sign[i] * state.direction[i] > 0.0:
        state.observer_drift[i] += step * state.direction[i]


@inner
def follow_motion(settings: Settings, state: State, workspace: Workspace) -> None:
    """Detect joints that begin to reverse, and those that have reversed: delta is zero again.

    The direction is that of s(v) in `workspace`.
    """
    if settings.coulomb == 0:
        return
    drift = state.observer_drift
    extremes = state.drift_extremes
    for i in range(drift.size):
        sign = workspace.sign[i]
        moves = abs(sign) > _MOVING_SIGN
        if moves and sign * state.direction[i] <= 0.0:
            state.direction[i] = 1.0 if sign > 0.0 else -1.0
            extremes[0, i] = min(extremes[0, i], drift[i])
            extremes[1, i] = max(extremes[1, i], drift[i])
            drift[i] = 0.0
        if not moves and state.moves[i] == 1.0:
            reversals.close(settings.reversals, state.reversals, i, state.breakaway[i])
        state.moves[i] = 1.0 if moves else 0.0


@inner
def filter_shapes(settings: Settings, state: State, dq: Array, dt: float) -> None:
    """Pass s and b of the last interval through the two poles of the row.

    dq (n,) [rad/s] is the measured velocity, `dt` [s] the length of the interval.
    """
    if settings.coulomb == 0:
        return
    gain = filter_gain(1.0 / settings.pole, dt)
    lags = state.shape_lags
    for i in range(dq.size):
        s = sliding(dq[i], settings.coulomb_velocity)
        b = s * fading(dq[i], STRIBECK_SPEED)
        for k in range(2):
            shape = s if k == 0 else b
            mean = 0.5 * (shape + lags[k, 0, i])
            lags[k, 0, i] = shape
            lags[k, 1, i] += gain * (mean - lags[k, 1, i])
            lags[k, 2, i] += gain * (lags[k, 1, i] - lags[k, 2, i])


@inner
def breakaway_torque(
    settings: Settings, state: State, estimate: Array, i: int
) -> float:
    """Return c^ k^ b of joint i [N m]: what breakaway adds to its Coulomb friction at present.

    `estimate` is theta^ (m,).
    """
    if settings.coulomb == 0:
        return 0.0
    learned = estimate[settings.first_coulomb + i]
    return float(learned * state.breakaway[i] * state.shape_lags[1, 0, i])


@inner
def high_pass(lags: Array, i: int, gain: float, x: float, begins: bool) -> float:
    """Return (s / (s + p))^2 x of joint i, by its two `lags`, of the filter `gain` per sample.

    It is zero at the first value, which `begins`.
    """
    if begins:
        lags[0, i] = x
        lags[1, i] = 0.0
    for k in range(2):
        lags[k, i] += gain * (x - lags[k, i])
        x -= lags[k, i]
    return x


@inner
def unexplained(row: Array, estimate: Array, excluded: int) -> float:
    """Return e [N m]: u - X theta^ of a `row` [X | u] (m + 1,), without entry `excluded` of theta^.

    `estimate` is theta^ (m,).
    """
    e = row[estimate.size]
    for j in range(estimate.size):
        if j != excluded:
            e -= row[j] * estimate[j]
    return float(e)


@inner
def measure_reversals(
    settings: Settings, state: State, workspace: Workspace, begins: bool, dt: float
) -> None:
    """Add the last row, `dt` [s] after the one before it, to the sums of the present reversal.

    e (n,) [N m] is `workspace.unexplained`, of the row behind both poles, unweighted.  The high
    pass starts again at zero where the rows `begin`.
    """
    gain = filter_gain(1.0 / settings.pole, dt)
    weight = settings.pole * dt
    lags = state.column_lags
    reversals.keep(state.reversals, dt)
    for i in range(workspace.unexplained.size):
        e = workspace.unexplained[i]
        s_h = high_pass(lags[0], i, gain, state.shape_lags[0, 2, i], begins)
        b_h = high_pass(lags[1], i, gain, state.shape_lags[1, 2, i], begins)
        e_h = high_pass(state.torque_lags, i, gain, e, begins)
        if begins:
            continue
        k = state.breakaway[i]
        row = reversals.Row(s_h, b_h, e_h, weight)
        if reversals.add_row(settings.reversals, state.reversals, i, row, k, dt):
            state.drift_extremes[0, i] = 0.0
            state.drift_extremes[1, i] = 0.0


@inner
def return_estimate(
    settings: Settings, state: State, active: Array, estimate: Array
) -> None:
    """Set c^, in theta^ (m,), and k^ to what reversals identify, where they adapt.

    Entries of the `estimate` that are not `active` (m,) stay.
    """
    if settings.coulomb == 0:
        return
    reversal_settings = settings.reversals
    for i in range(reversal_settings.initial.size):
        j = settings.first_coulomb + i
        if active[j] == 1.0 and settings.gain[i] > 0.0:
            coulomb, state.breakaway[i] = reversals.learned(
                reversal_settings, state.reversals, i, state.breakaway[i]
            )
            estimate[j] = clip(
                coulomb, reversal_settings.lower[i], reversal_settings.upper[i]
            )


@inner
def follow_reversals(
    settings: Settings,
    state: State,
    workspace: Workspace,
    active: Array,
    estimate: Array,
    rate: Array,
) -> None:
    """Write c - c^ to the entries of Coulomb friction in `rate` (m,), k - k^ to `workspace`.

    c and k are identified by the reversals.  Entries of theta^ that are not `active` (m,) stay.
    """
    if settings.coulomb == 0:
        return
    reversal_settings = settings.reversals
    for i in range(reversal_settings.initial.size):
        j = settings.first_coulomb + i
        workspace.breakaway_error[i] = 0.0
        if active[j] == 0.0:
            continue
        coulomb, stribeck = reversals.learned(
            reversal_settings, state.reversals, i, state.breakaway[i]
        )
        rate[j] = coulomb - estimate[j]
        workspace.breakaway_error[i] = stribeck - state.breakaway[i]


@inner
def adapt_breakaway(
    settings: Settings, state: State, workspace: Workspace, dt: float
) -> None:
    """Advance k^ by `dt` [s]: k^' = Gamma kappa (k - k^)."""
    if settings.coulomb == 0:
        return
    for i in range(settings.gain.size):
        rate = settings.gain[i] * workspace.breakaway_error[i]
        state.breakaway[i] += dt * rate
