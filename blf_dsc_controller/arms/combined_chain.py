# SPDX-License-Identifier: Apache-2.0
"""Serial chain with only some combinations of the inertias unknown: an `ArmModel`.

Its regressors are those of all inertias of the chain times a constant matrix, H = Y T^T; a row of T
(p, 11 n) holds the inertias of one or all bodies that a unit of one parameter contributes.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from blf_dsc_controller.arms.chain_kernels import (
    ROTOR,
    bodies_of,
    fill_momentum_regressor,
    fill_regressor,
    fill_regressors,
)
from blf_dsc_controller.arms.inertia import INERTIA_NAMES, INERTIA_UNITS
from blf_dsc_controller.arms.serial_chain import SerialChain
from blf_dsc_controller.compiled.jit import called
from blf_dsc_controller.compiled.layout import Array, pack, view_of


class Combination(NamedTuple):
    """The matrix T, and working memory."""

    n: int
    p: int
    width: int  # of Y, 11 n
    entries: int  # number of nonzero entries of T
    column: Annotated[Array, 'p']  # index in `column_names`
    row: Annotated[Array, 'entries']  # of each entry of T
    at: Annotated[Array, 'entries']  # its column, in T and in Y
    value: Annotated[Array, 'entries']
    Y: Annotated[Array, 3, 'n', 'width']


combination_of = view_of(Combination)


class CombinedChain(NamedTuple):
    """Arm of any serial chain with few unknowns: an `ArmModel`.

    It contains its working memory, so each thread needs its own.
    """

    n: int
    p: int
    bodies: Array  # Bodies, with all inertias
    combination: Array  # Combination

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the entries of P."""
        names = column_names(self.n)
        return tuple(names[int(k)] for k in combination_of(self.combination).column)

    @property
    def parameter_units(self) -> tuple[str, ...]:
        """Units of the entries of P: none for factors, kg for the rotor of a prismatic joint."""
        units = ['kg m^2' if axis[:3].any() else 'kg' for axis in bodies_of(self.bodies).axis]
        units += [*INERTIA_UNITS, '']
        return tuple(units[int(k)] for k in combination_of(self.combination).column)

    def regressor(self, q: Array, dq: Array, v: Array, a: Array, H: Array) -> None:
        """Fill H (n, p) so that H P = M(q) a + C(q, dq) v + G(q)   [N m], Property III."""
        c = combination_of(self.combination)
        fill_regressor(self.bodies, q, dq, v, a, c.Y[0])
        combine(c, c.Y[0], H)

    def momentum_regressor(self, q: Array, dq: Array, Yp: Array, Yr: Array) -> None:
        """Fill Yp, Yr (n, p) so that Yp P = M dq [N m s] and Yr P = G - C^T dq [N m]."""
        c = combination_of(self.combination)
        fill_momentum_regressor(self.bodies, q, dq, c.Y[1], c.Y[2])
        combine(c, c.Y[1], Yp)
        combine(c, c.Y[2], Yr)

    def regressors(
        self, q: Array, dq: Array, v: Array, a: Array, H: Array, Yp: Array, Yr: Array
    ) -> None:
        """Compute `regressor` and `momentum_regressor` in one pass along the chain."""
        c = combination_of(self.combination)
        fill_regressors(self.bodies, q, dq, v, a, c.Y[0], c.Y[1], c.Y[2])
        combine(c, c.Y[0], H)
        combine(c, c.Y[1], Yp)
        combine(c, c.Y[2], Yr)


@called
def combine(c: Combination, Y: Array, out: Array) -> None:
    """Fill `out` (n, p) with Y T^T; row i of Y (n, width) is zero for the bodies before i."""
    for i in range(c.n):
        for j in range(c.p):
            out[i, j] = 0.0
    for entry in range(c.entries):
        j, k, value = int(c.row[entry]), int(c.at[entry]), c.value[entry]
        for i in range(k // (ROTOR + 1) + 1):
            out[i, j] += Y[i, k] * value


def column_names(n: int) -> tuple[str, ...]:
    """Return the names of all possible unknowns: rotors, then load and links."""
    rotors = tuple(f'rotor{i + 1}' for i in range(n))
    return (*rotors, *(f'load {name}' for name in INERTIA_NAMES), 'links')


def combined_chain(whole: SerialChain, columns: Array, T: Array) -> CombinedChain:
    """Return the model of the unknowns `columns` (p,) of `column_names`; T (p, 11 n): inertias."""
    p, width = T.shape
    row, at = np.nonzero(T)
    combination = Combination(
        n=whole.n,
        p=p,
        width=width,
        entries=row.size,
        column=columns,
        row=row,
        at=at,
        value=T[row, at],
        Y=np.zeros((3, whole.n, width)),
    )
    return CombinedChain(whole.n, p, whole.vector, pack(combination))
