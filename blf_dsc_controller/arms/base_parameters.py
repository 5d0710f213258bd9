# SPDX-License-Identifier: Apache-2.0
"""Base parameters of a chain: the combinations of its inertias that torques can show.

Of the columns of the full regressor Y (ten per body, a rotor per joint), a maximal set of
independent ones, Y_B, is kept; the others are Y_D = Y_B X, so that Y phi = Y_B K phi, where K has
unit columns for B and X for D (Gautier, Numerical calculation of the base inertial parameters of
robots, 1991).  The columns are tried from base to tip, so that what a body has in common with the
bodies before it is grouped with those, which is the usual grouping.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from blf_dsc_controller.arms.chain_kernels import ROTOR
from blf_dsc_controller.arms.serial_chain import SerialChain, serial_chain
from blf_dsc_controller.arms.urdf import Chain

_DEPENDENT = 1e-6  # for columns of order 1; rounding of pi / 2 in URDFs gives about 1e-10


@dataclass(frozen=True, eq=False)
class BaseParameters:
    """Base parameters P of a chain.

    Attributes:
        model: the arm model whose regressors multiply P, named after the kept columns.
        K: (p, 11 n), maps all inertias to P: per body its ten inertial parameters and its rotor.
        combinations: (p,) each parameter as a sum, such as 'Izz2 + Iyy3 + 0.1 m4'.
    """

    model: SerialChain
    K: np.ndarray
    combinations: tuple[str, ...]

    def of(self, inertias: np.ndarray, rotors: np.ndarray) -> np.ndarray:
        """Return P (p,) for the ten of each body (n, 10) and the rotors (n,) [kg m^2, or kg]."""
        P: np.ndarray = self.K @ np.column_stack((inertias, rotors)).ravel()
        return P


@functools.lru_cache(maxsize=16)
def base_parameters(
    chain: Chain, gravity: tuple[float, float, float] = (0.0, 0.0, -9.81), *, rotors: bool = True
) -> BaseParameters:
    """Return a chain's base parameters, with or without rotors; gravity [m/s^2] is in its base."""
    full = serial_chain(chain, gravity)
    order = np.array([k for k in range(full.p) if rotors or k % (ROTOR + 1) != ROTOR])
    kept, K = independent(stacked_regressor(full), order)
    if not rotors:
        K[:, ROTOR :: ROTOR + 1] = 0.0
    columns = [(int(k) // (ROTOR + 1), int(k) % (ROTOR + 1)) for k in kept]
    sums = tuple(_sum(row, int(k), full.parameter_names) for row, k in zip(K, kept, strict=True))
    return BaseParameters(serial_chain(chain, gravity, columns), K, sums)


def independent(Y: np.ndarray, order: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the independent columns (p,) of Y, tried in `order`, and K of Y = Y[:, columns] K."""
    pivots = np.abs(np.diag(np.linalg.qr(Y[:, order], mode='r')))
    kept = order[pivots > _DEPENDENT]
    # Rounded, so that every machine's linear algebra gives the same result.
    K: np.ndarray = np.linalg.lstsq(Y[:, kept], Y, rcond=None)[0].round(12)
    K[np.abs(K) < _DEPENDENT] = 0.0
    return kept, K


def stacked_regressor(full: SerialChain) -> np.ndarray:
    """Return rows of H at random motions, twice as many as columns."""
    random = np.random.default_rng(0)
    blocks = np.zeros((2 * (ROTOR + 1), full.n, full.p))
    for H in blocks:
        q = random.uniform(-np.pi, np.pi, full.n)
        dq, v, a = random.normal(size=(3, full.n))
        full.regressor(q, dq, v, a, H)
    return blocks.reshape(-1, full.p)


def _sum(row: np.ndarray, own: int, names: tuple[str, ...]) -> str:
    text = names[own]
    for k in np.flatnonzero(row):
        if k != own:
            factor = '' if abs(abs(row[k]) - 1.0) < _DEPENDENT else f'{abs(row[k]):.4g} '
            text += f' {"-" if row[k] < 0.0 else "+"} {factor}{names[k]}'
    return text
