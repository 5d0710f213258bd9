# SPDX-License-Identifier: Apache-2.0
"""Motions from a moving state: time-optimal to a target, along a line, to rest.

They are lists of pieces, as splines are: a profile of limited jerk is cubic between the
times at which its jerk changes. The library ruckig computes such profiles (Berscheid
and Kroeger, 2021, doi:10.15607/RSS.2021.XVII.015). It is optional: without it,
`braking` is a polynomial, and a target can only be reached in a given time.

A streamed target is a place to rest at. With velocities it is a line that the reference
joins, and follows for a while, since the next target is on its way; then the reference
returns or brakes. So every motion ends at rest by itself.
"""

from __future__ import annotations

from math import nan
from typing import Any, NamedTuple

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.reference.approach import (
    MotionError,
    check_times,
)
from blf_dsc_controller.reference.terms import (
    Term,
    ending_at_rest,
    pack,
    quintics,
    sampled,
    turning_times,
    unpack,
)

try:
    import ruckig
except ImportError:
    ruckig = None

WITHOUT = (
    'the Python package ruckig is not installed, which plans motions to targets: '
    'pip install ruckig'
)
"""Why a target cannot be followed as fast as possible."""

_SOONEST = 0.02  # s in which a streamed target is joined at least
_GENTLEST = 0.05  # s of braking without ruckig, at least
_GROWTH = 1.2
_ATTEMPTS = 60
# of the lead, tried before a motion at the limits
_SMOOTH_LEADS = (1.0, 2.0, 4.0)
_LONGEST_SMOOTH = 0.2  # s; after losses, longer ones would stay behind
_CHASES = 8  # attempts to join a line that moves on meanwhile ...
_LATE = 1e-6  # ... up to this part of the duration
_CHECKS = 17  # times at which a quintic is checked
_PAST = 1e-9  # rad past a position limit, by rounding
_OTHER_UNITS = 0.2  # of a range, past which a target is not reduced to its end
_ROUNDING = 1.0 - 1e-9  # of a limit, for target velocities


class TrajectoryError(MotionError):
    """A rejected trajectory or target, with all problems found."""

    def __init__(self, problems: list[str]) -> None:
        self.problems = problems
        super().__init__('trajectory rejected: ' + '; '.join(problems))


class Pieces(NamedTuple):
    """Part of a motion: durations (k,) [s], coefficients (k, n, 6) [rad/s^j]."""

    durations: np.ndarray
    coefficients: np.ndarray

    @property
    def duration(self) -> float:
        """Time from begin to end [s]."""
        return float(self.durations.sum())

    @property
    def end(self) -> np.ndarray:
        """Position, velocity and acceleration (3, n) at the end."""
        after = shifted(self.coefficients[-1], float(self.durations[-1]))
        state: np.ndarray = after[:, :3].T * _FACTORIALS
        return state


_FACTORIALS = np.array([[1.0], [1.0], [2.0]])


class PlannedMotion(NamedTuple):
    """A packed reference that follows a trajectory or a target."""

    vector: np.ndarray
    settled: float  # s, end of the blend or of the way to the path
    end: float  # s, when the last point is reached, or the reference rests
    note: str = ''  # how the motion deviates from the times that were sent
    turned: str = ''  # how it is shifted by whole turns


class Target(NamedTuple):
    """A streamed target: a line through positions (n,), with velocities (n,).

    Without velocities, the reference comes to rest at the positions when it is due.
    """

    positions: tuple[float, ...]
    velocities: tuple[float, ...]
    due: float  # s since the start, when the reference should be at the positions
    until: float  # s, when it leaves the line if no other target follows
    held: bool  # whether it then returns to the positions, or rests where it has braked


def can_retarget() -> bool:
    """Whether ruckig is installed."""
    return ruckig is not None


def shifted(coefficients: np.ndarray, x: float) -> np.ndarray:
    """Return coefficients (n, 6) of the same polynomials about x [s] later."""
    c: np.ndarray = coefficients.copy()
    for first in range(5):  # Horner's scheme, once for each derivative
        for j in range(4, first - 1, -1):
            c[:, j] += x * c[:, j + 1]
    return c


