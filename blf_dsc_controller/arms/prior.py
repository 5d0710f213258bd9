# SPDX-License-Identifier: Apache-2.0
"""How far the inertias of a URDF may be off: the scale and the directions of what is learned.

Each body by itself, in terms of its pseudo-inertia: its mass with all that goes with it, where its
centre of mass is, and how its mass is spread around that.  The last body carries a payload, too.
"""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.arms.base_parameters import BaseParameters
from blf_dsc_controller.arms.chain_kernels import ROTOR
from blf_dsc_controller.arms.inertia import inertia_of, pseudo_inertia
from blf_dsc_controller.arms.urdf import Chain

LINKS = 0.3
"""Standard deviation of the mass of a body and of its spread, of their values."""

CENTRE = 0.01
"""Standard deviation of the centre of mass [m]; also the least extent that a body is taken for."""

PAYLOAD_SIZE = 0.05
"""Extent of a payload, and standard deviation of its centre of mass from the tip [m]."""

ROTORS = 0.5
"""Standard deviation of the inertia of a drive, of its value ..."""

UNKNOWN_ROTOR = 0.01
"""... and where it is 0, because neither the effort nor the inertia is known [kg m^2, or kg]."""


def prior_factor(
    chain: Chain, parameters: BaseParameters, payload: float, rotors: np.ndarray
) -> np.ndarray:
    """Lower triangular L (p, p) of P = P0 + L theta; theta (p,) has mean zero and covariance one.

    P0 are the base parameters of the URDF, `payload` is what the arm is rated for [kg], and
    `rotors` (n,) are the standard deviations of the rotor inertias [kg m^2, or kg], which no URDF
    tells.
    """
    n = len(chain.joints)
    blocks: list[tuple[int, np.ndarray]] = []  # of a body, directions (11, k) of its entries
    for i, joint in enumerate(chain.joints):
        J = pseudo_inertia(joint.inertia)
        blocks.append((i, _of_ten(deviations(J, LINKS, CENTRE))))
    J = chain.tip_placement @ payload_inertia(payload) @ chain.tip_placement.T
    blocks.append((n - 1, _of_ten(deviations(J, 1.0, PAYLOAD_SIZE))))
    blocks += [(i, rotors[i] * np.eye(ROTOR + 1)[:, ROTOR:]) for i in range(n)]
    K = parameters.K.reshape(-1, n, ROTOR + 1)
    L = np.column_stack([K[:, i] @ block for i, block in blocks])
    R = np.linalg.qr(L.T, mode='r')  # Cholesky's factor of L L^T, without squaring the rounding
    return np.transpose(R * np.copysign(1.0, np.diag(R))[:, None])


def payload_inertia(payload: float) -> np.ndarray:
    """Pseudo-inertia (4, 4) of a payload [kg] about its centre."""
    return payload * np.diag((*(PAYLOAD_SIZE**2,) * 3, 1.0))


def _of_ten(directions: np.ndarray) -> np.ndarray:
    """Directions (10, k) of the ten as (11, k), with the rotor."""
    return np.vstack((directions, np.zeros((1, directions.shape[1]))))


def deviations(J: np.ndarray, share: float, centre: float) -> np.ndarray:
    """One standard deviation of the ten (10, 10) along each of ten independent directions.

    `share` is that of the mass and of the spread, `centre` that of the centre of mass [m].
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
