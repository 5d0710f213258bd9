# SPDX-License-Identifier: Apache-2.0
"""The unknowns of identification: bodies, terms of each joint, coupling, load, delay.

The friction of a joint with speed v, and sliding direction s of `sliding`, is the sum
of

    viscous     v                          Stribeck    s exp(-(v / v_s)^2)
    Coulomb     s                          quadratic   v |v|
    load        |G| s, with the torque G of gravity: gears lose what they carry

A motor that drives the last two joints, which are then coupled, adds to each of them
the same Coulomb friction s(v_1 + v_2), and viscous friction and inertia times the speed
and acceleration of the other.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blf_dsc_controller.arms.base_parameters import BaseParameters
from blf_dsc_controller.arms.serial_chain import ROTOR
from blf_dsc_controller.run import Floats

JOINT_TERMS = (
    'rotor inertia',
    'viscous friction',
    'Coulomb friction',
    'load friction',
    'offset',
    'Stribeck friction',
    'quadratic friction',
)
"""Terms of each joint: rows of `Parts.terms`."""

(ROTOR_INERTIA, VISCOUS, COULOMB, LOAD_FRICTION, OFFSET, STRIBECK, QUADRATIC) = range(7)

POSITIVE = 4
"""The first four terms cannot be negative."""

OPTIONAL = (LOAD_FRICTION, STRIBECK, QUADRATIC)
"""Terms that the model has only of joints whose recording shows them."""

COUPLING = 3
"""Terms of a coupling of the last two joints: inertia, viscous and Coulomb friction."""

LOAD = 10
"""Inertial parameters of a load that is picked up."""

_UNITS = {
    'revolute': ('kg m^2', 'N m s', 'N m', 'N m / N m', 'N m', 'N m', 'N m s^2'),
    'prismatic': ('kg', 'N s/m', 'N', 'N / N', 'N', 'N', 'N s^2/m^2'),
}


class Parts(NamedTuple):
    """Parts of the values of n bodies and joints, or of their indices, as views."""

    bodies: Floats  # (n, 10) inertial parameters
    terms: Floats  # (7, n) JOINT_TERMS
    # (3,) of the last two joints: inertia, viscous and Coulomb friction
    coupling: Floats
    load: Floats  # (10,) inertial parameters of a load that is picked up
    delay: Floats  # (1,) of the torques, s


def parts(values: np.ndarray) -> Parts:
    """Return the parts of values (17 n + 14,)."""
    terms_of_joint = len(JOINT_TERMS)
    n = (values.size - COUPLING - LOAD - 1) // (10 + terms_of_joint)
    ends = np.cumsum((10 * n, terms_of_joint * n, COUPLING, LOAD))
    bodies, terms, *others = np.split(values, ends)
    return Parts(bodies.reshape(n, 10), terms.reshape(-1, n), *others)


def indices(n: int) -> Parts:
    """Return the indices of the parts of the values of n joints."""
    return parts(np.arange((10 + len(JOINT_TERMS)) * n + COUPLING + LOAD + 1))


def units_of(kind: str) -> tuple[str, ...]:
    """Return the units of JOINT_TERMS for a kind of joint of a URDF."""
    return _UNITS['prismatic' if kind == 'prismatic' else 'revolute']


def base_matrix(parameters: BaseParameters, n: int) -> Floats:
    """Return the matrix (p + 6 n + 14, 17 n + 14) to [P; COLUMNS; COUPLING; LOAD; delay]."""
    K = parameters.K.reshape(-1, n, ROTOR + 1)
    p = K.shape[0]
    others = (len(JOINT_TERMS) - 1) * n + COUPLING + LOAD + 1
    G = np.zeros((p + others, 11 * n + others))
    G[:p, : 10 * n] = K[:, :, :ROTOR].reshape(p, -1)
    G[:p, 10 * n : 11 * n] = K[:, :, ROTOR]
    G[p:, 11 * n :] = np.eye(others)
    return G