def state_at(vector: np.ndarray, t: float) -> np.ndarray:
    """Return position, velocity, acceleration (3, n) of a reference at t [s]."""
    state: np.ndarray = sampled(vector, np.array([t]))[0]
    return state


def at_rest_after(t0: float, *parts: Pieces) -> Term:
    """Return the term from t0 [s] that follows the parts and stays at their end."""
    durations = np.concatenate([part.durations for part in parts])
    coefficients = np.concatenate([part.coefficients for part in parts])
    knots = np.concatenate(([t0], t0 + np.cumsum(durations)))
    return ending_at_rest(knots, coefficients, parts[-1].end[0])._replace(begin=t0)


def following(vector: np.ndarray, term: Term) -> np.ndarray:
    """Return a packed reference that equals `vector` until a term begins."""
    before = [each for each in unpack(vector) if each.begin < term.begin]
    return pack(int(vector[0]), [*before, term])


def quintic(begin: np.ndarray, end: np.ndarray, duration: float) -> Pieces:
    """Return the quintic between two states (3, n) in a time [s].

    Where the acceleration at the end is NaN, it is that of the least jerk: the jerk
    ends at 0.
    """
    end = end.copy()
    is_free = np.isnan(end[2])
    # c3 + 4 c4 h + 10 c5 h^2 = 0 in terms of the end's acceleration
    distance = end[0] - begin[0]
    rates = 12.0 * end[1] + 8.0 * begin[1]
    free = (duration * rates - 20.0 * distance) / (3.0 * duration**2) + begin[2] / 3.0
    end[2] = np.where(is_free, free, end[2])
    span = np.array([duration])
    return Pieces(span, quintics(span, begin[:, np.newaxis], end[:, np.newaxis]))


def profile(
    state: np.ndarray,
    config: ControllerConfig,
    target: np.ndarray | None = None,
    duration: float = 0.0,
    drift: np.ndarray | float = 0.0,
) -> Pieces:
    """Return the fastest motion of limited jerk from a state (3, n) to a target (2, n).

    The target is a position and a velocity, to be reached with constant velocity;
    without one, the motion comes to rest anywhere. All joints arrive together, after a
    `duration` [s] at least. State, target and motion are given relative to a point that
    moves with `drift` (n,) [rad/s].

    Raises:
        MotionError: there is none, or ruckig is not installed.
    """
    if ruckig is None:
        raise MotionError(WITHOUT)
    given = _limited(state, config, drift)
    if target is None:
        given.control_interface = ruckig.ControlInterface.Velocity
        given.target_velocity = [0.0] * len(config.joints)
    else:
        given.target_position, given.target_velocity = target.tolist()
    if duration > 0.0:
        given.minimum_duration = duration
    return _pieces_of(_solved(given, state), state)


def _limited(
    state: np.ndarray, config: ControllerConfig, drift: np.ndarray | float
) -> Any:
    """Return ruckig's problem of a motion from a state within the limits, yet without a target."""
    n = len(config.joints)
    given = ruckig.InputParameter(n)
    given.current_position, given.current_velocity, given.current_acceleration = (
        state.tolist()
    )
    fastest = np.array(config.limits.velocity)
    given.max_velocity = (fastest - drift).tolist()
    given.min_velocity = (-fastest - drift).tolist()
    given.max_acceleration = config.limits.acceleration
    given.max_jerk = config.limits.jerk
    given.target_acceleration = [0.0] * n
    return given


def _solved(given: Any, state: np.ndarray) -> Any:
    """Return ruckig's trajectory; raise MotionError, which names the state, if there is none."""
    n = state.shape[1]
    found = ruckig.Trajectory(n)
    none = (
        'ruckig found no motion from position, velocity and acceleration '
        f'{state.tolist()}: '
    )
    try:
        result = ruckig.Ruckig(n).calculate(given, found)
    # it fails by an exception, by one of its own numbers that it has no name for, ...
    except (ruckig.RuckigError, ValueError) as error:
        raise MotionError(none + str(error).strip().partition('\n')[0]) from error
    if result not in (ruckig.Result.Working, ruckig.Result.Finished):  # ... or so
        raise MotionError(none + result.name)
    return found


