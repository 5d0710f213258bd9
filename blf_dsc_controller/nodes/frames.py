# SPDX-License-Identifier: Apache-2.0
"""Frames of all links, for viewers: what robot_state_publisher computes where it is installed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import cos, sin

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
from std_msgs.msg import Header

from blf_dsc_controller.arms.urdf import links_of

Quaternions = tuple[float, float, float, float]  # x, y, z, w
_AXES = np.eye(3)


class Frames:
    """Frames of the links of a URDF while its `joints` move; all others stay at 0."""

    def __init__(self, text: str, joints: Sequence[str]) -> None:
        self._links = links_of(text)
        self._places = [joints.index(e.joint) if e.joint in joints else -1 for e in self._links]
        self._rest = [_origin(link.rpy) for link in self._links]

    def at(self, stamp: int, q: np.ndarray) -> Iterator[TransformStamped]:
        """Yield the frame of each link in its parent at q (n,) [rad, or m] and a stamp [ns]."""
        time = Time(sec=stamp // 10**9, nanosec=stamp % 10**9)
        for link, place, rest in zip(self._links, self._places, self._rest, strict=True):
            position = float(q[place]) if place >= 0 else 0.0
            slides = position if link.kind == 'prismatic' else 0.0
            turned = _product(rest, _about(link.axis, position - slides))
            x, y, z = (link.xyz + slides * _rotated(rest, link.axis)).tolist()
            yield TransformStamped(
                header=Header(stamp=time, frame_id=link.parent),
                child_frame_id=link.name,
                transform=Transform(
                    translation=Vector3(x=x, y=y, z=z),
                    rotation=Quaternion(x=turned[0], y=turned[1], z=turned[2], w=turned[3]),
                ),
            )


def _about(axis: np.ndarray, angle: float) -> Quaternions:
    x, y, z = (sin(0.5 * angle) * axis).tolist()
    return x, y, z, cos(0.5 * angle)


def _origin(rpy: np.ndarray) -> Quaternions:
    """Return the rotation by roll, pitch and yaw about fixed axes, in this order."""
    roll, pitch, yaw = (_about(axis, angle) for axis, angle in zip(_AXES, rpy, strict=True))
    return _product(yaw, _product(pitch, roll))


def _product(a: Quaternions, b: Quaternions) -> Quaternions:
    u, v = np.array(a[:3]), np.array(b[:3])
    x, y, z = (a[3] * v + b[3] * u + np.cross(u, v)).tolist()
    return x, y, z, a[3] * b[3] - float(u @ v)


def _rotated(by: Quaternions, vector: np.ndarray) -> np.ndarray:
    u = np.array(by[:3])
    turned: np.ndarray = vector + 2.0 * np.cross(u, np.cross(u, vector) + by[3] * vector)
    return turned
