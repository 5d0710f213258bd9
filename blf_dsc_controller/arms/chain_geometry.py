# SPDX-License-Identifier: Apache-2.0
"""Where the joints and the tip of a chain are, for pictures."""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.arms.urdf import Chain


def skeleton(chain: Chain, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Base, joints and tip (n + 2, 3) [m], and the axes of the joints (n, 3), at q (n,)."""
    frame = np.eye(4)
    corners, axes = [frame[:3, 3]], []
    for joint, position in zip(chain.joints, q, strict=True):
        frame = frame @ joint.placement
        axis, motion = joint.axis, np.eye(4)
        if joint.kind == 'prismatic':
            motion[:3, 3] = position * axis
        else:
            along = np.outer(axis, axis)
            c, s = np.cos(position), np.sin(position)
            motion[:3, :3] = along + c * (np.eye(3) - along) + s * np.cross(np.eye(3), axis)
        frame = frame @ motion
        corners.append(frame[:3, 3])
        axes.append(frame[:3, :3] @ axis)
    corners.append((frame @ chain.tip_placement)[:3, 3])
    return np.array(corners), np.array(axes)


def tip_radius(chain: Chain, q: np.ndarray, bound: np.ndarray) -> float:
    """Largest distance [m] of the tip from its reference while all joints keep their bounds (n,).

    To first order: each joint swings the tip about its axis, or slides it.
    """
    corners, axes = skeleton(chain, q)
    reach = np.linalg.norm(np.cross(axes, corners[-1] - corners[1:-1]), axis=1)
    slides = np.array([joint.kind == 'prismatic' for joint in chain.joints])
    return float(np.where(slides, 1.0, reach) @ bound)