def _pieces_of(found: Any, state: np.ndarray) -> Pieces:
    """Return a trajectory of ruckig from a state (3, n) as common pieces."""
    joints = [_phases(each, *state[:, i]) for i, each in enumerate(found.profiles[0])]
    changes = np.unique(np.concatenate([times for times, _ in joints]))
    knots = changes[:-1][np.diff(changes) > 1e-12]
    knots = np.append(knots, changes[-1])
    if knots.size < 2:
        knots = np.array([0.0, 1e-9])
    coefficients = np.zeros((knots.size - 1, len(joints), 6))
    for i, (times, states) in enumerate(joints):
        phase = np.searchsorted(times, knots[:-1], 'right') - 1
        x = knots[:-1] - times[phase]
        p, v, a, j = states[phase].T
        coefficients[:, i, 0] = p + x * (v + x * (a / 2.0 + x * j / 6.0))
        coefficients[:, i, 1] = v + x * (a + x * j / 2.0)
        coefficients[:, i, 2] = (a + x * j) / 2.0
        coefficients[:, i, 3] = j / 6.0
    return Pieces(np.diff(knots), coefficients)


def _phases(joint: Any, p: float, v: float, a: float) -> tuple[np.ndarray, np.ndarray]:
    """Return begins (k,) [s] and states (k, 4) of phases of constant jerk."""
    t, times, states = 0.0, [], []
    spans = [*joint.brake.t, *joint.t]
    for x, j in zip(spans, [*joint.brake.j, *joint.j], strict=True):
        times.append(t)
        states.append((p, v, a, j))
        p += x * (v + x * (a / 2.0 + x * j / 6.0))
        v += x * (a + x * j / 2.0)
        a += x * j
        t += x
    times.append(t)
    states.append((p, v, 0.0, 0.0))
    return np.array(times), np.array(states)


def braking(state: np.ndarray, config: ControllerConfig) -> Pieces:
    """Return the fastest motion from a state (3, n) to rest.

    Within the limits, unless the state already exceeds them.
    """
    if ruckig is not None:
        try:
            return profile(state, config)
        except MotionError:
            pass
    limit = np.array(config.limits.acceleration)
    h = max(_GENTLEST, float(np.max(1.5 * np.abs(state[1]) / limit)))
    for _ in range(_ATTEMPTS):
        end = np.zeros_like(state)
        # the velocity is a cubic from v to 0 with the slopes a and 0
        end[0] = state[0] + h * state[1] / 2.0 + h * h * state[2] / 12.0
        motion = quintic(state, end, h)
        times = np.linspace(0.0, h, 50)
        accelerations = sampled(pack(limit.size, [at_rest_after(0.0, motion)]), times)[
            :, 2
        ]
        if np.all(np.abs(accelerations) <= limit * (1.0 + 1e-9)):
            break
        h *= _GROWTH
    return motion


def plan_stop(
    vector: np.ndarray, now: float, config: ControllerConfig
) -> PlannedMotion:
    """Return a reference that is `vector` until `now` [s], then brakes and holds."""
    motion = braking(state_at(vector, now), config)
    stopped = following(vector, at_rest_after(now, motion))
    return PlannedMotion(stopped, now, now + motion.duration)


def plan_target(
    target: Target, vector: np.ndarray, now: float, config: ControllerConfig
) -> PlannedMotion:
    """Return a reference that is `vector` until `now` [s], then goes to a target.

    It joins the target's line when it is due, or as soon as the limits allow. Positions
    a little past the limits, as of a leader with a larger range, and velocities are reduced
    to them.

    Raises:
        TrajectoryError: it is not valid, ruckig is not installed, or the motion would leave the
            position limits.
    """
    n = len(config.joints)
    counts = len(target.positions), len(target.velocities)
    if counts not in ((n, n), (n, 0)):
        given = '{} positions and {} velocities'.format(*counts)
        raise TrajectoryError([f'it has {given} for {n} joints'])
    if not np.isfinite((*target.positions, *target.velocities)).all():
        raise TrajectoryError(['its values are not all finite'])
    _check_units(target, config)
    try:
        return _plan_line(target, vector, now, config)
    except MotionError as error:
        raise TrajectoryError([str(error)]) from error


