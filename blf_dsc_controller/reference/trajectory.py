# SPDX-License-Identifier: Apache-2.0
"""A trajectory that replaces the present reference at run time.

It is interpolated as by joint_trajectory_controller, except where that would jump:

    positions, velocities, accelerations   quintic from point to point
    positions, velocities                  cubic from point to point
    positions only                         minimum jerk through all points, at rest at the last one

(That controller joins bare positions by straight lines, so the velocity jumps at each
point.)  The motion to the first point starts from the position, velocity and
acceleration of the reference when the trajectory begins, and brakes while it sets out
from where the braking ends, so that a long time to that point does not make the arm
swing away; if the first point is at that very time, the trajectory is blended into the
present reference as fast as the limits allow.  Points in the past are skipped.  The
last point is held, or the reference brakes after it if it has a velocity.

What would exceed the limits takes longer: a path that is too fast is stretched, a
single point is reached as soon as possible, and a path whose first points are too close
to reach in time is joined later. Continuous joints go the short way (`turns`). To bound
the time of planning, a trajectory longer than `LONGEST` or with more than `MOST_POINTS`
is rejected.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.reference.approach import (
    POSITIONS,
    MotionError,
    Violation,
    blend,
    braking_time,
    check_times,
    positions_past_limits,
    worst_violation,
)
from blf_dsc_controller.reference.retargeting import (
    Pieces,
    PlannedMotion,
    TrajectoryError,
    at_rest_after,
    braking,
    keeps_limits,
    profile,
    quintic,
    shifted,
)
from blf_dsc_controller.reference.terms import (
    SPLINE,
    Term,
    cubics,
    ending_at_rest,
    hermite,
    minimum_jerk,
    pack,
    pieces_of,
    quintics,
    sampled,
    spline_term,
    turning_times,
    unpack,
)
from blf_dsc_controller.reference.turns import short_way

MOST_POINTS = 10_000
LONGEST = 3600.0
"""Longest time [s] from the beginning of a trajectory to its last point."""

_SMOOTH = 0.2  # s of braking at least, since the acceleration ends, too
_BELOW = 0.999  # of the velocity limit, for a path that is stretched
_CLOSE = 1e-3  # s between two checks of a blend
_SHORTEST_LEAD = 0.02  # s to a path that is joined late, at first ...
_LEAD_GROWTH = 1.25  # ... and from attempt to attempt
_STRETCHES = 8  # attempts to slow a path down ...
_MARGIN = 1.0 + 1e-6  # ... to just below the limits
_ATTEMPTS = 5  # at braking, from the gentle time to all the time there is
_FIELDS = ('positions', 'velocities', 'accelerations')


class TrajectoryPoint(NamedTuple):
    """A point of a trajectory; unspecified fields are empty."""

    time: float  # s, since the trajectory's beginning
    positions: tuple[float, ...]  # rad
    velocities: tuple[float, ...] = ()  # rad/s
    accelerations: tuple[float, ...] = ()  # rad/s^2
    effort: tuple[float, ...] = ()  # N m


class Trajectory(NamedTuple):
    """A trajectory as received; its values are in the order of its own joints."""

    joints: tuple[str, ...]
    points: tuple[TrajectoryPoint, ...]
    begin: float | None = None  # s since the start of the controller; None: at once


def plan_trajectory(
    trajectory: Trajectory, vector: np.ndarray, now: float, config: ControllerConfig
) -> PlannedMotion:
    """Return a reference that is `vector` until `now` [s], then the trajectory.

    It holds all of `vector` that has an effect before, at any earlier time: `now` may
    lie ahead, where a reference is in force that has not begun yet. `remaining` removes
    what is past.

    Raises:
        TrajectoryError: it is not valid, too late, or leaves the position limits.
    """
    problems = trajectory_problems(trajectory, config.joints, now)
    if problems:
        raise TrajectoryError(problems)
    begin = now if trajectory.begin is None else trajectory.begin
    t0 = max(now, begin)
    times, points = _remaining_points(trajectory, config.joints, begin, t0)
    terms = unpack(vector)
    # the first is in force even if it begins just now, as a stop of this sample does
    before = [term for term in terms if term.begin < t0] or terms[:1]
    present = sampled(pack(len(config.joints), before), np.array([t0]))[0, 0]
    points[0], turned = short_way(points[0], present, config)
    first = 1 + len(trajectory.points) - len(times)
    past = positions_past_limits(points[0], first, config)
    if past:
        raise TrajectoryError([f'{past}; reduce the motion, or relax {POSITIONS}'])
    motion = _planned(before, now, t0, times, points, config)
    return motion._replace(turned=turned)


def _planned(
    before: list[Term],
    now: float,
    t0: float,
    times: np.ndarray,
    points: np.ndarray,
    config: ControllerConfig,
) -> PlannedMotion:
    """Return the motion in time, or else as soon as possible; TrajectoryError without."""
    try:
        return _in_time(before, now, t0, times, points, config)
    except MotionError as error:
        found = error.violation
        if found is None or found.quantity == 'position':
            raise TrajectoryError([str(error)]) from error
        try:
            return _as_soon_as_possible(before, t0, times, points, config)
        except MotionError as second:
            raise TrajectoryError([f'{error}; {second}']) from second


def _in_time(
    before: list[Term],
    now: float,
    t0: float,
    times: np.ndarray,
    points: np.ndarray,
    config: ControllerConfig,
) -> PlannedMotion:
    """Return the motion that passes the points in time; MotionError past a limit."""
    n = len(config.joints)
    end = float(times[-1])
    if times[0] > t0:
        present = sampled(pack(n, before), np.array([t0]))[0]
        term = _from_state(present, t0, times, points, config)
        blended = max((each.settled for each in before if each.fade > 0.0), default=now)
        motion = PlannedMotion(pack(n, [*before, term]), min(blended, t0), end)
    else:
        term = _braked(_through_points(times, points), points, config)
        motion = PlannedMotion(*blend(before, term, t0, config), end)
    _check(motion.vector, term, t0, config)
    if motion.settled > t0:  # a blend between two motions is nowhere a polynomial
        closely = _times_of_blend(motion, t0, n)
        _raise_found(worst_violation(motion.vector, closely, config))
    return motion


def _times_of_blend(motion: PlannedMotion, t0: float, n: int) -> np.ndarray:
    """Return times [s] close to each other, and those at which a blended jerk jumps."""
    times = [np.arange(t0, motion.settled, _CLOSE)]
    times += [
        turning_times(term, n) for term in unpack(motion.vector) if term.code == SPLINE
    ]
    joined = np.concatenate(times)
    return joined[(joined >= t0) & (joined < motion.settled)]


def _check(
    vector: np.ndarray, term: Term, begin: float, config: ControllerConfig
) -> None:
    """Raise MotionError if a packed reference that ends with a term exceeds a limit."""
    knots, _ = pieces_of(term, len(config.joints))
    span = _times_to_check(term, begin, float(knots[-1]), len(config.joints))
    _raise_found(worst_violation(vector, span, config))


def _raise_found(found: Violation | None) -> None:
    """Raise MotionError if a violation has been found."""
    if found is not None:
        message = f'{found}; reduce the motion, or relax {found.parameters}'
        raise MotionError(message, found)


def _as_soon_as_possible(
    before: list[Term],
    t0: float,
    times: np.ndarray,
    points: np.ndarray,
    config: ControllerConfig,
) -> PlannedMotion:
    """Return the fastest motion along the path within the limits."""
    n = len(config.joints)
    present = sampled(pack(n, before), np.array([t0]))[0]
    try:
        stretched = times
        path = _moving_chunk(times, points, config)
    except MotionError:
        stretched, path = _stretched(t0, times, points, config)
    lead = max(float(stretched[0]) - t0, _SHORTEST_LEAD)
    joined = None
    while joined is None and t0 + lead < stretched[-1]:
        target = sampled(pack(n, [path]), np.array([t0 + lead]))[0]
        way = quintic(present, target, lead)
        if keeps_limits(way, config, with_jerk=False):
            joined = _from(path, t0 + lead, n)
        else:
            lead *= _LEAD_GROWTH
    if joined is None:
        goal = np.zeros((2, n))
        goal[: len(points)] = points[:2, -1]
        way = profile(present, config, goal)
        joined = braking(way.end, config)
    term = at_rest_after(t0, way, joined)
    _check(pack(n, [term]), term, t0, config)
    arrival = t0 + way.duration
    end = max(float(stretched[-1]), arrival)
    late = end - float(times[-1])
    note = f'as fast as the limits allow: its end is {late:.3g} s later than asked for'
    if late <= 0.0:
        note = f'its path is joined after {way.duration:.3g} s, as soon as the limits allow'
    return PlannedMotion(pack(n, [*before, term]), arrival, end, note)


def _moving_chunk(
    times: np.ndarray, points: np.ndarray, config: ControllerConfig
) -> Term:
    """Return the path through positions of an arm that moves at both ends.

    It returns to the last one afterwards. MotionError if that exceeds a limit.
    """
    if len(points) > 1 or len(times) == 1:
        raise MotionError('there are velocities, or there is a single point')
    n = points.shape[2]
    rises = np.diff(points[0], axis=0) / np.diff(times)[:, np.newaxis]
    still = np.zeros(n)
    first = np.stack((rises[0], still))
    last = np.stack((rises[-1], still))
    knots, coefficients = pieces_of(minimum_jerk(times, points[0], first, last), n)
    goal = np.stack((points[0, -1], still))
    back = profile(np.vstack((points[0, -1:], last)), config, goal)
    path = ending_at_rest(
        np.append(knots, knots[-1] + np.cumsum(back.durations)),
        np.concatenate((coefficients[:-1], back.coefficients)),
        back.end[0],
    )
    _check(pack(n, [path]), path, float(times[0]), config)
    return path


def _stretched(
    t0: float, times: np.ndarray, points: np.ndarray, config: ControllerConfig
) -> tuple[np.ndarray, Term]:
    """Return times and path of the points, slowed down to keep the limits."""
    n = len(config.joints)
    # between the times checked here and those checked at the end, velocities may be
    # higher
    velocity = tuple(_BELOW * each for each in config.limits.velocity)
    within = replace(config, limits=replace(config.limits, velocity=velocity))
    factor = 1.0
    for _ in range(_STRETCHES):
        slower = t0 + factor * (times - t0)
        powers = np.arange(float(len(points)))[:, np.newaxis, np.newaxis]
        scaled = points / factor**powers
        path = _through_points(slower, scaled)
        span = _times_to_check(path, float(slower[0]), float(slower[-1]), n)
        found = worst_violation(pack(n, [path]), span, within)
        if found is None or found.quantity == 'position':
            break
        root = 1.0 if found.quantity == 'velocity' else 0.5
        factor *= found.ratio**root * _MARGIN
    _raise_found(found)
    return slower, _braked(path, scaled, config)


def _from(path: Term, t: float, n: int) -> Pieces:
    """Return the pieces of a spline from a time [s] on, until it rests."""
    knots, coefficients = pieces_of(path, n)
    first = max(int(np.searchsorted(knots, t, 'right')) - 1, 0)
    coefficients = coefficients[first:-1].copy()
    coefficients[0] = shifted(coefficients[0], t - float(knots[first]))
    return Pieces(np.diff(np.append(t, knots[first + 1 :])), coefficients)


def _braked(term: Term, points: np.ndarray, config: ControllerConfig) -> Term:
    """Return a spline through points; it brakes after a last one with velocity."""
    if len(points) == 1 or not np.any(points[1, -1]):
        return term
    n = len(config.joints)
    knots, coefficients = pieces_of(term, n)
    state = np.zeros((3, n))
    state[: len(points)] = points[:, -1]
    if len(knots) > 1:
        before = Pieces(np.diff(knots)[-1:], coefficients[-2:-1])
        state[2] = before.end[2]
    brake = braking(state, config)
    until = float(knots[-1]) + np.cumsum(brake.durations)
    return ending_at_rest(
        np.append(knots, until),
        np.concatenate((coefficients[:-1], brake.coefficients)),
        brake.end[0],
    )._replace(begin=term.begin)


def _times_to_check(term: Term, begin: float, end: float, n: int) -> np.ndarray:
    """Return times [s] of extremes of its acceleration, and nearly its velocity."""
    turning = turning_times(term, n)
    inside = (turning >= begin) & (turning < end)
    return np.concatenate((check_times(begin, end), turning[inside]))


def _remaining_points(
    trajectory: Trajectory, joints: tuple[str, ...], begin: float, t0: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return times (k,) [s] and fields (1 to 3, k, n) of points from t0 on."""
    order = [trajectory.joints.index(joint) for joint in joints]
    times = np.array([begin + point.time for point in trajectory.points])
    given = [
        [[values[i] for i in order] for values in point[1:4] if values]
        for point in trajectory.points
    ]
    points = np.array(given, dtype=np.float64).transpose(1, 0, 2)
    remaining = times >= t0
    return times[remaining], points[:, remaining]


