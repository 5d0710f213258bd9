# SPDX-License-Identifier: Apache-2.0
"""Base parameters of a chain, and the prior that its URDF gives of them.

Torques depend on the inertias by certain combinations only.  Of the columns of the full
regressor Y (ten per body, a rotor per joint), a maximal set of independent ones, Y_B,
is kept; the others are Y_D = Y_B X, so that Y phi = Y_B K phi, where K has unit columns
for B and X for D (Gautier, Numerical calculation of the base inertial parameters of
robots, 1991).  The columns are tried from base to tip, so that what a body has in
common with the bodies before it is grouped with those, which is the usual grouping.

The prior is how far a URDF may be off, and in which directions.  Bodies vary
independently, in terms of their pseudo-inertia: the mass with all that scales with it,
the centre of mass, and the spread of the mass around it.  The last body also carries a
payload.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from blf_dsc_controller.arms.inertia import inertia_of, moved, pseudo_inertia
from blf_dsc_controller.arms.serial_chain import ROTOR, SerialChain, serial_chain
from blf_dsc_controller.arms.urdf import Chain
from blf_dsc_controller.numerics.algebra import independent_columns, product

LINKS = 0.3
"""Standard deviation of the mass of a body and of its spread, relative to their values."""

CENTRE = 0.01
"""Standard deviation of the centre of mass [m].

Also the least assumed extent of a body.
"""

PAYLOAD_SIZE = 0.05
"""Extent of a payload, and standard deviation of its centre of mass from the tip [m]."""

ROTORS = 0.5
"""Standard deviation of the inertia of a drive, relative to its value."""

GUESSED_ROTORS = 4.0
"""The same of a guess by the rated torque, where rows are compared with what is known.