class _Pursuit(NamedTuple):
    """Begin and end of a motion from the present state onto a moving target."""

    present: np.ndarray  # position, velocity, acceleration (3, n) of the reference now
    q: np.ndarray  # (n,) rad, of the target when it is due
    dq: np.ndarray  # (n,) rad/s, of the target, constant
    due: float  # s
    now: float  # s
    lead: float  # s from now, after which the motion should have joined the target

    def target_in(self, duration: float) -> np.ndarray:
        """Return position and velocity (2, n) of the target in a duration [s]."""
        t = self.now + duration
        return np.stack((self.q + (t - self.due) * self.dq, self.dq))


def _plan_line(
    target: Target, vector: np.ndarray, now: float, config: ControllerConfig
) -> PlannedMotion:
    """Return `plan_target` of a valid target; raises MotionError."""
    if not target.velocities:
        return _plan_rest(target, vector, now, config)
    q, dq = _within_limits(target, config)
    lead = max(target.due - now, _SOONEST)
    pursuit = _Pursuit(state_at(vector, now), q, dq, target.due, now, lead)
    join = _joined(pursuit, config)
    parts = [join]
    coast = target.until - now - join.duration
    is_late = coast < 0.0 and bool(np.any(dq))
    if coast > 0.0:
        parts.append(_straight(join.end, coast))
    elif is_late:  # it would go on beyond the last target to join its line
        parts = [_first(join, max(target.until - now, _SOONEST))]
    if target.held or is_late:
        parts.append(profile(parts[-1].end, config, np.stack((q, np.zeros_like(q)))))
    else:
        parts.append(braking(parts[-1].end, config))
    term = at_rest_after(now, *parts)
    end = now + sum(part.duration for part in parts)
    _check_positions(term, now, end, config)
    return PlannedMotion(following(vector, term), now + join.duration, end)


def _plan_rest(
    target: Target, vector: np.ndarray, now: float, config: ControllerConfig
) -> PlannedMotion:
    """Return `plan_target` to rest: smoothly in time if the limits allow, else the fastest."""
    limits = config.limits
    q = np.clip(target.positions, limits.position_lower, limits.position_upper)
    present = state_at(vector, now)
    end = np.stack((q, np.zeros_like(q), np.zeros_like(q)))
    motion = quintic(present, end, max(target.due - now, _SOONEST))
    if not keeps_limits(motion, config):
        motion = profile(present, config, end[:2])
    term = at_rest_after(now, motion)
    rests = now + motion.duration
    _check_positions(term, now, rests, config)
    return PlannedMotion(following(vector, term), rests, rests)


def _check_units(target: Target, config: ControllerConfig) -> None:
    """Raise TrajectoryError for positions so far past the limits that they are in other units."""
    limits = config.limits
    lower, upper = np.array((limits.position_lower, limits.position_upper))
    q = np.array(target.positions)
    past = np.maximum(lower - q, q - upper)
    for i in np.flatnonzero(past > _OTHER_UNITS * (upper - lower)):
        unit = config.units[i].position
        problem = (
            f'joint {config.joints[i]!r} is sent to {q[i]:g} {unit}, far outside its range of '
            f'{lower[i]:g} to {upper[i]:g} {unit}: are they in degrees, or in parts of a range?'
        )
        raise TrajectoryError([problem])


