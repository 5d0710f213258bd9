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
from blf_dsc_controller.identification.physical import left_of, solve
from blf_dsc_controller.identification.prior import Prior
from blf_dsc_controller.run import Floats

_AS_GOOD = 1.02  # times the least cost
_SMALL = 0.03  # of the largest torque, whose sign only friction shows
_MOST_UNCLEAR = 12  # joints whose signs are combined
_MOST = 16  # combinations with physical bodies

Signs = NDArray[np.float64]


def likely_signs(alone: Alone, prior: Prior) -> Signs:
    """Return the most likely signs (n,), 1 or -1.

    Of signs that are as good, those of most joints are alike, and as recorded.
    """
    fit = _Fit(alone, prior)
    combinations = np.array(list(_combinations(alone)))
    bounds = fit.bounds(combinations)
    found: list[tuple[float, Signs]] = []
    for k in np.argsort(bounds)[:_MOST]:
        least = min((cost for cost, _ in found), default=np.inf)
        if bounds[k] > _AS_GOOD * least:
            break
        found.append((fit.cost(combinations[k]), combinations[k]))
    least = min(cost for cost, _ in found)
    as_good = [signs for cost, signs in found if cost <= _AS_GOOD * least]
    return min(as_good, key=_oddity)


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

    def __init__(self, alone: Alone, prior: Prior) -> None:
        k = prior.mean.size
        # from rows of `Weighted` to those of z, of the prior's mean, and of the torques
        T = np.zeros((alone.products.shape[1], k + 2))
        T[:-2, :-1] = prior.T[:-2]
        T[-2:, -1] = -alone.delay, 1.0
        deviation = alone.deviation[:, None, None]
        self._products = T.T @ (alone.products / deviation**2) @ T  # (n, k + 2, k + 2)
        self._prior = prior

    def bounds(self, signs: Signs) -> Floats:
        """Return lower bounds (c,) of the cost with signs (c, n)."""
        products = self._products
        alike = products.sum(axis=0)
        L = np.linalg.cholesky(alike[:-2, :-2] + np.eye(len(alike) - 2))
        targets = np.column_stack((alike[:-2, -2], products[:, :-2, -1].T))
        y = np.linalg.solve(L, targets)
        explained = np.sum((y[:, 1:] @ signs.T + y[:, :1]) ** 2, axis=0)
        crossed = signs @ products[:, -2, -1]
        return np.asarray(alike[-2, -2] + alike[-1, -1] + 2.0 * crossed - explained)

    def cost(self, signs: Signs) -> float:
        """Return the squared residuals and deviations of the best physical arm."""
        own = np.tile(
            np.eye(len(self._products[0]), len(self._products[0]) - 1),
            (signs.size, 1, 1),
        )
        own[:, -1, -1] = signs
        products = (np.swapaxes(own, 1, 2) @ self._products @ own).sum(axis=0)
        z = solve(products, self._prior.cones, self._prior.start)
        return left_of(products, z) + float(z @ z)
