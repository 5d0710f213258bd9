# SPDX-License-Identifier: Apache-2.0
"""Planar arm of n links with point masses at their ends, linear in its parameters.

In the absolute link angles phi_i = q1 + ... + qi, with w = phi' and mu_i the mass beyond joint i,

    sum_j P_ij (cos(phi_i - phi_j) phi_j'' + sin(phi_i - phi_j) phi_j'^2) + P_1i r cos phi_i = Q_i
    P_ij = mu_max(i,j) l_i l_j   [kg m^2],   i <= j,   p = n (n + 1) / 2,   r = g / l1  [1/s^2]

and the joint torques are tau_i = Q_i + ... + Q_n.  C_ij = P_ij sin(phi_i - phi_j) w_j is the
Christoffel form, and remains so under the constant change of coordinates.  For n = 2 this is the
arm of Section IV, with its parameters in the order 11, 12, 22.
"""

from __future__ import annotations

from math import cos, sin
from typing import NamedTuple

from blf_dsc_controller.arms.two_link import PARAMETER_NAMES
from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array


class PlanarChain(NamedTuple):
    """Planar arm of n links: an `ArmModel`."""

    n: int
    r: float  # g / l1, 1/s^2

    @property
    def p(self) -> int:
        """Number of parameters."""
        return self.n * (self.n + 1) // 2

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the P_ij, in the order of the regressor's columns."""
        if self.n == 2:
            P11, P22, P12 = PARAMETER_NAMES
            return P11, P12, P22
        return tuple(f'P{i + 1}{j + 1}' for i in range(self.n) for j in range(i, self.n))

    @property
    def parameter_units(self) -> tuple[str, ...]:
        """Units of the P_ij."""
        return ('kg m^2',) * self.p

    def regressor(self, q: Array, dq: Array, v: Array, a: Array, H: Array) -> None:
        """Fill H (n, p) so that H P = M(q) a + C(q, dq) v + G(q)   [N m], Property III."""
        n = q.size
        column = 0
        phi_i, w_i, v_i, a_i = 0.0, 0.0, 0.0, 0.0
        for i in range(n):
            phi_i += q[i]
            w_i += dq[i]
            v_i += v[i]
            a_i += a[i]
            difference, w_j, v_j, a_j = 0.0, w_i, v_i, a_i
            for j in range(i, n):
                if j > i:
                    difference -= q[j]  # phi_i - phi_j
                    w_j += dq[j]
                    v_j += v[j]
                    a_j += a[j]
                c = cos(difference)
                s = sin(difference)
                for k in range(n):
                    H[k, column] = 0.0
                Q_i = c * a_j + s * w_j * v_j
                Q_j = c * a_i - s * w_i * v_i
                if i == 0:
                    Q_j += self.r * cos(phi_i - difference)
                add_column(H, column, i, j, Q_i, Q_j)
                column += 1

    def momentum_regressor(self, q: Array, dq: Array, Yp: Array, Yr: Array) -> None:
        """Fill Yp, Yr (n, p) so that Yp P = M dq [N m s] and Yr P = G - C^T dq [N m]."""
        n = q.size
        column = 0
        phi_i, w_i = 0.0, 0.0
        for i in range(n):
            phi_i += q[i]
            w_i += dq[i]
            difference, w_j = 0.0, w_i
            for j in range(i, n):
                if j > i:
                    difference -= q[j]
                    w_j += dq[j]
                c = cos(difference)
                s = sin(difference)
                for k in range(n):
                    Yp[k, column] = 0.0
                    Yr[k, column] = 0.0
                gravity = self.r * cos(phi_i - difference) if i == 0 else 0.0
                add_column(Yp, column, i, j, c * w_j, c * w_i)
                add_column(Yr, column, i, j, s * w_i * w_j, gravity - s * w_i * w_j)
                column += 1

    def regressors(
        self, q: Array, dq: Array, v: Array, a: Array, H: Array, Yp: Array, Yr: Array
    ) -> None:
        """Compute `regressor` and `momentum_regressor` for one state."""
        self.regressor(q, dq, v, a, H)
        self.momentum_regressor(q, dq, Yp, Yr)


@inner
def add_column(Y: Array, column: int, i: int, j: int, Q_i: float, Q_j: float) -> None:
    """Add the torques Q_i, Q_j of P_ij about the absolute angles to the joint torques of a column.

    On the diagonal both belong to the same angle, and only Q_j counts.
    """
    for k in range(j + 1):
        Y[k, column] += Q_j
        if k <= i and i != j:
            Y[k, column] += Q_i
