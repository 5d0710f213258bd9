# SPDX-License-Identifier: Apache-2.0
"""Prior of the identified values, in standard deviations from the URDF.

The values (14 n + 1,) of n bodies and joints are the ten inertial parameters of each body, then
each of the four JOINT_TERMS for all joints, and last the delay of the torques.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.arms.base_parameters import BaseParameters
from blf_dsc_controller.arms.chain_kernels import ROTOR
from blf_dsc_controller.arms.inertia import inertia_of, pseudo_inertia
from blf_dsc_controller.arms.prior import CENTRE, LINKS, PAYLOAD_SIZE, deviations
from blf_dsc_controller.arms.urdf import Chain
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.identification.physical import Cone
from blf_dsc_controller.run import Floats

JOINT_TERMS = ('rotor inertia', 'viscous friction', 'Coulomb friction', 'offset')
_POSITIVE = 3  # the first three of them cannot be negative

_DELAY = 0.005  # s
_FRICTION = 0.3  # of a joint's largest torque; viscous friction: at its largest speed
_OFFSET = 0.05  # of the largest torque
_ROTOR = 100.0  # rad/s^2 or m/s^2, acceleration of the rotor alone by the largest torque
_NEAREST = 0.01  # of a body's mass and extent: least value at which the search begins


class Prior(NamedTuple):
    """Values  mean + D z  with z of zero mean and unit covariance; physical inside all cones."""

    mean: Floats  # (14 n + 1,)
    D: Floats  # (14 n + 1, 14 n + 1)
    cones: list[Cone]
    start: Floats  # (14 n + 1,) z inside all cones


def prior_of(
    robot: Robot, chain: Chain, held: Sequence[Floats], torque: Floats, speed: Floats
) -> Prior:
    """Return the prior of a chain: inertias as for learning, joint terms scaled by the recording.

    `held` are lower bounds (4, 4) of the pseudo-inertias of the bodies; `torque` and `speed` (n,)
    are the largest of each joint.
    """
    from scipy.linalg import block_diag

    n = len(chain.joints)
    blocks, start, cones = [], [], []
    for i, joint in enumerate(chain.joints):
        D = deviations(pseudo_inertia(joint.inertia), LINKS, CENTRE)
        if i == n - 1:
            load = robot.payload * np.diag((*(PAYLOAD_SIZE**2,) * 3, 1.0))
            J = chain.tip_placement @ load @ chain.tip_placement.T
            both = np.column_stack((D, deviations(J, 1.0, PAYLOAD_SIZE)))
            D = np.transpose(np.linalg.qr(both.T, mode='r'))
        own = pseudo_inertia(joint.inertia) - held[i]
        inside = inertia_of(_inside(own, joint.inertia[0]) + held[i])
        blocks.append(D)
        start.append(np.linalg.solve(D, inside - joint.inertia))
        cones.append(Cone(10 * i, own, np.array([pseudo_inertia(d) for d in D.T])))
    rotors = robot.rotors(chain)
    damping, friction = np.transpose([(joint.damping, joint.friction) for joint in chain.joints])
    means = np.concatenate((rotors, damping, friction, np.zeros(n)))
    spread = np.concatenate(
        (
            np.maximum(rotors, torque / _ROTOR),
            _FRICTION * torque / speed,
            _FRICTION * torque,
            _OFFSET * torque,
        )
    )
    for k in range(_POSITIVE * n):
        cones.append(Cone(10 * n + k, means[[[k]]], spread[[[[k]]]]))
        start.append(np.full(1, 0.1))
    return Prior(
        mean=np.concatenate((chain.inertias.ravel(), means, [0.0])),
        D=block_diag(*blocks, np.diag(spread), _DELAY),
        cones=cones,
        start=np.concatenate((*start, np.zeros(n + 1))),
    )


def _inside(J: Floats, mass: float) -> Floats:
    """Return a physical pseudo-inertia near J (4, 4); `mass` [kg] sets the scale."""
    scale = np.sqrt(mass) * np.array([CENTRE, CENTRE, CENTRE, 1.0])
    values, axes = np.linalg.eigh(J / np.outer(scale, scale))
    L = scale[:, None] * axes * np.sqrt(np.maximum(values, _NEAREST))
    return np.asarray(L @ L.T)


def columns_of(parameters: BaseParameters, n: int) -> Floats:
    """Return the matrix (p + 3 n + 1, 14 n + 1) to [P; viscous; Coulomb; offset; delay]."""
    K = parameters.K.reshape(-1, n, ROTOR + 1)
    p = K.shape[0]
    G = np.zeros((p + 3 * n + 1, 14 * n + 1))
    G[:p, : 10 * n] = K[:, :, :ROTOR].reshape(p, -1)
    G[:p, 10 * n : 11 * n] = K[:, :, ROTOR]
    G[p:, 11 * n :] = np.eye(3 * n + 1)
    return G
