# SPDX-License-Identifier: Apache-2.0
"""Where the arm is in space, and how far its tip may be from where it should be."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, sin, sqrt

Point = tuple[float, float, float]


def points(l1: float, l2: float, q: Sequence[float]) -> tuple[Point, Point, Point]:
    """Base, elbow and tip [m], in the x-z plane, at the angles q [rad]."""
    elbow = (l1 * cos(q[0]), 0.0, l1 * sin(q[0]))
    angle = q[0] + q[1]
    tip = (elbow[0] + l2 * cos(angle), 0.0, elbow[2] + l2 * sin(angle))
    return (0.0, 0.0, 0.0), elbow, tip


def tip_radius(l1: float, l2: float, q2: float, bound: Sequence[float]) -> float:
    """Farthest [m] the tip can be from its reference while both joints are within their bounds.

    Of first order: joint 1 swings the tip about the base, joint 2 about the elbow.
    """
    reach = sqrt(l1 * l1 + l2 * l2 + 2.0 * l1 * l2 * cos(q2))
    return reach * bound[0] + l2 * bound[1]
