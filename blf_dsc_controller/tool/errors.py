# SPDX-License-Identifier: Apache-2.0
"""The error of the tool, and a certified bound on it at a posture of the reference.

The tool is the origin p and the rotation R of the tip, J and Z are the Jacobians of
its position and orientation at the reference qr.  For every joint error e with
|e_i| <= k_i, and not at the corners of that box alone,

    |p(qr + e) - p(qr)|  <=  max_s |J diag(k) s| + k^T C k / 2,    s_i = +-1       [m]
    angle of R(qr)^T R(qr + e)  <=  max_s |Z diag(k) s| + k^T T k / 2            [rad]

The first terms are exact: a convex function is largest at a corner.  The second ones
are rigorous remainders: along the straight way from qr to qr + e, J changes by at most
sum_j C_ij |e_j| in column i.  C_ij >= |d2p / dq_i dq_j| holds at every posture: with j
the later of two revolute joints it is the length of a way from a point on axis j to the
tip, for a revolute joint before a prismatic one it is 1, else 0.  T_ij = 1/2 for each
pair of revolute joints, since only the earlier one turns the axis of the later.
"""

from __future__ import annotations

from math import pi
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.urdf import Chain
from blf_dsc_controller.compiled.jit import inner, kernel
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.numerics.algebra import (
    Vector,
    cross,
    dot,
    plus,
    product,
    put,
    times,
    transform,
    vector,
)
from blf_dsc_controller.numerics.elementary import cos, sin
from blf_dsc_controller.tool.postures import (
    Axes,
    axes_of,
    over_all_postures,
    ways_to_tip,
)

Floats = NDArray[np.float64]

MOST_JOINTS = 14
"""Of an arm with a certified bound, whose corners are looked at one by one."""

ERROR, BOUND, ANGLE, ANGLE_BOUND = range(4)
"""Columns of `Tool.errors`: position and bound on it [m], angle and bound on it [rad]."""

_ROUNDING = 1.0 + 1e-12
_STEPS = 6  # of Newton's method for an arcsine


class Links(NamedTuple):
    """Chain of n joints: constants, and working memory after them."""

    rotation: Array  # (n, 3, 3, 3), R0, R1, R2 of R0 + cos q R1 + sin q R2
    offset: Array  # (n, 3) m, of each joint in the previous one
    slide: Array  # (n, 3), change of the offset per q of prismatic joints
    axis: Array  # (n, 3) in the joint's own frame
    revolute: Array  # (n,) 1 or 0
    tip: Array  # (3,) m, in the last joint
    curvature: Array  # (n, n) m, C
    turning: Array  # (n, n), T
    frames: Array  # (2, 2, 3, 3): rotation of reference and tool, and the one before
    axes: Array  # (2, n, 3)
    origins: Array  # (2, n, 3) m
    columns: Array  # (2, n, 3), J diag(k) and Z diag(k)
    signs: Array  # (n,)


@inner
def _place(links: Links, which: int, q: Array) -> Vector:
    """Return the tip at q (n,); fill rotation, axes and origins of this number."""
    rotation = links.frames[which, 0]
    before = links.frames[which, 1]
    for i in range(3):
        for j in range(3):
            rotation[i, j] = 1.0 if i == j else 0.0
    at = (0.0, 0.0, 0.0)
    for k in range(q.size):
        constant, with_cos, with_sin = (
            links.rotation[k, 0],
            links.rotation[k, 1],
            links.rotation[k, 2],
        )
        offset = plus(vector(links.offset[k]), times(q[k], vector(links.slide[k])))
        at = plus(at, transform(rotation, offset))
        c, s = cos(q[k]), sin(q[k])
        for i in range(3):
            for j in range(3):
                before[i, j] = rotation[i, j]
        for i in range(3):
            row = vector(before[i])
            for j in range(3):
                column = (
                    constant[0, j] + c * with_cos[0, j] + s * with_sin[0, j],
                    constant[1, j] + c * with_cos[1, j] + s * with_sin[1, j],
                    constant[2, j] + c * with_cos[2, j] + s * with_sin[2, j],
                )
                rotation[i, j] = dot(row, column)
        put(transform(rotation, vector(links.axis[k])), links.axes[which, k])
        put(at, links.origins[which, k])
    return plus(at, transform(rotation, vector(links.tip)))


@inner
def _largest_sum(columns: Array, signs: Array) -> float:
    """Return max_s |sum_i s_i columns_i|, s_i = +-1, in the order of a Gray code."""
    n = columns.shape[0]
    total = (0.0, 0.0, 0.0)
    for i in range(n):
        signs[i] = 1.0
        total = plus(total, vector(columns[i]))
    largest = dot(total, total)
    for count in range(1, 2 ** (n - 1)):
        i = 0
        while (count >> i) & 1 == 0:
            i += 1
        signs[i] = -signs[i]
        total = plus(total, times(2.0 * signs[i], vector(columns[i])))
        largest = max(largest, dot(total, total))
    return float(np.sqrt(largest))


@inner
def _half_product(A: Array, k: Array) -> float:
    """Return k^T A k / 2."""
    total = 0.0
    for i in range(k.size):
        for j in range(k.size):
            total += A[i, j] * k[i] * k[j]
    return 0.5 * total


@inner
def _angle_between(A: Array, B: Array) -> float:
    """Return the angle [rad] between two rotations (3, 3): |A - B| = 2 sqrt 2 sin(angle / 2)."""
    square = 0.0
    for i in range(3):
        for j in range(3):
            square += (A[i, j] - B[i, j]) * (A[i, j] - B[i, j])
    chord = np.sqrt(square / 8.0)
    if chord > 0.9:  # far from any use: the slope of the sine ends
        return 2.0 * chord if chord < 1.0 else pi
    half = chord
    for _ in range(_STEPS):
        half -= (sin(half) - chord) / cos(half)
    return 2.0 * float(half)


