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
    mean, half = _products(alone, prior)

    def physical(products: Floats) -> Floats:
        return solve(products, prior.cones, prior.start)

    def cost(signs: Signs, solution: Callable[[Floats], Floats]) -> float:
        """Return the squared residuals and deviations of the solution for products."""
        products = mean + np.tensordot(signs, half, 1)
        z = solution(products)
        return left_of(products, z) + float(z @ z)

    combinations = list(_combinations(alone))
    bounds = np.array([cost(signs, most_likely) for signs in combinations])
    costs: dict[int, float] = {}
    least = np.inf
    for k in np.argsort(bounds)[:_MOST].tolist():
        if bounds[k] > _AS_GOOD * least:
            break
        costs[k] = cost(combinations[k], physical)
        least = min(costs.values())
    as_good = [
        combinations[k] for k, found in costs.items() if found <= _AS_GOOD * least
    ]
    return min(as_good, key=_oddity)


def _products(alone: Alone, prior: Prior) -> tuple[Floats, Floats]:
    """Return [A | b]^T [A | b] of the whole arm: mean of both signs, and n halves of differences.

    Torques have no delay but that of `alone`.
    """
    of_joints = alone.products / alone.deviation[:, None, None] ** 2
    both = []
    for sign in (1.0, -1.0):
        T = prior.T.copy()
        T[-2:] = 0.0
        T[-2:, -1] = -sign * alone.delay, sign
        both.append(0.5 * (T.T @ of_joints @ T))
    recorded, opposite = both
    return (recorded + opposite).sum(axis=0), recorded - opposite


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
