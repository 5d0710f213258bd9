# SPDX-License-Identifier: Apache-2.0
"""Signs of the efforts: those with which physical bodies explain the torques best.

A drive may count its effort in the opposite sense.  A URDF alone cannot tell: if a link
is heavier than it says, gravity may point the other way.  So all combinations of signs
are compared by the fit of the whole arm.  Without bounds its cost is a quadratic
function of the signs, and a lower bound of the cost with physical bodies and friction
that brakes.  The latter is computed for the most likely combinations only.

Clear friction overrules everything: it cannot drive.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.identification.joint_alone import Alone
from blf_dsc_controller.identification.physical import solve
from blf_dsc_controller.identification.prior import Prior
from blf_dsc_controller.run import Floats

_AS_GOOD = 1.02  # times the least cost
_SMALL = 0.03  # of the largest torque, whose sign only friction shows
_MOST_UNCLEAR = 12  # joints whose signs are combined
_MOST = 16  # combinations with physical bodies

Signs = NDArray[np.float64]


def likely_signs(alone: Alone, G: Floats, prior: Prior) -> tuple[Signs, float]:
    """Return the most likely signs (n,), 1 or -1, and the cost of the fit with them.

    Of signs that are as good, those of most joints are alike, and as recorded.
    """
    fit = _Fit(alone, G, prior)
    combinations = np.array(list(_combinations(alone)))
    bounds = fit.bounds(combinations)
    found: list[tuple[float, Signs]] = []
    for k in np.argsort(bounds)[:_MOST]:
        least = min((cost for cost, _ in found), default=np.inf)
        if bounds[k] > _AS_GOOD * least:
            break
        found.append((fit.cost(combinations[k]), combinations[k]))
    least = min(cost for cost, _ in found)
    as_good = [each for each in found if each[0] <= _AS_GOOD * least]
    cost, signs = min(as_good, key=lambda each: _oddity(each[1]))
    return signs, cost


def _combinations(alone: Alone) -> Iterator[Signs]:
    """Yield the signs that friction leaves open, first the recorded ones.

    A small torque keeps its sign: the fit of the whole arm would hardly change with it.
    """
    friction = alone.friction
    is_small = alone.torque < _SMALL * alone.torque.max()
    unclear = np.flatnonzero((friction == 0.0) & ~is_small)[:_MOST_UNCLEAR]
    signs = np.where(friction < 0.0, -1.0, 1.0)
    for chosen in product((1.0, -1.0), repeat=unclear.size):
        each = signs.copy()
        each[unclear] = chosen
        yield each


def _oddity(signs: Signs) -> tuple[int, int]:
    """Return how many joints differ from most others, and how many are reversed."""
    opposite = int(np.sum(signs < 0.0))
    return min(opposite, signs.size - opposite), opposite


class _Fit:
    """The fit of the whole arm to torques with given signs, without their delay."""

    def __init__(self, alone: Alone, G: Floats, prior: Prior) -> None:
        R = alone.triangles / alone.deviation[:, None, None]
        self._prior = prior
        self._A = R[:, :, :-2] @ (G @ prior.D)[:-1]  # (n, m + 2, k)
        self._mean = R[:, :, :-2] @ (G @ prior.mean)[:-1]  # (n, m + 2)
        self._u = R[:, :, -1] - alone.delay * R[:, :, -2]

    def bounds(self, signs: Signs) -> Floats:
        """Return lower bounds (c,) of the cost with signs (c, n)."""
        A, u, mean = self._A, self._u, self._mean
        H = np.einsum('irk,irl->kl', A, A) + np.eye(A.shape[2])
        targets = np.column_stack(
            (-np.einsum('irk,ir->k', A, mean), np.einsum('irk,ir->ki', A, u))
        )
        y = np.linalg.solve(np.linalg.cholesky(H), targets)
        explained = np.sum((y[:, 1:] @ signs.T + y[:, :1]) ** 2, axis=0)
        squares = np.sum(u**2) + np.sum(mean**2)
        crossed = signs @ np.sum(u * mean, axis=1)
        return np.asarray(squares - 2.0 * crossed - explained)

    def cost(self, signs: Signs) -> float:
        """Return the squared residuals and deviations of the best physical arm."""
        A = self._A.reshape(-1, self._A.shape[2])
        b = (signs[:, None] * self._u - self._mean).ravel()
        Q, R = np.linalg.qr(A)
        z = solve(R, Q.T @ b, self._prior.cones, self._prior.start)
        left = b - A @ z
        return float(left @ left + z @ z)
