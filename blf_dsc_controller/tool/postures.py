# SPDX-License-Identifier: Apache-2.0
"""A bound on the error of the tool at every posture, from link lengths and axes alone.

Body j turns by w_j = sum_{i <= j} e_i z_i for small errors e_i of the revolute joints,
and the tip moves by sum_j w_j x l_j, where l_j leads from a point on axis j to one on
axis j + 1, the last one to the tip.  Both hold along any way between two postures.  So
the tip is off by at most sum_j max |w_j x l_j|, and the tool by the angle max |w_n|.

The largest component of w_j in a direction d depends only on the angle x between d and
z_j, since joint j turns everything before it about z_j:

    h_j(x) = k_j |cos x| + max h_{j-1}(y),    |x - a| <= y <= x + a

with the angle a between z_{j-1} and z_j.  It is computed on a grid, and rounded up.
|w_j x l_j| = |l_j| max h_j(x) over the directions across l_j.  The points on the axes
are free, and chosen such that the bound is small.
"""

from __future__ import annotations

from math import ceil, cos, floor, pi
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.urdf import Chain, frames

Floats = NDArray[np.float64]

_GRID = 720  # directions, over half a turn
_STEP = pi / _GRID
_UP = 1.0 / cos(0.5 * _STEP)  # of a largest component, between two directions
_SWEEPS = 60  # of the points along their axes
_NEAR = 1e-6  # m^2, below which the square of a distance pulls no more
_PARALLEL = 1e-12


class Axes(NamedTuple):
    """The r revolute axes of n joints at position 0, and what lies between them."""

    revolute: NDArray[np.bool_]  # (n,)
    origins: Floats  # (r, 3) m
    directions: Floats  # (r, 3)
    travel: Floats  # (r,) m, of prismatic joints after each
    tip: Floats  # (3,) m


def axes_of(chain: Chain, travel: Floats) -> Axes:
    """Return the axes of a chain; prismatic ones move at most `travel` (n,) [m]."""
    joints = chain.joints
    placements = frames(chain, np.zeros(len(joints)))
    revolute = np.array([joint.kind != 'prismatic' for joint in joints])
    turning = np.flatnonzero(revolute)
    of_joints = placements[1:-1]
    after = np.zeros(turning.size)
    for i in np.flatnonzero(~revolute):
        before = np.count_nonzero(turning < i)
        if before:
            after[before - 1] += travel[i]
    return Axes(
        revolute=revolute,
        origins=np.array([of_joints[i][:3, 3] for i in turning]).reshape(-1, 3),
        directions=np.array(
            [of_joints[i][:3, :3] @ joints[i].axis for i in turning]
        ).reshape(-1, 3),
        travel=after,
        tip=np.array(placements[-1][:3, 3]),
    )


def ways_to_tip(axes: Axes) -> Floats:
    """Return the largest distance (n,) [m] of the tip from each revolute axis, at most.

    0 for prismatic joints.
    """
    even = np.ones(len(axes.travel))
    steps = np.linalg.norm(_steps(axes, even), axis=1) + axes.travel
    found = np.zeros(axes.revolute.size)
    found[axes.revolute] = np.cumsum(steps[::-1])[::-1]
    return found


def over_all_postures(axes: Axes, k: Floats) -> Floats:
    """Return bounds (2,) [m, rad] for joint bounds k (n,) [rad, m]."""
    slid = float(k[~axes.revolute].sum())
    components = _components(axes, k[axes.revolute])
    if not components:
        return np.array([slid, 0.0])
    largest = np.array([float(each.max()) for each in components])
    position = slid + float((largest * axes.travel).sum())
    for h, l, z in zip(components, _steps(axes, largest), axes.directions, strict=True):
        length = float(np.linalg.norm(l))
        if length > 0.0:
            across = _within(h, _angle(l, z))[_GRID // 2]
            position += length * float(across)
    return np.array([position, largest[-1]])


def _components(axes: Axes, k: Floats) -> list[Floats]:
    """Return the largest components h_j of each w_j, at most, over half a turn of x."""
    along = np.abs(np.cos(np.arange(_GRID) * _STEP))
    h = np.zeros(_GRID)
    found: list[Floats] = []
    for j, bound in enumerate(k):
        if j:
            h = _within(h, _angle(axes.directions[j - 1], axes.directions[j]))
        h = bound * along + h
        found.append(_UP * h)
    return found


def _within(h: Floats, angle: float) -> Floats:
    """Return the largest h, at most, of directions at each angle x from another line.

    That line is at `angle` [rad], up to a right one, from the one to which h belongs:
    from this one, they are between |x - angle| and x + angle.
    """
    found = np.empty(_GRID)
    for m in range(_GRID // 2 + 1):
        first = floor(abs(m - angle / _STEP))
        last = ceil(m + angle / _STEP)
        found[m] = _UP * h[np.arange(first, last + 1) % _GRID].max()
    found[_GRID // 2 + 1 :] = found[_GRID // 2 - 1 : 0 : -1]
    return found


def _angle(a: Floats, b: Floats) -> float:
    """Return the angle [rad] between two lines."""
    across = float(np.linalg.norm(np.cross(a, b)))
    return float(np.arctan2(across, abs(float((a * b).sum()))))


def _steps(axes: Axes, weights: Floats) -> Floats:
    """Return l_j (r, 3) [m] between points on the axes, with short lengths."""
    points = axes.origins.copy()
    last = len(points) - 1
    for _ in range(_SWEEPS):
        for i in range(last, -1, -1):
            pulls = [(weights[i], axes.tip if i == last else points[i + 1])]
            if i:
                pulls.append((weights[i - 1], points[i - 1]))
            points[i] = _pulled(points[i], axes.directions[i], pulls)
    ends = np.vstack((points[1:], axes.tip))
    return np.asarray(ends - points)


def _pulled(
    point: Floats, direction: Floats, pulls: list[tuple[float, Floats]]
) -> Floats:
    """Return a point moved along a line to shorten weighted distances."""
    moved = total = 0.0
    for weight, end in pulls:
        way = end - point
        strength = weight / np.sqrt((way * way).sum() + _NEAR)
        moved += strength * float((way * direction).sum())
        total += strength
    return np.asarray(point + moved / max(total, _PARALLEL) * direction)