def _through_points(times: np.ndarray, points: np.ndarray) -> Term:
    """Return a term through points (1 to 3, k, n) that holds at both ends."""
    if len(points) == 1:
        return minimum_jerk(times, points[0])
    if len(points) == 3:
        return hermite(times, points)
    pieces = cubics(np.diff(times), points[:, :-1], points[:, 1:])
    return ending_at_rest(times, pieces, points[0, -1])


def _from_state(
    present: np.ndarray,
    t0: float,
    times: np.ndarray,
    points: np.ndarray,
    config: ControllerConfig,
) -> Term:
    """Return a term from the present qr, dqr, ddqr (3, n) at t0 [s] through the points.

    It brakes gently (`braking_time`), but within the time to the first point; as gently
    as possible if the limits cannot be kept otherwise.
    """
    longest = float(times[0]) - t0
    if len(points) == 1 and longest <= _SMOOTH:
        knots = np.concatenate(([t0], times))
        passed = np.concatenate((present[:1], points[0]))
        return minimum_jerk(knots, passed, present[1:])._replace(begin=t0)
    shortest = min(max(_SMOOTH, braking_time(present[1], config)), longest)
    n = present.shape[1]
    for h in np.geomspace(shortest, longest, _ATTEMPTS):
        term = _braking(present, t0, times, points, min(float(h), longest))
        term = _braked(term, points, config)
        span = _times_to_check(term, t0, float(times[-1]), n)
        if worst_violation(pack(n, [term]), span, config) is None:
            break
    return term


