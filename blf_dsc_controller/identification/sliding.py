# SPDX-License-Identifier: Apache-2.0
"""Sliding direction s of a joint, in [-1, 1]: what multiplies its Coulomb friction.

At a reversal, friction does not jump: the contact yields elastically first, over a
distance x_s that is a constant of the joint (Dahl, A solid friction model, 1968):

    s' = (v - |v| s) / x_s,      in one direction of motion  s = sign(v) (1 - exp(-|x| / x_s)).

At rest s stays, as stiction does.  With x_s = 0 the direction is s(v) of
`arms.friction`.
"""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.arms.friction import slidings
from blf_dsc_controller.compiled.jit import kernel
from blf_dsc_controller.numerics.elementary import exp
from blf_dsc_controller.run import Floats

DISTANCES = (0.0, 1e-4, 3e-4, 1e-3, 3e-3)
"""Distances x_s to choose from [rad, or m]: cross-validation decides for each joint."""

COULOMB_SPEED = 0.005
"""Scale v_c of s(v) [rad/s, or m/s]."""


def sliding_direction(
    q: Floats, dq: Floats, distances: Floats, first: Floats | None = None
) -> Floats:
    """Return s (N, n) along positions and speeds (N, n), for distances x_s (n,).

    `first` (n,) is s at the first of them where x_s > 0; None: zero.
    """
    direction = slidings(dq, COULOMB_SPEED)
    elastic = np.flatnonzero(distances)
    if elastic.size:
        own = np.zeros((len(q), elastic.size))
        if first is not None:
            own[0] = first[elastic]
        follow_contacts(np.ascontiguousarray(q[:, elastic]), distances[elastic], own)
        direction[:, elastic] = own
    return direction


@kernel
def follow_contacts(q: np.ndarray, distances: np.ndarray, s: np.ndarray) -> None:
    """Fill s (N, k) along the positions (N, k), from its first row: exact for a monotone step."""
    for k in range(1, q.shape[0]):
        for i in range(q.shape[1]):
            moved = q[k, i] - q[k - 1, i]
            kept = exp(-abs(moved) / distances[i])
            direction = 1.0 if moved > 0.0 else -1.0
            s[k, i] = direction + (s[k - 1, i] - direction) * kept
