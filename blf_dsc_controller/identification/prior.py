# SPDX-License-Identifier: Apache-2.0
"""Prior of the identified values, in deviations from the URDF, and the most likely of them.

The values (17 n + 14,) of n bodies and joints are in the order of `Parts`.

The most likely values over physical bodies only are a convex problem, solved by the barrier method:

    minimise  |A z - b|^2 / 2 + |z|^2 / 2  - mu sum_i log det J_i(z) - mu sum_k log s_k(z)

with the pseudo-inertias J_i > 0 and scalars s_k > 0 affine in z, by Newton steps with decreasing mu
(Boyd and Vandenberghe, Convex Optimization, 2004, chapter 11).  At the end the sum of squares is at
most mu times the number of rows of all J_i and s_k above its minimum.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.arms.base_parameters import (
    CENTRE,
    LINKS,
    PAYLOAD_SIZE,
    BaseParameters,
    deviations,
    payload_inertia,
)
from blf_dsc_controller.arms.serial_chain import ROTOR
from blf_dsc_controller.arms.urdf import Chain, inertia_of, pseudo_inertia
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.identification.recording import COUPLING, LOAD
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
_POSITIVE = 4  # the first four of them cannot be negative
_OPTIONAL = [3, 5, 6]  # in the model only of joints whose recording shows them

_DELAY = 0.005  # s
_FRICTION = 0.3  # of a joint's largest torque; viscous friction: at its largest speed
_OFFSET = 0.05  # of the largest torque
_LOAD = 0.1  # of the torque of gravity
_ROTOR = 100.0  # rad/s^2 or m/s^2, acceleration of the rotor alone by the largest torque
_NEAREST = 0.01  # of a body's mass and extent: least value at which the search begins
_LAST = 1e-3  # mu; one standard deviation adds 0.5 to the objective
_STEPS = 100


class Parts(NamedTuple):
    """Parts of the values of n bodies and joints, or of their indices, as views."""

    bodies: Floats  # (n, 10) inertial parameters
    terms: Floats  # (7, n) JOINT_TERMS
    coupling: Floats  # (3,) of the last two joints: inertia, viscous and Coulomb friction
    load: Floats  # (10,) inertial parameters of a load that is picked up
    delay: Floats  # (1,) of the torques, s


def parts(values: np.ndarray) -> Parts:
    """Return the parts of values (17 n + 14,)."""
    n = (values.size - COUPLING - LOAD - 1) // (10 + len(JOINT_TERMS))
    bodies, terms, *others = np.split(values, np.cumsum((10 * n, 7 * n, COUPLING, LOAD)))
    return Parts(bodies.reshape(n, 10), terms.reshape(-1, n), *others)


class Cone(NamedTuple):
    """A symmetric matrix (d, d) that must be positive definite: J0 + sum_a z[at + a] E[a]."""

    at: int
    J0: Floats  # (d, d)
    E: Floats  # (k, d, d)

    def of(self, z: Floats) -> Floats:
        """Return the matrix at z."""
        part = z[self.at : self.at + self.E.shape[0]]
        return np.asarray(self.J0 + np.tensordot(part, self.E, 1))


class Prior(NamedTuple):
    """Values  mean + D z  with z of zero mean and unit covariance; physical inside all cones."""

    mean: Floats  # (k,), k = 17 n + 14
    D: Floats  # (k, k)
    cones: list[Cone]
    start: Floats  # (k,) z inside all cones

    @property
    def optional(self) -> list[tuple[int, ...]]:
        """Entries of z that are in the model together or not at all: friction, the coupling."""
        at = parts(np.arange(self.mean.size))
        return [*((k,) for k in at.terms[_OPTIONAL].ravel().tolist()), tuple(at.coupling.tolist())]

    def only(self, kept: Collection[tuple[int, ...]]) -> Prior:
        """Return the prior in which optional entries that are not kept are zero."""
        D, out = self.D.copy(), [k for entry in self.optional if entry not in kept for k in entry]
        D[:, out] = 0.0
        return self._replace(D=D, cones=[cone for cone in self.cones if cone.at not in out])


def prior_of(robot: Robot, chain: Chain, torque: Floats, speed: Floats, *, load: bool) -> Prior:
    """Return the prior of a chain: inertias as for learning, joint terms scaled by the recording.

    `torque` and `speed` (n,) are the largest of each joint; `load` says whether one is picked up.
    """
    from scipy.linalg import block_diag

    n = len(chain.joints)
    at = parts(np.arange(17 * n + COUPLING + LOAD + 1))
    blocks, start, cones = [], [], []
    for i, joint in enumerate(chain.joints):
        D = deviations(pseudo_inertia(joint.inertia), LINKS, CENTRE)
        if i == n - 1:
            J = chain.tip_placement @ payload_inertia(robot.payload) @ chain.tip_placement.T
            both = np.column_stack((D, deviations(J, 1.0, PAYLOAD_SIZE)))
            D = np.transpose(np.linalg.qr(both.T, mode='r'))
        own = pseudo_inertia(joint.inertia) - joint.held
        inside = inertia_of(_inside(own, joint.inertia[0]) + joint.held)
        blocks.append(D)
        start.append(np.linalg.solve(D, inside - joint.inertia))
        cones.append(Cone(at.bodies[i, 0], own, np.array([pseudo_inertia(d) for d in D.T])))
    rotors = robot.rotors(chain)
    damping, friction = np.transpose([(joint.damping, joint.friction) for joint in chain.joints])
    means = np.concatenate((rotors, damping, friction, np.zeros(4 * n + COUPLING)))
    rotor, coulomb = np.maximum(rotors, torque / _ROTOR), _FRICTION * torque
    viscous = coulomb / speed
    joint_terms = (
        *(rotor, viscous, coulomb, np.full(n, _LOAD)),
        *(_OFFSET * torque, coulomb, viscous / speed),
    )
    if load:
        J = payload_inertia(max(robot.payload, 1.0))
        of_load = deviations(chain.tip_placement @ J @ chain.tip_placement.T, 1.0, 2 * PAYLOAD_SIZE)
        E = np.array([pseudo_inertia(d) for d in of_load.T])
        cones.append(Cone(at.load[0], np.zeros((4, 4)), E))
    else:
        of_load = np.zeros((LOAD, LOAD))
    coupling = [each[-1] for each in (rotor, viscous, coulomb)]
    spread = np.concatenate((*joint_terms, coupling))
    first = np.zeros(spread.size)
    for k in (np.append(at.terms[:_POSITIVE], at.coupling) - 10 * n).tolist():
        cones.append(Cone(10 * n + k, means[[[k]]], spread[[[[k]]]]))
        first[k] = 0.1
    return Prior(
        mean=np.concatenate((chain.inertias.ravel(), means, np.zeros(LOAD + 1))),
        D=block_diag(*blocks, np.diag(spread), of_load, _DELAY),
        cones=cones,
        start=np.concatenate((*start, first, 0.1 * np.eye(LOAD + 1)[0])),
    )


def _inside(J: Floats, mass: float) -> Floats:
    """Return a physical pseudo-inertia near J (4, 4); `mass` [kg] sets the scale."""
    scale = np.sqrt(mass) * np.array([CENTRE, CENTRE, CENTRE, 1.0])
    values, axes = np.linalg.eigh(J / np.outer(scale, scale))
    L = scale[:, None] * axes * np.sqrt(np.maximum(values, _NEAREST))
    return np.asarray(L @ L.T)


def base_matrix(parameters: BaseParameters, n: int) -> Floats:
    """Return the matrix (p + 6 n + 14, 17 n + 14) to [P; COLUMNS; COUPLING; LOAD; delay]."""
    K = parameters.K.reshape(-1, n, ROTOR + 1)
    p = K.shape[0]
    others = 6 * n + COUPLING + LOAD + 1
    G = np.zeros((p + others, 11 * n + others))
    G[:p, : 10 * n] = K[:, :, :ROTOR].reshape(p, -1)
    G[:p, 10 * n : 11 * n] = K[:, :, ROTOR]
    G[p:, 11 * n :] = np.eye(others)
    return G


def solve(A: Floats, b: Floats, cones: list[Cone], z: Floats) -> Floats:
    """Return the minimum, starting from z inside all cones; raises BlfDscError if not found."""
    mu = max(1.0, float(np.sum((A @ z - b) ** 2)))
    while mu > _LAST:
        mu = max(_LAST, 0.1 * mu)
        for _ in range(_STEPS):
            gradient, hessian = A.T @ (A @ z - b) + z, A.T @ A + np.eye(z.size)
            for cone in cones:
                own = slice(cone.at, cone.at + cone.E.shape[0])
                T = np.linalg.solve(cone.of(z), cone.E)
                gradient[own] -= mu * np.trace(T, axis1=1, axis2=2)
                hessian[own, own] += mu * np.einsum('aij,bji->ab', T, T)
            step = np.linalg.solve(hessian, -gradient)
            decrement = float(-gradient @ step)
            if decrement < 1e-3 * mu:
                break
            size, before = 1.0, _objective(A, b, cones, z, mu)
            while _objective(A, b, cones, z + size * step, mu) > before - 0.1 * size * decrement:
                size *= 0.5
                if size < 1e-9:
                    break
            z = z + size * step
        else:
            raise BlfDscError(f'no physical inertias found in {_STEPS} Newton steps')
    return z


def _objective(A: Floats, b: Floats, cones: list[Cone], z: Floats, mu: float) -> float:
    value = 0.5 * float(np.sum((A @ z - b) ** 2) + z @ z)
    for cone in cones:
        try:
            L = np.linalg.cholesky(cone.of(z))
        except np.linalg.LinAlgError:
            return np.inf
        value -= 2.0 * mu * float(np.log(np.diag(L)).sum())
    return value
