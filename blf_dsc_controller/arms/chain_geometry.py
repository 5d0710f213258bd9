# SPDX-License-Identifier: Apache-2.0
"""Forward kinematics of a chain: placements of its joints and its tip."""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.arms.urdf import Chain


def frames(chain: Chain, q: np.ndarray) -> list[np.ndarray]:
    """Return the placements (..., 4, 4), in the base frame, of the base, each joint and the tip.

    `q` is (..., n): one posture or an array of postures.
    """
    placements = [np.broadcast_to(np.eye(4), (*q.shape[:-1], 4, 4))]
    for i, joint in enumerate(chain.joints):
        axis, position = joint.axis, q[..., i, None]
        motion = placements[0].copy()
        if joint.kind == 'prismatic':
            motion[..., :3, 3] = position * axis
        else:
            along = np.outer(axis, axis)
            c, s = np.cos(position)[..., None], np.sin(position)[..., None]
            motion[..., :3, :3] = along + c * (np.eye(3) - along) + s * np.cross(np.eye(3), axis)
        placements.append(placements[-1] @ joint.placement @ motion)
    return [*placements, placements[-1] @ chain.tip_placement]


def skeleton(chain: Chain, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return base, joints and tip (n + 2, 3) [m], and the joint axes (n, 3), at q (n,)."""
    placements = np.array(frames(chain, q))
    axes = [
        placement[:3, :3] @ joint.axis
        for placement, joint in zip(placements[1:-1], chain.joints, strict=True)
    ]
    return placements[:, :3, 3], np.array(axes)


def tip_radius(chain: Chain, q: np.ndarray, bound: np.ndarray) -> float:
    """Return the largest distance [m] of the tip from its reference while all bounds (n,) hold.

    To first order: each joint rotates the tip about its axis, or slides it.
    """
    corners, axes = skeleton(chain, q)
    reach = np.linalg.norm(np.cross(axes, corners[-1] - corners[1:-1]), axis=1)
    slides = np.array([joint.kind == 'prismatic' for joint in chain.joints])
    return float(np.where(slides, 1.0, reach) @ bound)
