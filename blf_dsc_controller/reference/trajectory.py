# SPDX-License-Identifier: Apache-2.0
"""A trajectory that is sent while the controller runs and replaces the present reference.

It is interpolated as by joint_trajectory_controller, except where that would jump:

    positions, velocities, accelerations   quintic from point to point
    positions, velocities                  cubic from point to point
    positions only                         minimum jerk through all points, at rest at the last one

(That controller joins bare positions by straight lines, so the velocity jumps at each point.)  The
motion to the first point starts from the position, velocity and acceleration of the reference when
the trajectory begins, and brakes while it sets out from where the braking ends, so that a long time
to that point does not make the arm swing away; if the first point is at that very time, the
trajectory is blended into the present reference as fast as the limits allow.  Points in the past
are skipped.  The last point is held.  To keep planning below a second, a trajectory longer than
`LONGEST` or with more than `MOST_POINTS` is rejected.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.reference.approach import (
    BlendedReference,
    MotionError,
    blend,
    braking_time,
    check_times,
    worst_violation,
)
from blf_dsc_controller.reference.terms import (
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
    unpack,
)

MOST_POINTS = 1000
LONGEST = 3600.0
"""Longest time [s] from the beginning of a trajectory to its last point."""

_SMOOTH = 0.2  # s of braking at least, since the acceleration ends, too
_ATTEMPTS = 5  # at braking, from the gentle time to all the time there is
_FIELDS = ('positions', 'velocities', 'accelerations')


class TrajectoryError(MotionError):
    """A rejected trajectory, with all problems found."""

    def __init__(self, problems: list[str]) -> None:
        self.problems = problems
        super().__init__('trajectory rejected: ' + '; '.join(problems))


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
) -> BlendedReference:
    """Return a packed reference that continues `vector` at `now` [s], then follows the trajectory.

    Raises:
        TrajectoryError: it is not valid, too late, or violates a limit.
    """
    problems = _problems(trajectory, config.joints, now)
    if problems:
        raise TrajectoryError(problems)
    begin = now if trajectory.begin is None else trajectory.begin
    t0 = max(now, begin)
    times, points = _remaining_points(trajectory, config.joints, begin, t0)
    before = _terms_until(vector, now, t0)
    n = len(config.joints)
    try:
        if times[0] > t0:
            present = sampled(pack(n, before), np.array([t0]))[0]
            term = _from_state(present, t0, times, points, config)
            blended = max((each.settled for each in before if each.fade > 0.0), default=now)
            motion = BlendedReference(pack(n, [*before, term]), min(blended, t0))
        else:
            motion = blend(before, _through_points(times, points), t0, config)
    except MotionError as error:
        raise TrajectoryError([str(error)]) from error
    # Until it is settled, `blend` has checked the motion.
    found = worst_violation(motion.vector, check_times(t0, float(times[-1])), config)
    if found is not None:
        raise TrajectoryError([f'{found}; reduce the motion, or relax {found.parameters}'])
    return motion


def _remaining_points(
    trajectory: Trajectory, joints: tuple[str, ...], begin: float, t0: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return times (k,) [s] and fields (1 to 3, k, n) of points from t0 on, in the given order."""
    order = [trajectory.joints.index(joint) for joint in joints]
    times = np.array([begin + point.time for point in trajectory.points])
    given = [
        [[values[i] for i in order] for values in point[1:4] if values]
        for point in trajectory.points
    ]
    points = np.array(given, dtype=np.float64).transpose(1, 0, 2)
    remaining = times >= t0
    return times[remaining], points[:, remaining]


def _terms_until(vector: np.ndarray, now: float, t0: float) -> list[Term]:
    """Return the terms of the reference that have an effect from now until t0 [s]."""
    terms = [term for term in unpack(vector) if term.begin < t0]
    in_force = max((k for k, term in enumerate(terms) if term.settled <= now), default=0)
    return terms[in_force:]


def _through_points(times: np.ndarray, points: np.ndarray) -> Term:
    """Return a term through the points (1 to 3, k, n) that holds the first and the last one."""
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

    It brakes gently (`braking_time`), but within the time to the first point; as gently as possible
    if the limits cannot be kept otherwise.
    """
    longest = float(times[0]) - t0
    shortest = min(max(_SMOOTH, braking_time(present[1], config)), longest)
    span = check_times(t0, float(times[-1]))
    for h in np.geomspace(shortest, longest, _ATTEMPTS):
        term = _braking(present, t0, times, points, min(float(h), longest))
        if worst_violation(pack(present.shape[1], [term]), span, config) is None:
            break
    return term


def _braking(
    present: np.ndarray, t0: float, times: np.ndarray, points: np.ndarray, h: float
) -> Term:
    """Return a term through the points that brakes within h [s], the sum of two motions.

    One leaves from rest at the position where the braking ends, the other brakes to there: its
    velocity is the cubic from dqr to 0 with the slopes ddqr and 0.
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
        np.concatenate((knots[:-1], after[1:])), np.concatenate((lead, coefficients[1:]))
    )._replace(begin=t0)


def _from_rest(rest: np.ndarray, t0: float, times: np.ndarray, points: np.ndarray) -> Term:
    """Return a term from rest (3, n) at t0 [s] through the points, with a quintic to the first."""
    knots = np.concatenate(([t0], times))
    path = _through_points(knots, np.concatenate((rest[: len(points), np.newaxis], points), axis=1))
    if len(points) != 2:
        return path
    _, pieces = pieces_of(path, rest.shape[1])
    arrival = np.stack((*points[:, 0], 2.0 * pieces[1, :, 2]))[:, np.newaxis]
    first = quintics(knots[1:2] - t0, rest[:, np.newaxis], arrival)
    return spline_term(knots, np.concatenate((first, pieces[1:])))


def _problems(trajectory: Trajectory, joints: tuple[str, ...], now: float) -> list[str]:
    """Return all problems of a trajectory that can be found before its motion is computed."""
    points, problems = trajectory.points, []
    if len(points) > MOST_POINTS:
        return [f'it has {len(points)} points, more than {MOST_POINTS}: send it in pieces']
    if sorted(trajectory.joints) != sorted(joints):
        given, needed = (', '.join(map(repr, names)) for names in (trajectory.joints, joints))
        problems.append(f'its joints are {given or "none"}, but each of {needed} is needed once')
    if not points:
        problems.append('it has no points')
    for number, point in enumerate(points, start=1):
        found = _problems_of(point, len(trajectory.joints))
        problems += [f'point {number} has {problem}' for problem in found]
    if len({tuple(map(bool, point[1:4])) for point in points}) > 1:
        problems.append('its points do not all give the same fields among ' + ', '.join(_FIELDS))
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
    begin = trajectory.begin
    if begin is not None and begin + points[-1].time < now:
        yield (
            f'it lies entirely in the past: it ended {now - begin - points[-1].time:.6g} s ago; '
            'stamp it with its start time, or with 0 to start immediately'
        )
    for joint, velocity in zip(trajectory.joints, points[-1].velocities, strict=False):
        if velocity != 0.0:
            yield (
                f'it ends with {joint} at {velocity:g} rad/s, but the last point is held: '
                'end with velocity 0'
            )
