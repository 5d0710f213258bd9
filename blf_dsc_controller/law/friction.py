# SPDX-License-Identifier: Apache-2.0
"""Friction along the reference: what reversals show of it, and how much of that is used.

Coulomb friction changes its sign where a joint reverses, faster than d^3 can follow: an
error of the estimate pushes the joint by twice that in each reversal.  In geared joints
it is larger at breakaway (Stribeck).  Its model, at the velocity v that the reference
has when the torque acts, is

    c^ g(v) s(v),    s(v) = tanh(v / v_c),    g(v) = 1 + k^ exp(-(v / v_s)^2)          [N m]

with the shapes of `arms.friction`.

*Learned from reversals.*  The window cannot be trusted with it: its rows are dominated by the
frequencies of the reference, at which a sin w t against the velocity takes 0.64 a off the estimate
and leaves no residual.  What only friction has is the step.  So the rows, and s and g s of the
measured velocity, pass a band around the pole p of the row's filter, x_h = (s / (s + p))^2 x, and
least squares give c and c k from what the other columns leave of the torque, e:

    min  p int (e_h - c s_h - c k b_h)^2 dt + l (c - c_0)^2 + l_b (c k)^2

with b = s exp(-(v / v_s)^2).  The sums forget once they contain `_ENERGY`, some eight
reversals.  If the last two reversals both contradict them by more than the unmodelled
torque f, they overrule what is older.

*Used within the evidence.*  What is learned of friction must not cost more than not knowing it,
which errs by |c_0 - c|.  Two things may contradict c^ before the sums do: a reversal that shows
c_1, the last, or c_2, the one before; and the observer.  If d^3 rises by delta along the motion
since the last reversal, either the friction has risen by that much, which turns over at the next
reversal, or a push has begun, which stays.  delta is counted until v crosses zero: d^3 takes some
0.05 s to follow, and what it adds while the joint slows down turns over all the same.  The
compensation at v is the value nearest to c_0

    C(v) = clip(c_0, g(v) min E, g(v) max E),
    E = c^ + {0, z(c_1 - c^), z(c_2 - c^), z(delta), z(delta_min), z(delta_max)}

among all that they allow, with the dead zone z of f and the extremes of delta in
earlier motions since a reversal was last measured.  It lies between c_0 and each of
them, so that whichever is true, C errs by no more than c_0 does.  C is handed over to
d^3 like everything that is learned: it changes no torque until the joint reverses.
"""

from math import sqrt

from blf_dsc_controller.arms.friction import STRIBECK_SPEED, fading, sliding
from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.law.clipping import clip
from blf_dsc_controller.law.lag import filter_gain
from blf_dsc_controller.law.state import FILTERED, Settings, Signals, State

_ENERGY = 1.0  # of p int s_h^2 dt; a reversal has an eighth of it
_SHOWN = 0.06  # of p int (g s)_h^2 dt: half a reversal, which shows its friction
_PRIOR = 0.015  # pull to c_0, of (f / its deviation)^2; that of a reversal is an eighth
_STRIBECK_PRIOR = 0.1  # pull of c k to zero, over that of c to c_0
_MOST_STRIBECK = 1.0  # k^: breakaway takes at most twice the Coulomb friction
_MOVING = 0.9  # of |s|: below it a joint reverses

# Rows of the sums over products of s_h, b_h and e_h
_SE, _BE, _SS, _SB, _BB = range(5)


@inner
def first_coulomb(settings: Settings) -> int:
    """Return the index of the first column of Coulomb friction in theta."""
    return settings.p + settings.n * (settings.bias + settings.viscous)


@inner
def learns_from_reversals(settings: Settings) -> bool:
    """Return whether there are columns of Coulomb friction, and rows that show its steps."""
    return settings.coulomb == 1 and settings.prediction == FILTERED


@inner
def unmodelled(settings: Settings, i: int) -> float:
    """Return the unmodelled torque f of joint i [N m]."""
    return float(sqrt(settings.residual_floor / settings.n) / settings.row_weight[i])


