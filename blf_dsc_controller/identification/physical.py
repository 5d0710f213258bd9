# SPDX-License-Identifier: Apache-2.0
"""Least squares over physical bodies only: a convex problem, solved by the barrier method.

    minimise  |A z - b|^2 / 2 + |z|^2 / 2  - mu sum_i log det J_i(z) - mu sum_k log s_k(z)

with the pseudo-inertias J_i > 0 and scalars s_k > 0 affine in z, by Newton steps with decreasing mu
(Boyd and Vandenberghe, Convex Optimization, 2004, chapter 11).  At the end the sum of squares is at
most mu times the number of rows of all J_i and s_k above its minimum.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.run import Floats

_LAST = 1e-3  # mu; one standard deviation adds 0.5 to the objective
_STEPS = 100


class Cone(NamedTuple):
    """A symmetric matrix (d, d) that must be positive definite: J0 + sum_a z[at + a] E[a]."""

    at: int
    J0: Floats  # (d, d)
    E: Floats  # (k, d, d)

    def of(self, z: Floats) -> Floats:
        """Return the matrix at z."""
        part = z[self.at : self.at + self.E.shape[0]]
        return np.asarray(self.J0 + np.tensordot(part, self.E, 1))


def solve(A: Floats, b: Floats, cones: list[Cone], z: Floats) -> Floats:
    """Return the minimum, starting from z inside all cones; raises BlfDscError if not found."""
    mu = max(1.0, float(np.sum((A @ z - b) ** 2)))
    while mu > _LAST:
        mu = max(_LAST, 0.1 * mu)
        for _ in range(_STEPS):
            gradient, hessian = A.T @ (A @ z - b) + z, A.T @ A + np.eye(z.size)
            for cone in cones:
                own = slice(cone.at, cone.at + cone.E.shape[0])
                T = np.linalg.solve(cone.of(z), cone.E)
                gradient[own] -= mu * np.trace(T, axis1=1, axis2=2)
                hessian[own, own] += mu * np.einsum('aij,bji->ab', T, T)
            step = np.linalg.solve(hessian, -gradient)
            decrement = float(-gradient @ step)
            if decrement < 1e-3 * mu:
                break
            size, before = 1.0, _objective(A, b, cones, z, mu)
            while _objective(A, b, cones, z + size * step, mu) > before - 0.1 * size * decrement:
                size *= 0.5
                if size < 1e-9:
                    break
            z = z + size * step
        else:
            raise BlfDscError(f'no physical inertias found in {_STEPS} Newton steps')
    return z


def _objective(A: Floats, b: Floats, cones: list[Cone], z: Floats, mu: float) -> float:
    value = 0.5 * float(np.sum((A @ z - b) ** 2) + z @ z)
    for cone in cones:
        try:
            L = np.linalg.cholesky(cone.of(z))
        except np.linalg.LinAlgError:
            return np.inf
        value -= 2.0 * mu * float(np.log(np.diag(L)).sum())
    return value
