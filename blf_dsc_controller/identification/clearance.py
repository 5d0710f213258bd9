# SPDX-License-Identifier: Apache-2.0
"""How far the links of an arm stay from each other and from the floor, without meshes."""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.arms.urdf import Chain, frames

_LEAST = 1e-6  # m, length of a line; shorter ones are points of the next line
_ORIGIN = np.array((0.0, 0.0, 0.0, 1.0))
_CARRIED = 2  # joints, counted from the base, that may be near the floor


class Clearance:
    """Clearance between the links of a chain, and between them and the floor.

    Meshes are not read.  A link is modelled as all points within `radius` of the
    straight line from its joint to the next, or to the tip; via its centre of mass, if
    that is farther from the line than the radius.  All pairs of links are checked
    except those separated by less than two radii of arm, from joint to joint: they
    touch in every posture, and only the joint limits can keep them apart.  The floor is
    the plane z = `floor` [m] in the base; the first two joints may be near it.
    """

    def __init__(self, chain: Chain, radius: float, floor: float) -> None:
        self._chain = chain
        self._radius = radius
        self._floor = floor
        # corners of the lines: a frame (base, joints, tip), and a place in it
        self._points = [(k, _ORIGIN) for k in range(len(chain.joints) + 2)]
        posture = np.zeros(len(chain.joints))
        placements = frames(chain, posture)
        origins = self.corners(posture)
        for k, joint in reversed([*enumerate(chain.joints, 1)]):
            place = np.append(joint.inertia[1:4] / joint.inertia[0], 1.0)
            centre = (placements[k] @ place)[:3]
            if distance(centre, centre, origins[k], origins[k + 1]) > radius:
                self._points.insert(k + 1, (k, place))
        # pairs of lines to check
        links = [k for k, _ in self._points[:-1]]  # of each line
        length = np.linalg.norm(np.diff(origins, axis=0), axis=1)
        end = np.cumsum(length)
        begin = end - length
        is_line = length[links] > _LEAST
        are_apart = begin[links] - end[links][:, None] > 2.0 * radius
        self._first, self._second = np.nonzero(are_apart & is_line & is_line[:, None])

    def corners(self, q: np.ndarray) -> np.ndarray:
        """Return base, joints, centres of mass aside, and tip (..., k, 3) [m], at q (..., n)."""
        placements = frames(self._chain, q)
        corners = [placements[k] @ place for k, place in self._points]
        return np.stack(corners, axis=-2)[..., :3]

    def room(self, q: np.ndarray) -> np.ndarray:
        """Return the room (..., k) of the pairs of links, then of the corners above the floor.

        At q (..., n), as (distance / required) - 1: two radii are required, or one
        above the floor.
        """
        corners = self.corners(q)
        begin = corners[..., :-1, :]
        end = corners[..., 1:, :]
        a, b = self._first, self._second
        apart = distance(
            begin[..., a, :], end[..., a, :], begin[..., b, :], end[..., b, :]
        )
        beyond = [k > _CARRIED for k, _ in self._points]
        above = corners[..., beyond, 2] - self._floor
        room = (apart / (2.0 * self._radius), above / self._radius)
        return np.concatenate(room, axis=-1) - 1.0


def distance(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Return the distance (...) [m] of the line segments from a to b and from c to d (..., 3).

    Ericson, Real-Time Collision Detection, 2005, 5.1.9; a segment may be a point.
    """
    u = b - a
    v = d - c
    w = a - c
    uu = (u * u).sum(-1)
    uv = (u * v).sum(-1)
    vv = (v * v).sum(-1)
    uw, vw = (u * w).sum(-1), (v * w).sum(-1)
    tiny = np.finfo(float).tiny
    s = np.clip((uv * vw - vv * uw) / np.maximum(uu * vv - uv * uv, tiny), 0.0, 1.0)
    t = np.clip((uv * s + vw) / np.maximum(vv, tiny), 0.0, 1.0)
    s = np.clip((uv * t - uw) / np.maximum(uu, tiny), 0.0, 1.0)
    gap: np.ndarray = np.linalg.norm(w + s[..., None] * u - t[..., None] * v, axis=-1)
    return gap
