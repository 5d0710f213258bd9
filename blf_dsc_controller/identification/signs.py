# SPDX-License-Identifier: Apache-2.0
"""Signs of the efforts: those with which physical bodies explain the torques best.

A drive may count its effort in the opposite sense.  A URDF alone cannot tell: if a link
is heavier than it says, gravity may point the other way.  So all combinations of signs
are compared by the fit of the whole arm.  Its cost for any bodies and friction is a lower
bound of that with physical bodies and friction that brakes, which takes longer and is
computed for the most likely combinations only.

Clear friction overrules everything: it cannot drive.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.identification.joint_alone import Alone
from blf_dsc_controller.identification.physical import left_of, most_likely, solve
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
    combinations = list(_combinations(alone))
    bounds = np.array([fit.cost(signs, most_likely) for signs in combinations])
    costs: dict[int, float] = {}
    least = np.inf
    for k in np.argsort(bounds)[:_MOST].tolist():
        if bounds[k] > _AS_GOOD * least:
            break
        costs[k] = fit.cost(combinations[k], fit.physical)
        least = min(costs.values())
    as_good = [combinations[k] for k, cost in costs.items() if cost <= _AS_GOOD * least]
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
        products = T.T @ (alone.products / deviation**2) @ T  # (n, k + 2, k + 2)
        self._alike = products.sum(axis=0)
        self._with_torque = products[:, -1]  # (n, k + 2), of which each has a sign
        self._prior = prior

    def cost(self, signs: Signs, solution: Callable[[Floats], Floats]) -> float:
        """Return the squared residuals and deviations of the solution for products."""
        crossed = signs @ self._with_torque
        products = self._alike[:-1, :-1].copy()
        products[-1] += crossed[:-1]
        products[:, -1] += crossed[:-1]
        products[-1, -1] += self._alike[-1, -1]
        z = solution(products)
        return left_of(products, z) + float(z @ z)

    def physical(self, products: Floats) -> Floats:
        """Return the most likely z of a physical arm."""
        return solve(products, self._prior.cones, self._prior.start)
