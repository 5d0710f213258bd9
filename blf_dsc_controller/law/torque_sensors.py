# SPDX-License-Identifier: Apache-2.0
"""Whether what is read as the torque of joint sensors is that: else the load observer ends.

An arm may be declared to have joint torque sensors and have none, so that its efforts are
the commands or the motors' currents; its encoders may be at the motors; a sensor may be
stuck, dead, or in another unit.  The load observer then is feedback that nobody designed.
With U the response of the drives, M_l the inertia of the links of the model, L its pole,
and k and D those of a gear,

    r = L / (s + L) (tau_J - M_l s^2 y)

    efforts are commands:  tau_J = U tau     a loop of gain up to 1 around the law, and more
                                             where the gear resonates and M_l s^2 y turns
    y is of the motor:     tau_J = M_l s^2 y (D s + k) / (M_l s^2 + D s + k)
                                             the gear's resonance, with M_l behind it

are stable only with an L of some rad/s.  So is a true sensor, where a gear is softer than is
known, and a load heavier.  So r fades out for good where

- *it shakes*: what r adds oscillates (`oscillation`, of r instead of the error).  Then it becomes
  slower, only in the joints that shake: loads, which stay, are found, if later.  If r of one of
  these still shakes after `MOST_STEPS` times, all of r is left out.  Where the arm oscillates, and
  that does not grow, r takes the blame first: slower, it costs less than softer feedback.
- *efforts are commands*: in the first motion, efforts behind the filter L are within a
  `_EQUAL` share of the torque that is commanded, as seen against what they are away from
  that of the links, in the geometric mean of the joints.  The mean squares are those of
  what changes faster than `_SLOWEST`.  Between sensor and command are motor and friction,
  also those that a torque loop leaves: they are known to be there as soon as the mean
  exceeds `_DISTINCT`, and then this question is not asked again.  Until then r is slower,
  and one that shakes is left out.
- *efforts do not follow*: drives with a loop around sensors make of them what is commanded,
  whatever load or contact is behind.  An effort that is off by `_OFF` of the torque limit
  leaves r out while that lasts, and if it lasts while the arm follows its reference, for
  good: the command has reached the arm.  Otherwise it may not have (`effect`).
"""

from __future__ import annotations

from math import pi
from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, Cell
from blf_dsc_controller.law import oscillation
from blf_dsc_controller.law.lag import filter_gain
from blf_dsc_controller.law.load_observer import MOST_STEPS, calmed_share

NONE, MAY_SHAKE, SHAKES, STILL_SHAKES, COMMANDS, OFF = range(6)
"""What is wrong with the efforts, if anything; beyond SHAKES all of r is left out."""

FALLS = 0.07
"""Time [s] after the start in which an arm falls that holds a load of which nobody knows."""

_FADE = 0.02  # s, time constant with which r is left out or comes back
_SHAKEN = 0.005  # s, likewise of one that shakes: it may grow threefold in 10 ms
_NOTHING = 1e-6  # of r
_SLOWEST = 0.5  # Hz
_EQUAL = 0.02
_DISTINCT = 0.1
_LEAST_MOTION = 0.25  # s, of what is compared
_MOVES = 0.03  # rad/s, of the reference
_OFF = 0.1  # of the torque limit
_LASTING = 0.05  # s
_FOLLOWS = 0.25  # of the speed of the reference
_CLEAR = 0.0125  # of the torque limit, half of a half wave of r
_STRONG = 0.5  # of the torque limit, a twentieth of which is a wave


class State(NamedTuple):
    """What it keeps from one sample to the next."""

    fault: Cell  # one of NONE to OFF
    noted: Cell  # how many times one has been
    joint: Cell  # that shows it
    is_distinct: Cell  # 1: efforts are known not to be commands
    waits: Cell  # 1: r is left out until they are, since it has shaken
    moved: Cell  # s of motion so far
    # N m, of the last interval behind L: the torque commanded
    command: Annotated[Array, 'n * observer.enabled']
    # N m, lags of efforts less commands, and of efforts less the torque of the links
    slow: Annotated[Array, '2 * observer.enabled', 'n']
    # (N m)^2 s, integrals of the squares of what is faster
    square: Annotated[Array, '2 * observer.enabled', 'n']
    lasted: Annotated[Array, 'n * observer.enabled']  # s, since efforts are off
    shaking: oscillation.State  # of r


