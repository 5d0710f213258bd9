# SPDX-License-Identifier: Apache-2.0
"""The ten inertial parameters of a body, and its pseudo-inertia, by which they move and add."""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.numerics.algebra import product

INERTIA_NAMES = ('m', 'm*cx', 'm*cy', 'm*cz', 'Ixx', 'Ixy', 'Iyy', 'Ixz', 'Iyz', 'Izz')
"""The ten inertial parameters of a body, about the origin and along the axes of a frame."""

INERTIA_UNITS = ('kg', *('kg m',) * 3, *('kg m^2',) * 6)


def pseudo_inertia(inertia: np.ndarray) -> np.ndarray:
    """Return the pseudo-inertia J (4, 4) of the ten.

    A placement T (4, 4) maps it to T J T^T.

    Physical consistency requires J >= 0 (Wensing, Kim and Slotine, Linear matrix
    inequalities for physically consistent inertial parameter identification, 2018).
    """
    m, hx, hy, hz, xx, xy, yy, xz, yz, zz = inertia
    half = 0.5 * (xx + yy + zz)
    return np.array(
        [
            [half - xx, -xy, -xz, hx],
            [-xy, half - yy, -yz, hy],
            [-xz, -yz, half - zz, hz],
            [hx, hy, hz, m],
        ]
    )


def moved(J: np.ndarray, placement: np.ndarray) -> np.ndarray:
    """Return a pseudo-inertia (4, 4) in the frame in which its own has this placement (4, 4)."""
    return product(product(placement, J), placement.T)


def rotational_inertia(J: np.ndarray) -> np.ndarray:
    """Return the matrix (3, 3) of the moments of inertia [kg m^2] of a pseudo-inertia."""
    I: np.ndarray = np.trace(J[:3, :3]) * np.eye(3) - J[:3, :3]
    return I


def inertia_of(J: np.ndarray) -> np.ndarray:
    """Return the ten (10,) of a pseudo-inertia (4, 4)."""
    I = rotational_inertia(J)
    return np.array(
        [J[3, 3], *J[:3, 3], I[0, 0], I[0, 1], I[1, 1], I[0, 2], I[1, 2], I[2, 2]]
    )