@inner
def beyond(x: float, band: float) -> float:
    """Return z(x), by how much x is outside of [-band, band]."""
    return x - clip(x, -band, band)


@inner
def coulomb_torque(settings: Settings, state: State, signals: Signals, i: int) -> float:
    """Return the compensation C(v) s(v) of joint i [N m]."""
    j = first_coulomb(settings) + i
    learned = state.estimate[j]
    low = learned
    high = learned
    if settings.prediction == FILTERED and settings.bumpless == 1:
        band = unmodelled(settings, i)
        for evidence in (
            beyond(state.shown[0, i] - learned, band),
            beyond(state.shown[1, i] - learned, band),
            beyond(state.opposed[i], band),
            beyond(state.unanswered[0, i], band),
            beyond(state.unanswered[1, i], band),
        ):
            low = min(low, learned + evidence)
            high = max(high, learned + evidence)
    scale = 1.0 + state.breakaway[i] * signals.stribeck[i]
    level = clip(settings.initial_estimate[j], scale * low, scale * high)
    return float(level * signals.sign[i])


@inner
def fill_compensation(
    settings: Settings, state: State, signals: Signals, dt: float
) -> None:
    """Compute the friction at the velocity that the reference has when the torque acts.

    Torques act 1.5 samples and half of `robot.lag` late.  The measured velocity would
    feed its noise, and chatter at rest, into the torque.  Viscous friction has columns
    in `signals.H`; that of Coulomb's, which is not linear in theta, is
    `signals.friction` (n,) [N m].
    """
    viscous = settings.p + settings.n * settings.bias
    lead = 1.5 * dt + 0.5 * settings.lag
    for i in range(settings.n):
        velocity = signals.dqr[i] + lead * signals.ddqr[i]
        if settings.viscous == 1:
            signals.H[i, viscous + i] = velocity
        if settings.coulomb == 1:
            signals.sign[i] = sliding(velocity, settings.coulomb_velocity)
            signals.stribeck[i] = fading(velocity, STRIBECK_SPEED)
            signals.friction[i] = coulomb_torque(settings, state, signals, i)


@inner
def hand_over(settings: Settings, state: State, signals: Signals) -> None:
    """Subtract from d^3 what this sample has changed in the compensation of Coulomb friction."""
    if settings.coulomb == 0:
        return
    for i in range(settings.n):
        torque = coulomb_torque(settings, state, signals, i)
        if settings.bumpless == 1:
            state.disturbance[i] -= torque - signals.friction[i]
        signals.friction[i] = torque


@inner
def follow_observer(state: State, signals: Signals, i: int, step: float) -> None:
    """Add a step [N m] of d^3 of joint i by the tracking error to delta, until v crosses zero."""
    if signals.sign[i] * state.direction[i] > 0.0:
        state.opposed[i] += step * state.direction[i]


@inner
def follow_motion(settings: Settings, state: State, signals: Signals) -> None:
    """Find the joints that begin to reverse, and those that have reversed: delta is zero again."""
    if not learns_from_reversals(settings):
        return
    for i in range(settings.n):
        sign = signals.sign[i]
        moves = abs(sign) > _MOVING
        if moves and sign * state.direction[i] <= 0.0:
            state.direction[i] = 1.0 if sign > 0.0 else -1.0
            state.unanswered[0, i] = min(state.unanswered[0, i], state.opposed[i])
            state.unanswered[1, i] = max(state.unanswered[1, i], state.opposed[i])
            state.opposed[i] = 0.0
        if not moves and state.moves[i] == 1.0:
            close_reversal(settings, state, i)
        state.moves[i] = 1.0 if moves else 0.0


