# SPDX-License-Identifier: Apache-2.0
"""Coulomb friction and breakaway, identified at the reversals of the joints.

The window of the learning cannot be trusted with Coulomb friction: its rows are dominated by the
frequencies of the reference, at which a sin w t against the velocity takes 0.64 a off the estimate
and leaves no residual.  What only friction has is the step, where the joint reverses.  So
least squares give c and c k from what the other columns leave of the torque, e, behind a
high pass that only a step passes (index h; `friction` has the filters):

    min  p int (e_h - c s_h - c k b_h)^2 dt + l (c - c_0)^2 + l_b (c k)^2

with s the direction of the motion and b what breakaway has in excess.  The sums forget once they
contain `_MEMORY_ENERGY`, some eight reversals.  If the last two reversals both contradict them by
more than the unmodelled torque f, they overrule what is older.

What pushes the arm as a joint reverses, or a load that comes on, leaves steps of its own in e_h,
earlier or later than that of friction.  So a reversal counts by

    1 / (1 + (d / a)^2),    d^2 p int (g s)_h^2 dt = p int (e_h - c_1 (g s)_h)^2 - C n^2 dt

where d is the friction whose step would be as large as what the friction c_1 of this reversal
leaves of the torque around it, n the rms of e_h away from reversals, its noise, C the
`_CHANCE_RATIO`, and a what the shape g s is wrong by: a part of f, and of c.

If the arm has changed, the evidence since some 0.2 s before that was detected is taken back:
a load that comes on in a reversal looks like the step of friction.
"""

from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, Cell
from blf_dsc_controller.law.clipping import clip
from blf_dsc_controller.law.innovation import DETECTION_TIME
from blf_dsc_controller.law.lag import filter_gain

_MEMORY_ENERGY = 1.0  # of p int s_h^2 dt; a reversal has an eighth of it
_IDENTIFIED_ENERGY = (
    0.05  # of p int (g s)_h^2 dt: half a reversal, which identifies its friction
)
# pull to c_0, of (f / its deviation)^2; that of a reversal is an eighth
_COULOMB_PRIOR = 0.015
_STRIBECK_PRIOR = 0.1  # pull of c k to zero, over that of c to c_0
_MAX_STRIBECK = 1.0  # k^: breakaway takes at most twice the Coulomb friction
_NEAR_TIME = 0.1  # s around a reversal in which its torque is compared with friction's
_QUIET_TIME = 4.0  # s, of what is away from reversals: its noise
_CHANCE_RATIO = 2.0  # times its mean square
# of p int s_h^2 dt, faded by `_NEAR_TIME`, from which on the joint reverses
_TOUCHED = 0.004
_ALLOWED_F, _ALLOWED_C = 0.5, 2.0  # a over f, and over c

# Rows of the sums over products of s_h, b_h and e_h
_SE, _BE, _SS, _SB, _BB = range(5)


class Settings(NamedTuple):
    """What is known of Coulomb friction before any reversal."""

    unmodelled: Annotated[Array, 'n']  # f, rms torque that no column describes, N m
    initial: Annotated[Array, 'n']  # c_0, N m
    variance: Annotated[Array, 'n']  # of c_0, (N m)^2
    lower: Annotated[Array, 'n']  # value that c^ can have, N m
    upper: Annotated[Array, 'n']


class Row(NamedTuple):
    """A row of one joint behind the high pass."""

    s: float  # s_h
    b: float  # b_h
    e: float  # e_h, N m
    weight: float  # p dt


class Evidence(NamedTuple):
    """Sums of the reversals, and the Coulomb friction by the last two."""

    # p int of s_h e_h, b_h e_h [N m], s_h^2, s_h b_h and b_h^2, over past reversals
    past: Annotated[Array, 5, 'n']
    present: Annotated[Array, 5, 'n']  # likewise, over the present one
    # p int of e_h^2 dt [(N m)^2] and of dt, around the present one
    torque: Annotated[Array, 'n']
    span: Annotated[Array, 'n']
    # Coulomb friction by the last reversal and the one before, N m
    coulomb: Annotated[Array, 2, 'n']


class State(NamedTuple):
    """What is kept from one row to the next."""

    evidence: Evidence
    earlier: Evidence  # some `DETECTION_TIME` ago or less
    earliest: Evidence  # one to two times as long ago
    since_kept: Cell  # s
    # p int of s_h^2, e_h^2 [(N m)^2] and 1 dt, faded by `_NEAR_TIME`
    recent: Annotated[Array, 3, 'n']
    # p int of e_h^2 dt and dt away from reversals, faded by `_QUIET_TIME`
    noise: Annotated[Array, 2, 'n']


