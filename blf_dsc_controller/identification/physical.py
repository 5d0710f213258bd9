# SPDX-License-Identifier: Apache-2.0
"""The most likely values over physical bodies only: a convex problem, by the barrier method.

    minimise  |A z - b|^2 / 2 + |z|^2 / 2  - sum_i max(mu, c_i) log det J_i(z)

with pseudo-inertias, or scalars, J_i > 0 affine in z, by Newton steps with decreasing
mu (Boyd and Vandenberghe, Convex Optimization, 2004, chapter 11).  The prior's density
has the determinants to the power c_i.  Where that is zero, the sum of squares is at the
end at most mu times the number of rows of these J_i above its minimum.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.identification.recording import Indices
from blf_dsc_controller.run import Floats

_LAST = 1e-3  # mu; one standard deviation adds 0.5 to the objective
_REDUCTION = 0.1  # of mu, from one centring to the next
_STEPS = 100
_CENTRED = 1e-3  # of mu, Newton decrement at which mu is reduced
_SUFFICIENT = 0.1  # of the linear decrease, in the line search
_SHORTEST = 1e-9  # step of the line search
_ROUNDED = float(np.finfo(float).eps)  # of the objective


class Cones(NamedTuple):
    """Symmetric matrices (d, d) that must be positive definite: J0 + sum_a z[entries[a]] E[a].

    There are g of one size.
    """

    entries: Indices  # (g, k) of z, on which each depends
    J0: Floats  # (g, d, d)
    E: Floats  # (g, k, d, d)
    power: Floats  # (g,) of their determinants in the density of the prior

    def but(self, entries: Sequence[int]) -> Cones:
        """Return the cones that depend on none of these entries."""
        is_kept = ~np.isin(self.entries, entries).any(axis=1)
        return Cones._make(each[is_kept] for each in self)

    def matrices(self, z: Floats) -> Floats:
        """Return the matrices (g, d, d) at z."""
        return np.asarray(self.J0 + np.einsum('ga,gaij->gij', z[self.entries], self.E))


def most_likely(products: Floats) -> Floats:
    """Return the minimum (k,) without cones, for [A | b]^T [A | b] (k + 1, k + 1)."""
    information = products[:-1, :-1] + np.eye(len(products) - 1)
    return np.asarray(np.linalg.solve(information, products[:-1, -1]), np.float64)


def left_of(products: Floats, z: Floats) -> float:
    """Return |A z - b|^2 for these products."""
    both = np.append(z, -1.0)
    return max(float(both @ products @ both), 0.0)


def solve(products: Floats, cones: Sequence[Cones], z: Floats) -> Floats:
    """Return the minimum for these products, starting from z inside all cones.

    Raises:
        BlfDscError: it is not found.
    """
    mu = max(1.0, left_of(products, z))
    information = products[:-1, :-1] + np.eye(z.size)
    target = products[:-1, -1]
    while mu > _LAST:
        mu = max(_LAST, _REDUCTION * mu)
        z = _centred(information, target, cones, z, mu)
    return z


def _centred(
    information: Floats, target: Floats, cones: Sequence[Cones], z: Floats, mu: float
) -> Floats:
    """Return the minimum for one mu, as far as the objective's digits show it."""
    for _ in range(_STEPS):
        gradient = information @ z - target
        hessian = information.copy()
        for group in cones:
            own = group.entries
            power = np.maximum(mu, group.power)
            T = np.linalg.solve(group.matrices(z)[:, None], group.E)
            slope = power[:, None] * np.einsum('gaii->ga', T)
            curvature = power[:, None, None] * np.einsum('gaij,gbji->gab', T, T)
            np.subtract.at(gradient, own, slope)
            np.add.at(hessian, (own[:, :, None], own[:, None, :]), curvature)
        step = np.linalg.solve(hessian, -gradient)
        decrement = float(-gradient @ step)
        if decrement < _CENTRED * mu:
            return z
        size = 1.0
        least = _objective(information, target, cones, z, mu)
        while size > _SHORTEST:
            if _SUFFICIENT * size * decrement < _ROUNDED * abs(least):
                return z  # a decrease would be lost in rounding
            there = _objective(information, target, cones, z + size * step, mu)
            if there <= least - _SUFFICIENT * size * decrement:
                break
            size *= 0.5
        z = z + size * step
    raise BlfDscError(f'no physical inertias found in {_STEPS} Newton steps')


def _objective(
    information: Floats, target: Floats, cones: Sequence[Cones], z: Floats, mu: float
) -> float:
    """Return the objective, up to a constant; infinite outside a cone."""
    value = 0.5 * float(z @ information @ z) - float(target @ z)
    for group in cones:
        try:
            L = np.linalg.cholesky(group.matrices(z))
        except np.linalg.LinAlgError:
            return np.inf
        power = np.maximum(mu, group.power)
        value -= 2.0 * float(power @ np.log(np.einsum('gii->gi', L)).sum(axis=1))
    return value