def _braking(
    present: np.ndarray, t0: float, times: np.ndarray, points: np.ndarray, h: float
) -> Term:
    """Return a term through the points that brakes within h [s].

    One leaves from rest at the position where the braking ends, the other brakes to
    there: its velocity is the cubic from dqr to 0 with the slopes ddqr and 0.
    """
    n = present.shape[1]
    rest = np.zeros((3, n))
    rest[0] = present[0] + h * present[1] / 2.0 + h * h * present[2] / 12.0
    path = _from_rest(rest, t0, times, points)
    at = np.array([t0 + h, times[0]])
    if at[0] >= at[1]:
        at = at[1:]
    through = sampled(pack(n, [path]), at).transpose(1, 0, 2)
    if len(points) > 1:
        through[: len(points), -1] = points[:, 0]
    both = np.concatenate((present[:, np.newaxis], through), axis=1)
    knots = np.concatenate(([t0], at))
    lead = quintics(np.diff(knots), both[:, :-1], both[:, 1:])
    after, coefficients = pieces_of(path, n)
    return spline_term(
        np.concatenate((knots[:-1], after[1:])),
        np.concatenate((lead, coefficients[1:])),
    )._replace(begin=t0)


def _from_rest(
    rest: np.ndarray, t0: float, times: np.ndarray, points: np.ndarray
) -> Term:
    """Return a term from rest (3, n) at t0 [s] through the points."""
    knots = np.concatenate(([t0], times))
    path = _through_points(
        knots, np.concatenate((rest[: len(points), np.newaxis], points), axis=1)
    )
    if len(points) != 2:
        return path
    _, pieces = pieces_of(path, rest.shape[1])
    arrival = np.stack((*points[:, 0], 2.0 * pieces[1, :, 2]))[:, np.newaxis]
    first = quintics(knots[1:2] - t0, rest[:, np.newaxis], arrival)
    return spline_term(knots, np.concatenate((first, pieces[1:])))