@inner
def filter_shapes(
    settings: Settings, state: State, signals: Signals, dt: float
) -> None:
    """Pass s and b of the last interval, at the measured velocity, through the poles of the row."""
    if not learns_from_reversals(settings):
        return
    gain = filter_gain(1.0 / settings.pole, dt)
    lags = state.shape_lags
    for i in range(settings.n):
        s = sliding(signals.dq[i], settings.coulomb_velocity)
        b = s * fading(signals.dq[i], STRIBECK_SPEED)
        for k in range(2):
            now = s if k == 0 else b
            mean = 0.5 * (now + lags[k, 0, i])
            lags[k, 0, i] = now
            lags[k, 1, i] += gain * (mean - lags[k, 1, i])
            lags[k, 2, i] += gain * (lags[k, 1, i] - lags[k, 2, i])


@inner
def breakaway_torque(settings: Settings, state: State, i: int) -> float:
    """Return what breakaway adds to the Coulomb friction of joint i, as it moves now [N m]."""
    if settings.coulomb == 0:
        return 0.0
    j = first_coulomb(settings) + i
    return float(state.estimate[j] * state.breakaway[i] * state.shape_lags[1, 0, i])


@inner
def high_pass(lags: Array, i: int, gain: float, x: float, begins: bool) -> float:
    """Advance the two lags of joint i and return what they leave of x, at the beginning zero."""
    if begins:
        lags[0, i] = x
        lags[1, i] = 0.0
    for k in range(2):
        lags[k, i] += gain * (x - lags[k, i])
        x -= lags[k, i]
    return x


@inner
def unexplained(settings: Settings, state: State, i: int) -> float:
    """Return e, what theta^ without Coulomb friction leaves of the torque in the row of joint i."""
    own = first_coulomb(settings) + i
    row = state.filter2[i]
    e = row[settings.m]
    for j in range(settings.m):
        if j != own:
            e -= row[j] * state.estimate[j]
    return float(e)


@inner
def measure_reversals(settings: Settings, state: State, dt: float) -> None:
    """Add the last row, `dt` [s] after the one before it, to the sums of the present reversal.

    They begin T_a after the latch, when the other columns are those of the window, and
    once a full window is known to be of one arm or this one is half full: those of less
    are too vague.
    """
    if not learns_from_reversals(settings):
        return
    settling_time = settings.learning_start - settings.window * dt
    state.since_latch[0] = state.latched[0] * (state.since_latch[0] + dt)
    is_known = (
        settings.change_detection == 0
        or state.least_residual[0] > 0.0
        or state.rows[0] >= 0.5 * settings.window
    )
    begins = state.since_latch[0] <= settling_time or not is_known
    gain = filter_gain(1.0 / settings.pole, dt)
    weight = settings.pole * dt
    for i in range(settings.n):
        e = unexplained(settings, state, i)
        s_h = high_pass(
            state.column_lags[0], i, gain, state.shape_lags[0, 2, i], begins
        )
        b_h = high_pass(
            state.column_lags[1], i, gain, state.shape_lags[1, 2, i], begins
        )
        e_h = high_pass(state.torque_lags, i, gain, e, begins)
        before = shown_energy(state, i)
        latest = state.latest_sums
        latest[_SE, i] += weight * s_h * e_h
        latest[_BE, i] += weight * b_h * e_h
        latest[_SS, i] += weight * s_h * s_h
        latest[_SB, i] += weight * s_h * b_h
        latest[_BB, i] += weight * b_h * b_h
        show_reversal(settings, state, i, before)


@inner
def shown_energy(state: State, i: int) -> float:
    """Return p int (g s)_h^2 dt of the present reversal of joint i."""
    k = state.breakaway[i]
    latest = state.latest_sums
    return float(latest[_SS, i] + 2.0 * k * latest[_SB, i] + k * k * latest[_BB, i])


@inner
def show_reversal(settings: Settings, state: State, i: int, before: float) -> None:
    """Compute c_1 of joint i once its reversal shows it; `before` is its energy a row ago."""
    energy = shown_energy(state, i)
    if energy <= _SHOWN:
        return
    if before <= _SHOWN:
        state.shown[1, i] = state.shown[0, i]
        state.unanswered[0, i] = 0.0
        state.unanswered[1, i] = 0.0
    j = first_coulomb(settings) + i
    latest = state.latest_sums
    torque = latest[_SE, i] + state.breakaway[i] * latest[_BE, i]
    state.shown[0, i] = clip(torque / energy, settings.least[j], settings.most[j])


