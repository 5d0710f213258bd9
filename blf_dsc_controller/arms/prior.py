# SPDX-License-Identifier: Apache-2.0
"""How far the inertias of a URDF are off, as a covariance: the scale of what is learned.

Each body by itself, in terms of its pseudo-inertia: its mass with all that goes with it, where its
centre of mass is, and how its mass is spread around that.  The last body carries a payload, too.
"""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.arms.base_parameters import BaseParameters
from blf_dsc_controller.arms.inertia import INERTIA_NAMES, inertia_of, pseudo_inertia
from blf_dsc_controller.arms.urdf import Chain

LINKS = 0.3
"""Standard deviation of the mass of a body and of its spread, of their values."""

CENTRE = 0.01
"""Standard deviation of the centre of mass [m]; also the least extent that a body is taken for."""

PAYLOAD_SIZE = 0.05
"""Extent of a payload, and standard deviation of its centre of mass from the tip [m]."""


def prior_covariance(
    chain: Chain, parameters: BaseParameters, payload: float, rotors: np.ndarray
) -> np.ndarray:
    """Covariance (p, p) of the base parameters about those of the URDF.

    `payload` is what the arm is rated for [kg], `rotors` (n,) are the standard deviations of the
    rotor inertias [kg m^2, or kg], which no URDF tells.
    """
    n = len(chain.joints)
    rotor = len(INERTIA_NAMES)
    covariance = np.zeros((n, rotor + 1, n, rotor + 1))
    for i, joint in enumerate(chain.joints):
        A = _deviations(pseudo_inertia(joint.inertia), LINKS, CENTRE)
        covariance[i, :rotor, i, :rotor] = A @ A.T
        covariance[i, rotor, i, rotor] = rotors[i] ** 2
    load = payload * np.diag((*(PAYLOAD_SIZE**2,) * 3, 1.0))
    tip = chain.tip_placement
    A = _deviations(tip @ load @ tip.T, 1.0, PAYLOAD_SIZE)
    covariance[-1, :rotor, -1, :rotor] += A @ A.T
    full = covariance.reshape(n * (rotor + 1), -1)
    of_base: np.ndarray = parameters.K @ full @ parameters.K.T
    return of_base


def _deviations(J: np.ndarray, share: float, centre: float) -> np.ndarray:
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