def trajectory_problems(
    trajectory: Trajectory, joints: tuple[str, ...], now: float
) -> list[str]:
    """Return all problems of a trajectory that show before it is planned."""
    points, problems = trajectory.points, []
    if len(points) > MOST_POINTS:
        return [
            f'it has {len(points)} points, more than {MOST_POINTS}: send it in pieces'
        ]
    if sorted(trajectory.joints) != sorted(joints):
        given, needed = (
            ', '.join(map(repr, names)) for names in (trajectory.joints, joints)
        )
        problems.append(
            f'its joints are {given or "none"}, but each of {needed} is needed once'
        )
    if not points:
        problems.append('it has no points')
    for number, point in enumerate(points, start=1):
        found = _problems_of(point, len(trajectory.joints))
        problems += [f'point {number} has {problem}' for problem in found]
    if len({tuple(map(bool, point[1:4])) for point in points}) > 1:
        problems.append(
            'its points do not all give the same fields among ' + ', '.join(_FIELDS)
        )
    return problems or list(_time_problems(trajectory, now))


def _problems_of(point: TrajectoryPoint, count: int) -> Iterator[str]:
    if point.effort:
        yield 'an effort, which is not supported: leave effort empty'
    if not point.positions:
        yield 'no positions'
    if point.accelerations and not point.velocities:
        yield 'accelerations, but no velocities'
    if not np.isfinite(point.time):
        yield f'no finite time: {point.time}'
    for field, values in zip(_FIELDS, point[1:4], strict=True):
        if values and not (len(values) == count and np.isfinite(values).all()):
            yield f'{field} {list(values)}, but {count} finite numbers are needed'


def _time_problems(trajectory: Trajectory, now: float) -> Iterator[str]:
    points = trajectory.points
    if points[-1].time > LONGEST:
        yield f'it takes {points[-1].time:g} s, longer than {LONGEST:g} s: send it in pieces'
    if points[0].time < 0.0:
        yield f'point 1 is {-points[0].time:g} s before the beginning'
    for number, (before, after) in enumerate(pairwise(points), start=2):
        if after.time <= before.time:
            yield (
                f'point {number} is at {after.time:g} s, not after the one before it, '
                f'at {before.time:g} s'
            )
    begin = now if trajectory.begin is None else trajectory.begin
    if not begin <= now + LONGEST:
        yield f'it begins at {begin:g} s since the start, more than {LONGEST:g} s from now'
    elif begin + points[-1].time < now:
        yield (
            f'it lies entirely in the past: it ended {now - begin - points[-1].time:.6g} s ago; '
            'stamp it with its start time, or with 0 to start immediately'
        )