@inner
def begin(settings: Settings, state: State) -> None:
    """Begin with c_0 in place of the friction of past reversals."""
    for i in range(settings.initial.size):
        for k in range(2):
            state.evidence.coulomb[k, i] = settings.initial[i]
    copy(state.evidence, state.earlier)
    copy(state.evidence, state.earliest)


@inner
def beyond(x: float, dead_zone: float) -> float:
    """Return z(x), by how much x is outside of [-dead_zone, dead_zone]."""
    return x - clip(x, -dead_zone, dead_zone)


@inner
def add_row(
    settings: Settings,
    state: State,
    i: int,
    row: Row,
    k: float,
    dt: float,
) -> bool:
    """Add a row of joint i, `dt` [s] after the last, to its present reversal.

    Return whether this row is the first from which the reversal identifies its friction.  c_1
    follows from this and each later one.  k is k^.
    """
    sums = state.evidence.present
    s, b, e, weight = row
    was_identified = accepted_weight(settings, state, i, k) > 0.0
    sums[_SE, i] += weight * s * e
    sums[_BE, i] += weight * b * e
    sums[_SS, i] += weight * s * s
    sums[_SB, i] += weight * s * b
    sums[_BB, i] += weight * b * b
    add_torque(state, i, row, dt)
    if accepted_weight(settings, state, i, k) == 0.0:
        return False
    coulomb = state.evidence.coulomb
    if not was_identified:
        coulomb[1, i] = coulomb[0, i]
    torque = sums[_SE, i] + k * sums[_BE, i]
    coulomb[0, i] = clip(
        torque / energy(state.evidence, i, k), settings.lower[i], settings.upper[i]
    )
    return not was_identified


@inner
def add_torque(state: State, i: int, row: Row, dt: float) -> None:
    """Add e_h^2 of joint i to the torque around its reversal, `_NEAR_TIME` before and after it.

    Away from reversals e_h is noise.
    """
    weight = row.weight
    ss = row.s * row.s
    ee = row.e * row.e
    recent, noise, evidence = state.recent, state.noise, state.evidence
    reversed_before = recent[0, i] > _TOUCHED
    fade(recent, i, _NEAR_TIME, dt)
    recent[0, i] += weight * ss
    recent[1, i] += weight * ee
    recent[2, i] += weight
    if recent[0, i] <= _TOUCHED:
        fade(noise, i, _QUIET_TIME, dt)
        noise[0, i] += weight * ee
        noise[1, i] += weight
    elif reversed_before:
        evidence.torque[i] += weight * ee
        evidence.span[i] += weight
    else:
        evidence.torque[i] += recent[1, i]
        evidence.span[i] += recent[2, i]


@inner
def fade(sums: Array, i: int, time_constant: float, dt: float) -> None:
    """Let the sums of joint i fade for `dt` [s], with a time constant [s]."""
    retained = 1.0 - filter_gain(time_constant, dt)
    for row in range(sums.shape[0]):
        sums[row, i] *= retained


@inner
def energy(evidence: Evidence, i: int, k: float) -> float:
    """Return p int (g s)_h^2 dt of the present reversal of joint i, with g of k."""
    sums = evidence.present
    return float(sums[_SS, i] + 2.0 * k * sums[_SB, i] + k * k * sums[_BB, i])


@inner
def robust_weight(settings: Settings, state: State, i: int, k: float) -> float:
    """Return the weight 1 / (1 + (d / a)^2) of the present reversal of joint i, in [0, 1].

    k is k^.
    """
    evidence, noise = state.evidence, state.noise
    friction_energy = energy(evidence, i, k)
    if friction_energy <= 0.0:
        return 0.0
    torque = evidence.present[_SE, i] + k * evidence.present[_BE, i]
    misfit = evidence.torque[i] - torque * torque / friction_energy
    if noise[1, i] > 0.0:
        misfit -= _CHANCE_RATIO * evidence.span[i] * noise[0, i] / noise[1, i]
    f = settings.unmodelled[i]
    pull = _COULOMB_PRIOR * f * f / settings.variance[i]
    c = evidence.past[_SE, i] + pull * settings.initial[i]
    c /= evidence.past[_SS, i] + pull
    allowed = (_ALLOWED_F * f) ** 2 + (_ALLOWED_C * c) ** 2
    return float(
        allowed * friction_energy / (allowed * friction_energy + max(0.0, misfit))
    )


@inner
def accepted_weight(settings: Settings, state: State, i: int, k: float) -> float:
    """Return the same; 0 until the reversal identifies its friction."""
    weight = robust_weight(settings, state, i, k)
    return weight if weight * energy(state.evidence, i, k) > _IDENTIFIED_ENERGY else 0.0