class Work(NamedTuple):
    """Scratch of one sample."""

    # N m, efforts less commands, and less the torque of the links
    differences: Annotated[Array, '2 * observer.enabled', 'n']
    limit: Annotated[Array, 'n * observer.enabled']  # N m, by which r counts as strong
    clear: Annotated[Array, 'n * observer.enabled']  # N m, of a wave of r
    zeros: Annotated[Array, 'n * observer.enabled']


@inner
def begin(state: State, torque: Array) -> None:
    """Begin with r, a `torque` (n,) [N m]."""
    oscillation.begin(state.shaking, torque, torque)


@inner
def follow_applied(
    state: State, row: Array, m: int, bandwidth: float, dt: float
) -> None:
    """Pass the torque of the last interval, at m of `row`, through L, `bandwidth` [rad/s]."""
    share = filter_gain(1.0 / bandwidth, dt)
    for i in range(state.command.size):
        state.command[i] += share * (row[i, m] - state.command[i])


@inner
def note_fault(state: State, fault: float, i: int) -> None:
    """Keep the `fault` that joint i shows, unless r is left out already."""
    if state.fault[0] <= SHAKES:
        state.fault[0] = fault
        state.joint[0] = i
        state.noted[0] += 1.0


@inner
def watch_shaking(
    state: State, work: Work, limit: Array, torque: Array, slowed: Array, dt: float
) -> None:
    """Find whether r, a `torque` (n,) [N m], shakes the arm; `limit` (n,) [N m] as configured.

    `slowed` (n,) are the steps by which r of a joint is slower.
    """
    for i in range(torque.size):
        work.limit[i] = _STRONG * limit[i]
        work.clear[i] = _CLEAR * limit[i]
    oscillation.watch(
        state.shaking, work.limit, torque, torque, work.zeros, work.clear, dt
    )
    for i in range(torque.size):
        if oscillation.oscillates(state.shaking, i):
            note_fault(state, STILL_SHAKES if slowed[i] == MOST_STEPS else SHAKES, i)
            slow_down(state, state.shaking, slowed)
            oscillation.forget_all(state.shaking)


@inner
def slow_down(state: State, oscillating: oscillation.State, slowed: Array) -> None:
    """Make r a step slower, `MOST_STEPS` in all, in the joints of what is `oscillating`.

    As long as efforts may be commands, all of r waits until it is known that they are not.
    """
    for i in range(slowed.size):
        if oscillating.waves[i] >= oscillation.SOME:
            slowed[i] = min(slowed[i] + 1.0, MOST_STEPS)
    if state.is_distinct[0] == 0.0:
        state.waits[0] = 1.0
        state.moved[0] = 0.0
        state.square[:] = 0.0


@inner
def take_blame(
    state: State,
    arm: oscillation.State,
    limit: Array,
    most: Array,
    slowed: Array,
) -> bool:
    """Make r slower where the `arm` oscillates, at most `MOST_STEPS` times; return whether it did.

    `limit` (n,) [N m] is that of the torques, `most` (n,) [N m] the largest |r|, and `slowed` (n,)
    are the steps.  Nothing waits for r where the oscillation grows, or its torques are violent.
    """
    blamed = -1
    for i in range(slowed.size):
        if oscillation.oscillates(arm, i):
            is_violent = arm.amplitude[i] > oscillation.VIOLENT * limit[i]
            if is_violent or oscillation.grows(arm, i):
                return False
            if most[i] > 0.0 and slowed[i] < MOST_STEPS:
                blamed = i
    if blamed < 0 or state.fault[0] > SHAKES:
        return False
    slow_down(state, arm, slowed)
    note_fault(state, MAY_SHAKE, blamed)
    oscillation.forget_all(arm)
    return True


@inner
def begin_comparison(state: State, work: Work) -> None:
    """Begin with `work.differences`: what stays of them is not compared."""
    for k in range(2):
        for i in range(state.slow.shape[1]):
            state.slow[k, i] = work.differences[k, i]