@inner
def close_reversal(settings: Settings, state: State, i: int) -> None:
    """Add the sums of the present reversal of joint i to those of all; begin new ones."""
    latest = state.latest_sums
    sums = state.reversal_sums
    is_shown = shown_energy(state, i) > _SHOWN
    excess = sums[_SS, i] + latest[_SS, i] - _ENERGY
    keep = 1.0
    if excess > 0.0:
        keep = max(0.0, 1.0 - excess / sums[_SS, i])
    for k in range(5):
        sums[k, i] = keep * sums[k, i] + latest[k, i]
        latest[k, i] = 0.0
    if is_shown:
        overrule(settings, state, i)


@inner
def overrule(settings: Settings, state: State, i: int) -> None:
    """Give the sums of joint i the friction of the last two reversals if both contradict them."""
    coulomb, stribeck = learned_friction(settings, state, i)
    band = unmodelled(settings, i)
    last = beyond(state.shown[0, i] - coulomb, band)
    other = beyond(state.shown[1, i] - coulomb, band)
    if last * other <= 0.0:
        return
    level = 0.5 * (state.shown[0, i] + state.shown[1, i])
    extra = level * stribeck
    sums = state.reversal_sums
    sums[_SE, i] = level * sums[_SS, i] + extra * sums[_SB, i]
    sums[_BE, i] = level * sums[_SB, i] + extra * sums[_BB, i]


@inner
def learned_friction(settings: Settings, state: State, i: int) -> tuple[float, float]:
    """Return c [N m] and k of joint i by all sums, k within its limits."""
    j = first_coulomb(settings) + i
    f = unmodelled(settings, i)
    pull = _PRIOR * f * f / settings.variance[j]
    sums = state.reversal_sums
    latest = state.latest_sums
    se = sums[_SE, i] + latest[_SE, i] + pull * settings.initial_estimate[j]
    be = sums[_BE, i] + latest[_BE, i]
    ss = sums[_SS, i] + latest[_SS, i] + pull
    sb = sums[_SB, i] + latest[_SB, i]
    bb = sums[_BB, i] + latest[_BB, i] + _STRIBECK_PRIOR * pull
    determinant = ss * bb - sb * sb
    k = 0.0
    if determinant > 0.0:
        coulomb = se * bb - be * sb
        stribeck = be * ss - se * sb
        if coulomb > 0.0:
            k = clip(stribeck / coulomb, 0.0, _MOST_STRIBECK)
        elif stribeck > 0.0:
            k = _MOST_STRIBECK
    energy = ss + 2.0 * k * sb + k * k * bb
    if energy <= 0.0:
        return settings.initial_estimate[j], 0.0
    return (se + k * be) / energy, k


@inner
def follow_reversals(settings: Settings, state: State, signals: Signals) -> None:
    """Write c minus the estimate to the entries of Coulomb friction in `signals.rate`.

    What k^ lacks goes to `signals.breakaway_rate`.
    """
    if not learns_from_reversals(settings):
        return
    first = first_coulomb(settings)
    for i in range(settings.n):
        signals.breakaway_rate[i] = 0.0
        if state.active[first + i] == 0.0:
            continue
        coulomb, stribeck = learned_friction(settings, state, i)
        signals.rate[first + i] = coulomb - state.estimate[first + i]
        signals.breakaway_rate[i] = stribeck - state.breakaway[i]


@inner
def adapt_breakaway(
    settings: Settings, state: State, signals: Signals, dt: float
) -> None:
    """Advance k^ by `dt` [s]: k^' = Gamma kappa (k - k^)."""
    if not learns_from_reversals(settings) or state.latched[0] == 0.0:
        return
    first = first_coulomb(settings)
    for i in range(settings.n):
        rate = settings.Gamma[first + i] * settings.kappa * signals.breakaway_rate[i]
        state.breakaway[i] += dt * rate
