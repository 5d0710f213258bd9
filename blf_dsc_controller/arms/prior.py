# SPDX-License-Identifier: Apache-2.0
"""Prior on the inertias of a URDF: how far they may be off, and in which directions.

Bodies vary independently, in terms of their pseudo-inertia: the mass with all that scales with it,
the centre of mass, and the spread of the mass around it.  The last body also carries a payload.
"""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.arms.base_parameters import BaseParameters
from blf_dsc_controller.arms.chain_kernels import ROTOR
from blf_dsc_controller.arms.inertia import inertia_of, pseudo_inertia
from blf_dsc_controller.arms.urdf import Chain

LINKS = 0.3
"""Standard deviation of the mass of a body and of its spread, relative to their values."""

CENTRE = 0.01
"""Standard deviation of the centre of mass [m]; also the least assumed extent of a body."""

PAYLOAD_SIZE = 0.05
"""Extent of a payload, and standard deviation of its centre of mass from the tip [m]."""

ROTORS = 0.5
"""Standard deviation of the inertia of a drive, relative to its value ..."""

UNKNOWN_ROTOR = 0.01
"""... and absolute where that is 0, as neither effort nor inertia is known [kg m^2, or kg]."""


def prior_factor(
    chain: Chain, parameters: BaseParameters, payload: float, rotors: np.ndarray
) -> np.ndarray:
    """Return lower triangular L (p, p) of P = P0 + L theta, with theta of mean 0 and covariance 1.

    P0 are the base parameters of the URDF, `payload` is the rated payload of the arm [kg], and
    `rotors` (n,) are the standard deviations of the rotor inertias [kg m^2, or kg], which a URDF
    does not contain.
    """
    n = len(chain.joints)
    blocks: list[tuple[int, np.ndarray]] = []  # body, directions (11, k) of its entries
    for i, joint in enumerate(chain.joints):
        J = pseudo_inertia(joint.inertia)
        blocks.append((i, _blocks_of_ten(deviations(J, LINKS, CENTRE))))
    J = chain.tip_placement @ payload_inertia(payload) @ chain.tip_placement.T
    blocks.append((n - 1, _blocks_of_ten(deviations(J, 1.0, PAYLOAD_SIZE))))
    blocks += [(i, rotors[i] * np.eye(ROTOR + 1)[:, ROTOR:]) for i in range(n)]
    K = parameters.K.reshape(-1, n, ROTOR + 1)
    L = np.column_stack([K[:, i] @ block for i, block in blocks])
    R = np.linalg.qr(L.T, mode='r')  # Cholesky factor of L L^T, without squaring rounding
    return np.transpose(R * np.copysign(1.0, np.diag(R))[:, None])


def payload_inertia(payload: float) -> np.ndarray:
    """Return the pseudo-inertia (4, 4) of a payload [kg] about its centre."""
    return payload * np.diag((*(PAYLOAD_SIZE**2,) * 3, 1.0))


def _blocks_of_ten(directions: np.ndarray) -> np.ndarray:
    """Append a rotor entry of zero to directions (10, k) of the ten, giving (11, k)."""
    return np.vstack((directions, np.zeros((1, directions.shape[1]))))


def deviations(J: np.ndarray, share: float, centre: float) -> np.ndarray:
    """Return one standard deviation of the ten along each of ten independent directions (10, 10).

    `share` is that of mass and spread, relative to them, `centre` that of the centre of mass [m].
    """
    if J[3, 3] == 0.0:
        return np.zeros((10, 10))
    directions = [share * J]
    for k in range(3):
        D = np.zeros((4, 4))
        D[k, 3] = centre
        directions.append(D @ J + J @ D.T)
    spread = J[:3, :3] - np.outer(J[:3, 3], J[:3, 3]) / J[3, 3]
    moments, axes = np.linalg.eigh(spread)
    L = axes * np.sqrt(np.maximum(moments, 0.0) + J[3, 3] * centre**2)
    for a in range(3):
        for b in range(a + 1):
            E = np.zeros((4, 4))
            E[:3, :3] = (np.outer(L[:, a], L[:, b]) + np.outer(L[:, b], L[:, a])) / 2.0
            directions.append(share * E * (1.0 if a == b else np.sqrt(2.0)))
    return np.transpose([inertia_of(direction) for direction in directions])