@kernel
def _fill_errors(links: Links, qr: Array, errors: Array, k: Array, out: Array) -> None:
    """Fill rows (m, 4) for postures, errors and bounds (m, n)."""
    n = qr.shape[1]
    posture = links.signs  # before its use for signs
    for m in range(qr.shape[0]):
        for i in range(n):
            posture[i] = qr[m, i] + errors[m, i]
        there = _place(links, 1, posture)
        tip = _place(links, 0, qr[m])
        off = plus(there, times(-1.0, tip))
        for i in range(n):
            z = vector(links.axes[0, i])
            arm = plus(tip, times(-1.0, vector(links.origins[0, i])))
            if links.revolute[i] == 1.0:
                put(times(k[m, i], cross(z, arm)), links.columns[0, i])
                put(times(k[m, i], z), links.columns[1, i])
            else:
                put(times(k[m, i], z), links.columns[0, i])
                put((0.0, 0.0, 0.0), links.columns[1, i])
        out[m, 0] = np.sqrt(dot(off, off))
        out[m, 1] = _largest_sum(links.columns[0], links.signs)
        out[m, 1] += _half_product(links.curvature, k[m])
        out[m, 2] = _angle_between(links.frames[0, 0], links.frames[1, 0])
        out[m, 3] = _largest_sum(links.columns[1], links.signs)
        out[m, 3] += _half_product(links.turning, k[m])


class Tool:
    """The tip of a chain, whose prismatic joints move at most `travel` (n,) [m] from 0."""

    def __init__(self, chain: Chain, travel: Floats) -> None:
        self.axes: Axes = axes_of(chain, travel)
        self._links = _links_of(chain, ways_to_tip(self.axes))

    def errors(self, qr: Floats, errors: Floats, bound: Floats) -> Floats:
        """Return ERROR, BOUND, ANGLE, ANGLE_BOUND (..., 4) of samples.

        References [rad], errors [rad] and joint bounds [rad] are (..., n).
        """
        shape = np.shape(qr)
        # Copies: what is read-only would be another type, and compiled again.
        rows = [
            np.array(np.broadcast_to(each, shape), np.float64, order='C')
            for each in (qr, errors, bound)
        ]
        out = np.empty((*shape[:-1], 4))
        n = shape[-1]
        references, off, k = (each.reshape(-1, n) for each in rows)
        _fill_errors(self._links, references, off, k, out.reshape(-1, 4))
        return out

    def at_postures(self, q: Floats, k: Floats) -> Floats:
        """Return the bounds (m, 2) [m, rad] of joint bounds k (n,) at postures q (m, n)."""
        found = self.errors(q, np.zeros_like(q), k)
        return np.asarray(_ROUNDING * found[:, [BOUND, ANGLE_BOUND]])

    def everywhere(self, k: Floats) -> Floats:
        """Return the bounds (2,) [m, rad] of joint bounds k (n,) at every posture."""
        return over_all_postures(self.axes, k)


def in_words(errors: Floats) -> str:
    """Return errors at the tool (4,), as of `Tool.errors`, as a clause of a sentence."""
    error, bound, angle, angle_bound = (1e3 * errors).tolist()
    return (
        f'the tool is {error:.4g} mm off and turned by {angle:.4g} mrad, where the joint bounds '
        f'keep it within {bound:.4g} mm and {angle_bound:.4g} mrad'
    )


def _links_of(chain: Chain, ways: Floats) -> Links:
    """Return the packed chain; `ways` (n,) [m] are those from each axis to the tip."""
    joints = chain.joints
    n = len(joints)
    revolute = np.array([float(joint.kind != 'prismatic') for joint in joints])
    rotation = np.zeros((n, 3, 3, 3))
    slide = np.zeros((n, 3))
    for i, joint in enumerate(joints):
        R = joint.placement[:3, :3]
        if revolute[i]:
            rotation[i] = [product(R, part) for part in _rotation_parts(joint.axis)]
        else:
            rotation[i, 0] = R
            slide[i] = product(R, joint.axis[:, np.newaxis])[:, 0]
    turning = 0.5 * np.outer(revolute, revolute)
    np.fill_diagonal(turning, 0.0)
    return Links(
        rotation=rotation,
        offset=np.array([joint.placement[:3, 3] for joint in joints]),
        slide=slide,
        axis=np.array([joint.axis for joint in joints]),
        revolute=revolute,
        tip=chain.tip_placement[:3, 3].copy(),
        curvature=_curvature(revolute, ways),
        turning=turning,
        frames=np.zeros((2, 2, 3, 3)),
        axes=np.zeros((2, n, 3)),
        origins=np.zeros((2, n, 3)),
        columns=np.zeros((2, n, 3)),
        signs=np.zeros(n),
    )


def _rotation_parts(axis: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the parts (3, 3) of a rotation about an axis (3,): constant, with cos, with sin."""
    along = np.outer(axis, axis)
    return along, np.eye(3) - along, np.cross(np.eye(3), axis)


def _curvature(revolute: Floats, ways: Floats) -> Floats:
    """Return C (n, n) [m], by which joints turn (n,) and the ways from their axes to the tip."""
    n = revolute.size
    C = np.zeros((n, n))
    for i in range(n):
        for j in range(i, n):
            later = ways[j] if revolute[j] else float(j > i)
            C[i, j] = C[j, i] = revolute[i] * later
    return C