@inner
def compare_with_commands(
    state: State, work: Work, dqr: Array, begins: bool, dt: float
) -> bool:
    """Find whether efforts are commands, by `work.differences`: `begins` with them.

    Return whether they have just been found not to be.  dqr (n,) [rad/s] is that of the reference.
    """
    if state.is_distinct[0] == 1.0:
        return False
    if begins:
        begin_comparison(state, work)
        return False
    n = dqr.size
    share = filter_gain(1.0 / (2.0 * pi * _SLOWEST), dt)
    moves = False
    for i in range(n):
        moves = moves or abs(dqr[i]) > _MOVES
    for k in range(2):
        for i in range(n):
            fast = work.differences[k, i] - state.slow[k, i]
            state.slow[k, i] += share * fast
            if moves:
                state.square[k, i] += dt * fast * fast
    if moves:
        state.moved[0] += dt
    return state.moved[0] > _LEAST_MOTION and decide(state)


@inner
def decide(state: State) -> bool:
    """Decide by the mean squares whether efforts are commands, certainly not, or neither yet.

    Return whether they certainly are not.
    """
    product = equal = distinct = 1.0
    nearest = 0
    for i in range(state.square.shape[1]):
        ratio = state.square[0, i] / max(state.square[1, i], 1e-12)
        product *= ratio
        equal *= _EQUAL
        distinct *= _DISTINCT
        near = state.square[0, nearest] / max(state.square[1, nearest], 1e-12)
        if ratio < near:
            nearest = i
    if product < equal:
        note_fault(state, STILL_SHAKES if state.waits[0] == 1.0 else COMMANDS, nearest)
    if product > distinct:
        state.waits[0] = 0.0
    if product > distinct or state.fault[0] > SHAKES:
        state.is_distinct[0] = 1.0
    return product > distinct


@inner
def watch_following(
    state: State, work: Work, limit: Array, dq: Array, dqr: Array, dt: float
) -> bool:
    """Find whether efforts are off, for good; return whether they are now, which may pass.

    `limit` (n,) [N m] is that of the torques.  The arm follows its reference where dq and
    dqr (n,) [rad/s] are about equal.
    """
    n = limit.size
    square = 0.0
    for i in range(n):
        square += dqr[i] * dqr[i]
    is_off = False
    for i in range(n):
        late = dq[i] - dqr[i]
        follows = square > _MOVES * _MOVES
        follows = follows and late * late < _FOLLOWS * _FOLLOWS * square
        is_one = abs(work.differences[0, i]) > _OFF * limit[i]
        is_off = is_off or is_one
        state.lasted[i] = state.lasted[i] + dt if is_one and follows else 0.0
        if state.lasted[i] > _LASTING:
            note_fault(state, OFF, i)
    return is_off


@inner
def fade(state: State, faded: Array, is_off: bool, dt: float) -> None:
    """Leave more of r out where the efforts are in doubt, or less; zero stays zero."""
    has_shaken = state.fault[0] == STILL_SHAKES or state.waits[0] == 1.0
    is_doubted = is_off or has_shaken or state.fault[0] > SHAKES
    aim = 1.0 if is_doubted else 0.0
    time_constant = _SHAKEN if has_shaken else _FADE
    if faded[0] != aim:
        faded[0] += filter_gain(time_constant, dt) * (aim - faded[0])
        if abs(faded[0] - aim) < _NOTHING:
            faded[0] = aim


@inner
def calm(slowed: Array, calmed: Array, dt: float) -> None:
    """Let r become as slow, or as fast, as the steps in `slowed` (n,) say."""
    share = filter_gain(_SHAKEN, dt)
    for i in range(calmed.size):
        aim = calmed_share(slowed[i])
        if calmed[i] != aim:
            calmed[i] += share * (aim - calmed[i])
            if abs(aim - calmed[i]) < _NOTHING:
                calmed[i] = aim


@inner
def is_fading(faded: Array, slowed: Array, calmed: Array) -> bool:
    """Whether more of r is being left out, or comes back; `calmed` (n,) is of each joint."""
    fades = 0.0 < faded[0] < 1.0
    for i in range(calmed.size):
        fades = fades or calmed[i] != calmed_share(slowed[i])
    return bool(fades)