@inner
def close(settings: Settings, state: State, i: int, k: float) -> None:
    """Add the sums of the present reversal of joint i to those of all, if it counts.

    Otherwise they are the beginning of the next.  k is k^.
    """
    evidence = state.evidence
    latest, sums = evidence.present, evidence.past
    weight = accepted_weight(settings, state, i, k)
    if weight == 0.0:
        return
    excess = sums[_SS, i] + weight * latest[_SS, i] - _MEMORY_ENERGY
    retained = 1.0
    if excess > 0.0:
        retained = max(0.0, 1.0 - excess / sums[_SS, i])
    for row in range(5):
        sums[row, i] = retained * sums[row, i] + weight * latest[row, i]
        latest[row, i] = 0.0
    evidence.torque[i] = evidence.span[i] = 0.0
    overrule(settings, state, i)


@inner
def overrule(settings: Settings, state: State, i: int) -> None:
    """Give the sums of joint i the friction of the last two reversals if both contradict them."""
    coulomb, stribeck = learned(settings, state, i, 0.0)
    evidence = state.evidence
    coulomb_by_reversal = evidence.coulomb
    dead_zone = settings.unmodelled[i]
    last = beyond(coulomb_by_reversal[0, i] - coulomb, dead_zone)
    before = beyond(coulomb_by_reversal[1, i] - coulomb, dead_zone)
    if last * before <= 0.0:
        return
    level = 0.5 * (coulomb_by_reversal[0, i] + coulomb_by_reversal[1, i])
    extra = level * stribeck
    sums = evidence.past
    sums[_SE, i] = level * sums[_SS, i] + extra * sums[_SB, i]
    sums[_BE, i] = level * sums[_SB, i] + extra * sums[_BB, i]


@inner
def learned(
    settings: Settings, state: State, i: int, k_now: float
) -> tuple[float, float]:
    """Return c [N m] and k of joint i, the least-squares solution of all sums; 0 <= k <= 1.

    `k_now` is k^, which gives the present reversal its weight.
    """
    f = settings.unmodelled[i]
    pull = _COULOMB_PRIOR * f * f / settings.variance[i]
    sums = state.evidence.past
    latest = state.evidence.present
    weight = accepted_weight(settings, state, i, k_now)
    se = sums[_SE, i] + weight * latest[_SE, i] + pull * settings.initial[i]
    be = sums[_BE, i] + weight * latest[_BE, i]
    ss = sums[_SS, i] + weight * latest[_SS, i] + pull
    sb = sums[_SB, i] + weight * latest[_SB, i]
    bb = sums[_BB, i] + weight * latest[_BB, i] + _STRIBECK_PRIOR * pull
    # c and c k, times the determinant of the equations, which the pull keeps positive
    coulomb = se * bb - be * sb
    stribeck = be * ss - se * sb
    k = 0.0
    if coulomb > 0.0:
        k = clip(stribeck / coulomb, 0.0, _MAX_STRIBECK)
    elif stribeck > 0.0:
        k = _MAX_STRIBECK
    return (se + k * be) / (ss + 2.0 * k * sb + k * k * bb), k


@inner
def keep(state: State, dt: float) -> None:
    """Keep the evidence each `DETECTION_TIME`, and what was kept before; `dt` [s] later."""
    state.since_kept[0] += dt
    if state.since_kept[0] > DETECTION_TIME:
        state.since_kept[0] = 0.0
        copy(state.earlier, state.earliest)
        copy(state.evidence, state.earlier)


@inner
def take_back(state: State, breakaway: Array) -> None:
    """Return to the evidence from before the last rows, which are those of a change of the arm.

    A reversal that has just begun is forgotten as a whole.  `breakaway` is k^ (n,).
    """
    evidence = state.evidence
    copy(state.earliest, evidence)
    for i in range(breakaway.size):
        if energy(evidence, i, breakaway[i]) <= _IDENTIFIED_ENERGY:
            for row in range(5):
                evidence.present[row, i] = 0.0
            evidence.torque[i] = evidence.span[i] = 0.0
    copy(evidence, state.earliest)
    copy(evidence, state.earlier)


@inner
def copy(source: Evidence, out: Evidence) -> None:
    """Copy the evidence."""
    for i in range(out.coulomb.shape[1]):
        for row in range(5):
            out.past[row, i] = source.past[row, i]
            out.present[row, i] = source.present[row, i]
        for row in range(2):
            out.coulomb[row, i] = source.coulomb[row, i]
        out.torque[i] = source.torque[i]
        out.span[i] = source.span[i]