def _within_limits(
    target: Target, config: ControllerConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Return position and velocity (n,) of a target after which the arm can stop.

    From v it stops, at acceleration a and jerk j, within v (v/a + a/j)/2, after it has
    followed the line for a while.
    """
    limits = config.limits
    lower, upper = np.array((limits.position_lower, limits.position_upper))
    fastest = np.array(limits.velocity) * _ROUNDING
    a = np.array(limits.acceleration)
    q = np.clip(target.positions, lower, upper)
    dq = np.clip(target.velocities, -fastest, fastest)
    room = np.where(dq > 0.0, upper - q, q - lower)
    delay = 0.5 * a / np.array(limits.jerk) + target.until - target.due
    most = a * (np.sqrt(delay * delay + 2.0 * room / a) - delay)
    return q, np.clip(dq, -most, most)


def _joined(pursuit: _Pursuit, config: ControllerConfig) -> Pieces:
    """Return the motion onto a moving target.

    If the smoothest one exceeds a limit, it is the fastest one of limited jerk,
    relative to the target.
    """
    free = np.full((1, pursuit.present.shape[1]), nan)
    for factor in _SMOOTH_LEADS:
        duration = factor * pursuit.lead
        if duration > max(pursuit.lead, _LONGEST_SMOOTH):
            break
        end = np.concatenate((pursuit.target_in(duration), free))
        smooth = quintic(pursuit.present, end, duration)
        if keeps_limits(smooth, config):
            return smooth
    return _caught_up(pursuit, config)


def _caught_up(pursuit: _Pursuit, config: ControllerConfig) -> Pieces:
    """Return the fastest motion of limited jerk onto a moving target.

    It is found relative to the target. One that is as fast as the arm may be can not be
    caught up with: the motion then ends where the target was a while before.
    """
    lead = pursuit.lead
    begin = pursuit.target_in(0.0)
    behind = pursuit.present.copy()
    behind[:2] -= begin
    try:
        motion = profile(behind, config, np.zeros_like(begin), lead, drift=begin[1])
    except MotionError:
        for _ in range(_CHASES):
            motion = profile(pursuit.present, config, pursuit.target_in(lead), lead)
            if motion.duration <= lead * (1.0 + _LATE):
                break
            lead = motion.duration
        return motion
    elapsed = (np.cumsum(motion.durations) - motion.durations)[:, np.newaxis]
    motion.coefficients[:, :, 0] += begin[0] + elapsed * begin[1]
    motion.coefficients[:, :, 1] += begin[1]
    return motion


def _first(motion: Pieces, duration: float) -> Pieces:
    """Return the part of a motion until a time [s] after its begin."""
    begins = np.cumsum(motion.durations) - motion.durations
    kept = begins < duration
    ends = np.append(begins[1:], motion.duration)
    durations = np.minimum(ends, duration) - begins
    return Pieces(durations[kept], motion.coefficients[kept])


def _straight(begin: np.ndarray, duration: float) -> Pieces:
    """Return a motion at the constant velocity of a state (3, n)."""
    coefficients = np.zeros((1, begin.shape[1], 6))
    coefficients[0, :, :2] = begin[:2].T
    return Pieces(np.array([duration]), coefficients)


def keeps_limits(
    motion: Pieces, config: ControllerConfig, *, with_jerk: bool = True
) -> bool:
    """Whether a motion of one piece keeps velocity, acceleration and jerk limits."""
    limits = config.limits
    largest = [limits.velocity, limits.acceleration]
    if with_jerk:
        largest.append(limits.jerk)
    c = motion.coefficients[0].T
    turning = turning_times(at_rest_after(0.0, motion), c.shape[1])
    inside = turning[(turning > 0.0) & (turning < motion.duration)]
    x = np.concatenate((np.linspace(0.0, motion.duration, _CHECKS), inside))
    for limit in largest:
        c = c[1:] * np.arange(1.0, len(c))[:, np.newaxis]  # the derivative
        values = np.polynomial.polynomial.polyval(x, c)
        if np.any(np.abs(values) > np.array(limit)[:, np.newaxis]):
            return False
    return True


def _check_positions(
    term: Term, begin: float, end: float, config: ControllerConfig
) -> None:
    """Raise MotionError if a motion goes further past the limits than it begins."""
    lower, upper = np.array(
        (config.limits.position_lower, config.limits.position_upper)
    )
    times = check_times(begin, end)
    q = sampled(pack(lower.size, [term]), times)[:, 0]
    past = np.maximum(q - upper, lower - q)
    allowed = np.maximum(past[0], 0.0) + _PAST
    if np.any(past > allowed):
        at, i = np.unravel_index(np.argmax(past - allowed), past.shape)
        unit = config.units[i].position
        raise MotionError(
            f'joint {config.joints[i]!r} would be at {q[at, i]:.6g} {unit} at '
            f't = {times[at]:.6g} s, and its limits are {lower[i]:g} to {upper[i]:g} {unit}: '
            'send targets that leave it room to stop'
        )