The inertias published for an FR3 (libfranka) are 2.1 to 6.9 times the guess: this is their
rms error, and `HEAVIER_DRIVE` the largest.
"""

HEAVIER_DRIVE = 6.0
"""What the inertia of a drive may have beyond such a guess, over the guess."""

UNKNOWN_ROTOR = 0.01
"""The same where neither effort nor inertia is known, absolute [kg m^2, or kg]."""

# for columns of order 1; rounding of pi / 2 in URDFs gives about 1e-10
_DEPENDENT = 1e-6


@dataclass(frozen=True, eq=False)
class BaseParameters:
    """Base parameters P of a chain, and how they follow from its inertias."""

    model: SerialChain  # whose regressors multiply P, named after the kept columns
    # (p, 11 n) to P from each body's ten inertial parameters and its rotor
    K: np.ndarray
    load: np.ndarray  # (p,) what 1 kg at the tip adds to P
    combinations: tuple[str, ...]  # each as a sum, such as 'Izz2 + Iyy3 + 0.1 m4'

    def of(self, inertias: np.ndarray, rotors: np.ndarray) -> np.ndarray:
        """Return P (p,) for the ten of each body (n, 10) and the rotors (n,) [kg m^2, or kg]."""
        return product(
            self.K, np.reshape(np.column_stack((inertias, rotors)), (-1, 1))
        )[:, 0]


@functools.lru_cache(maxsize=16)
def base_parameters(chain: Chain, gravity: tuple[float, ...]) -> BaseParameters:
    """Return the base parameters of a chain; `gravity` (3,) [m/s^2] is in its base.

    They are the independent columns of the full regressor at random motions, by Gautier (1991).
    """
    full = serial_chain(chain, gravity)
    kept, X = independent_columns(_regressor_at_random(full), _DEPENDENT)
    K = np.where(np.abs(X) < _DEPENDENT, 0.0, X.round(12))
    columns = [(int(k) // (ROTOR + 1), int(k) % (ROTOR + 1)) for k in kept]
    sums = tuple(
        _sum(row, int(k), full.parameter_names) for row, k in zip(K, kept, strict=True)
    )
    point = chain.tip_placement[:, 3]
    loaded = np.zeros((full.n, ROTOR + 1))
    loaded[-1, :ROTOR] = inertia_of(np.outer(point, point))
    load = product(K, loaded.reshape(-1, 1))[:, 0]
    return BaseParameters(serial_chain(chain, gravity, columns), K, load, sums)


def _regressor_at_random(full: SerialChain) -> np.ndarray:
    """Return rows of H at random motions, twice as many as columns."""
    random = np.random.default_rng(0)
    blocks = np.zeros((2 * (ROTOR + 1), full.n, full.p))
    for H in blocks:
        q = random.uniform(-np.pi, np.pi, full.n)
        dq, v, a = random.normal(size=(3, full.n))
        full.regressor(q, dq, v, a, H)
    return blocks.reshape(-1, full.p)


def _sum(row: np.ndarray, index: int, names: tuple[str, ...]) -> str:
    text = names[index]
    for k in np.flatnonzero(row):
        if k != index:
            factor = (
                '' if abs(abs(row[k]) - 1.0) < _DEPENDENT else f'{abs(row[k]):.4g} '
            )
            text += f' {"-" if row[k] < 0.0 else "+"} {factor}{names[k]}'
    return text


def prior_factor(
    chain: Chain, base: BaseParameters, payload: float, rotors: np.ndarray
) -> np.ndarray:
    """Return L (p, k) of P = P0 + L theta, with theta (k,) of mean 0 and covariance 1.

    P0 are the base parameters of the URDF, `payload` is the rated payload of the arm
    [kg], and `rotors` (n,) are the standard deviations of the rotor inertias [kg m^2,
    or kg], which a URDF does not contain.
    """
    n = len(chain.joints)
    without_rotor = ((0, 1), (0, 0))
    blocks: list[tuple[int, np.ndarray]] = []  # body, directions (11, k) of its entries
    for i, joint in enumerate(chain.joints):
        J = pseudo_inertia(joint.inertia)
        blocks.append((i, np.pad(deviations(J, LINKS, CENTRE), without_rotor)))
    J = moved(payload_inertia(payload), chain.tip_placement)
    blocks.append((n - 1, np.pad(deviations(J, 1.0, PAYLOAD_SIZE), without_rotor)))
    blocks += [(i, rotors[i] * np.eye(ROTOR + 1)[:, ROTOR:]) for i in range(n)]
    K = base.K.reshape(-1, n, ROTOR + 1)
    return np.column_stack([product(K[:, i], block) for i, block in blocks])


def payload_inertia(payload: float) -> np.ndarray:
    """Return the pseudo-inertia (4, 4) of a payload [kg] about its centre."""
    return payload * np.diag((*(PAYLOAD_SIZE**2,) * 3, 1.0))


def deviations(J: np.ndarray, relative: float, centre: float) -> np.ndarray:
    """Return one standard deviation of the ten along each of ten independent directions (10, 10).

    Columns are directions: one that scales all, three of the centre of mass, six of the spread.

    Args:
        J: pseudo-inertia (4, 4) of a body.
        relative: standard deviation of mass and spread, relative to them.
        centre: standard deviation of the centre of mass [m].
    """
    if J[3, 3] == 0.0:
        return np.zeros((10, 10))
    directions = [relative * J]
    for k in range(3):
        D = np.zeros((4, 4))
        D[k, 3] = centre
        directions.append(product(D, J) + product(J, D.T))
    min_spread = J[3, 3] * centre**2
    L = J[:3, :3] - np.outer(J[:3, 3], J[:3, 3]) / J[3, 3] + min_spread * np.eye(3)
    for a in range(3):  # Cholesky factor of the spread, of at least the extent `centre`
        L[a:, a] /= np.sqrt(max(L[a, a], min_spread))
        L[a + 1 :, a + 1 :] -= np.outer(L[a + 1 :, a], L[a + 1 :, a])
        L[:a, a] = 0.0
    for a in range(3):
        for b in range(a + 1):
            E = np.zeros((4, 4))
            E[:3, :3] = (np.outer(L[:, a], L[:, b]) + np.outer(L[:, b], L[:, a])) / 2.0
            directions.append(relative * E * (1.0 if a == b else np.sqrt(2.0)))
    return np.transpose([inertia_of(direction) for direction in directions])
