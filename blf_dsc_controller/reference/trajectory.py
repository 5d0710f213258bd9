# SPDX-License-Identifier: Apache-2.0
"""A trajectory that is sent while the controller runs, in place of the reference there is.

Read as joint_trajectory_controller reads it, but for what would jump:

    positions, velocities, accelerations   quintic from point to point
    positions, velocities                  cubic from point to point
    positions alone                        least jerk through all points, at rest at the last one

(There, positions alone are joined by straight lines, whose velocity jumps at each point.)  The way
to the first point leads on from the position, velocity and acceleration that the reference has at
the trajectory's beginning.  If the first point is at the beginning itself, the trajectory is mixed
into what there is, as fast as the limits allow.  Points whose time is over are passed over.  The
last point is held.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blf_dsc_controller.reference.errors import MotionError, TrajectoryError
from blf_dsc_controller.reference.limits import excess, looks
from blf_dsc_controller.reference.polynomials import (
    cubics,
    ending_at_rest,
    hermite,
    minimum_jerk,
    quintics,
)
from blf_dsc_controller.reference.splice import Motion, Rules, splice
from blf_dsc_controller.reference.terms import Term, pack, sampled, unpack
from blf_dsc_controller.reference.validation import Complaints


class Point(NamedTuple):
    """A point of a trajectory; what is empty is not given."""

    time: float  # since the trajectory's beginning, s
    positions: tuple[float, ...]  # rad
    velocities: tuple[float, ...] = ()  # rad/s
    accelerations: tuple[float, ...] = ()  # rad/s^2
    effort: tuple[float, ...] = ()  # N m


class Request(NamedTuple):
    """A trajectory as it was sent; its values are in the order of its own joints."""

    joints: tuple[str, ...]
    points: tuple[Point, ...]
    begin: float | None = None  # s since the start of the controller; None: at once


def follow(request: Request, vector: np.ndarray, now: float, rules: Rules) -> Motion:
    """Reference that goes on along the present one and, from its beginning on, the request.

    Args:
        request: trajectory to follow.
        vector: packed reference in force.
        now: time of the last sample [s].
        rules: limits, and how long a mixture may take.

    Returns:
        The reference, and when no mixture of several is left in it.

    Raises:
        TrajectoryError: it makes no sense, comes too late, or goes past a limit.
    """
    Complaints(request, rules.limits.joints).check(now)
    t0 = now if request.begin is None else max(now, request.begin)
    begin = now if request.begin is None else request.begin
    times, points = _sorted(request, rules.limits.joints, begin, t0)
    before = _still_needed(vector, now, t0)
    try:
        if times[0] > t0:
            present = sampled(pack(points.shape[2], before), np.array([t0]))[0]
            term = _from(present, t0, times, points)._replace(begin=t0)
            mixed = max((one.settled for one in before if one.fade > 0.0), default=now)
            motion = Motion(pack(points.shape[2], [*before, term]), min(mixed, t0))
        else:
            motion = splice(before, _through(times, points), t0, rules)
    except MotionError as error:
        raise TrajectoryError([str(error)]) from error
    end = max(float(times[-1]), motion.settled)
    too_much = excess(motion.vector, looks(t0, end), rules.limits)
    if too_much is not None:
        raise TrajectoryError([f'{too_much}; ask for less, or raise {too_much.remedy}'])
    return motion


def _sorted(
    request: Request, joints: tuple[str, ...], begin: float, t0: float
) -> tuple[np.ndarray, np.ndarray]:
    """Times (k,) [s] and what is given (1 to 3, k, n) of the points to come, in our order."""
    order = [request.joints.index(joint) for joint in joints]
    times = np.array([begin + point.time for point in request.points])
    given = [
        np.array([field[i] for i in order])
        for point in request.points
        for field in (point.positions, point.velocities, point.accelerations)
        if field
    ]
    points = np.reshape(given, (times.size, -1, len(joints))).transpose(1, 0, 2)
    to_come = times >= t0
    return times[to_come], points[:, to_come]


def _still_needed(vector: np.ndarray, now: float, t0: float) -> list[Term]:
    """Terms of the reference that can be seen from now on until t0 [s]."""
    terms = [term for term in unpack(vector) if term.begin < t0]
    in_force = max((k for k, term in enumerate(terms) if term.settled <= now), default=0)
    return terms[in_force:]


def _through(times: np.ndarray, points: np.ndarray) -> Term:
    """Term through the points (1 to 3, k, n), held before the first and after the last."""
    if len(points) == 1:
        return minimum_jerk(times, points[0])
    if len(points) == 3:
        return hermite(times, points)
    pieces = cubics(np.diff(times), points[:, :-1], points[:, 1:])
    return ending_at_rest(times, pieces, points[0, -1])


def _from(present: np.ndarray, t0: float, times: np.ndarray, points: np.ndarray) -> Term:
    """Term from the present qr, dqr, ddqr (3, n) at t0 [s] through the points."""
    knots = np.concatenate(([t0], times))
    if len(points) == 1:
        return minimum_jerk(knots, np.vstack((present[:1], points[0])), present[1:])
    if len(points) == 3:
        return hermite(knots, np.concatenate((present[:, np.newaxis], points), axis=1))
    pieces = cubics(np.diff(times), points[:, :-1], points[:, 1:])
    arrival = np.zeros((3, 1, points.shape[2]))
    arrival[:2] = points[:, :1]
    if len(pieces):
        arrival[2, 0] = 2.0 * pieces[0, :, 2]
    first = quintics(knots[1:2] - t0, present[:, np.newaxis], arrival)
    return ending_at_rest(knots, np.concatenate((first, pieces)), points[0, -1])
