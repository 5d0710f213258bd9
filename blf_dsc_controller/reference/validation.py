# SPDX-License-Identifier: Apache-2.0
"""What can be wrong with a trajectory before its motion is looked at."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from blf_dsc_controller.reference.errors import TrajectoryError

if TYPE_CHECKING:
    from blf_dsc_controller.reference.trajectory import Point, Request

_FIELDS = ('positions', 'velocities', 'accelerations')


class Complaints:
    """Judges a request.

    Args:
        request: trajectory to judge.
        joints: joints of the controller.
    """

    def __init__(self, request: Request, joints: tuple[str, ...]) -> None:
        self._request = request
        self._joints = joints

    def check(self, now: float) -> None:
        """Raise TrajectoryError with all that is wrong with the request at the time now [s]."""
        complaints = [*self._of_joints(), *self._of_points()]
        if not complaints:
            complaints = [*self._of_times(now), *self._of_the_end()]
        if complaints:
            raise TrajectoryError(complaints)

    def _of_joints(self) -> Iterator[str]:
        named, ours = self._request.joints, self._joints
        unknown = sorted(set(named) - set(ours))
        missing = [joint for joint in ours if joint not in named]
        repeated = sorted({joint for joint in named if named.count(joint) > 1})
        if unknown:
            yield f'there is no joint {_listed(unknown)} here, only {_listed(ours)}'
        if missing:
            yield f'it says nothing of joint {_listed(missing)}: name all of {_listed(ours)}'
        if repeated:
            yield f'joint {_listed(repeated)} is named more than once'

    def _of_points(self) -> Iterator[str]:
        points = self._request.points
        if not points:
            yield 'it has no points'
            return
        for number, point in enumerate(points, start=1):
            yield from self._of_point(f'point {number}', point)
        if len({_given(point) for point in points}) > 1:
            yield 'its points do not all give the same of ' + ', '.join(_FIELDS)

    def _of_point(self, name: str, point: Point) -> Iterator[str]:
        count = len(self._request.joints)
        if point.effort:
            yield f'{name} asks for an effort, which is not followed here: leave effort empty'
        if not point.positions:
            yield f'{name} has no positions'
        if point.accelerations and not point.velocities:
            yield f'{name} has accelerations, but no velocities'
        if not np.isfinite(point.time):
            yield f'{name} has no finite time: {point.time}'
        for field in _FIELDS:
            values = getattr(point, field)
            if values and len(values) != count:
                yield f'{name} has {len(values)} {field} for {count} joints'
            elif not np.isfinite(values).all():
                yield f'{name} has {field} that are not finite: {list(values)}'

    def _of_times(self, now: float) -> Iterator[str]:
        points = self._request.points
        if points[0].time < 0.0:
            yield f'point 1 is {-points[0].time:g} s before the beginning'
        for number, (before, after) in enumerate(pairwise(points), start=2):
            if after.time <= before.time:
                yield (
                    f'point {number} is at {after.time:g} s, not after the one before it, '
                    f'at {before.time:g} s'
                )
        begin = self._request.begin
        if begin is not None and begin + points[-1].time < now:
            yield (
                f'all of it lies in the past: it ends {now - begin - points[-1].time:.6g} s ago; '
                'stamp it with the time it is to begin, or with 0 for at once'
            )

    def _of_the_end(self) -> Iterator[str]:
        last = self._request.points[-1].velocities
        for joint, velocity in zip(self._request.joints, last, strict=False):
            if velocity != 0.0:
                yield (
                    f'it ends with {joint} at {velocity:g} rad/s, but the last point is held: '
                    'end with velocity 0'
                )


def _given(point: Point) -> tuple[bool, ...]:
    return tuple(bool(getattr(point, field)) for field in _FIELDS)


def _listed(names: list[str] | tuple[str, ...]) -> str:
    return ', '.join(repr(name) for name in names)
