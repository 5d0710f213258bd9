# SPDX-License-Identifier: Apache-2.0
"""Prior of the identified values, in deviations from the URDF.

Its widths are guesses: how far URDFs are off, how much friction drives have.  `widened`
lets data overrule them, group by group; see `selection`.

Its density is exp(-|z|^2 / 2) times the determinants of the bodies' pseudo-inertias.
They let no body lose its extent where data ask for less than none; a simulated joint
without inertia diverges.  In one dimension: over positive s, a normal density of
deviation d is largest at 0, s times that density at d, next to its mean of 0.8 d.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
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
from blf_dsc_controller.arms.inertia import inertia_of, moved, pseudo_inertia
from blf_dsc_controller.arms.urdf import Chain
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.identification.physical import Cones
from blf_dsc_controller.identification.values import (
    COULOMB,
    LOAD,
    OFFSET,
    OPTIONAL,
    POSITIVE,
    ROTOR_INERTIA,
    VISCOUS,
    Parts,
    base_matrix,
    indices,
    parts,
)
from blf_dsc_controller.run import Floats

_DELAY = 0.005  # s
_FRICTION = 0.3  # of a joint's largest torque; viscous friction: at its largest speed
_OFFSET = 0.05  # of the largest torque
_LOAD = 0.1  # of the torque of gravity
# rad/s^2 or m/s^2, acceleration of the rotor alone by the largest torque
_ROTOR = 100.0
_LIGHTEST = 1.0  # kg, of the mass that a load is expected to have
_NEAREST = 0.01  # of a body's mass and extent: least value at which the search begins
_EXTENT = 1.0  # power of the determinant of a body's pseudo-inertia
_FIRST = 0.1  # standard deviations, of what cannot be negative, where the search begins

Entry = tuple[int, ...]
"""Indices of values that are in the model together or not at all."""


class Prior(NamedTuple):
    """Values  mean + D z  with z of zero mean and unit covariance; physical inside all cones."""

    G: Floats  # (m + 1, k) from values to the unknowns theta of `Rows`, and the delay [s]
    mean: Floats  # (k,), k = 17 n + 14
    D: Floats  # (k, k)
    cones: Sequence[Cones]
    start: Floats  # (k,) z inside all cones

    @property
    def T(self) -> Floats:
        """T (m + 2, k + 1): the rows of `Weighted` times T are [A | b] of z; T (z, -1) is theta."""
        columns = self.G @ np.column_stack((self.D, -self.mean))
        return np.vstack((columns, np.eye(1, self.mean.size + 1, self.mean.size)))

    @property
    def at(self) -> Parts:
        """Indices of the parts of the values, and of z."""
        return parts(np.arange(self.mean.size))

    @property
    def optional(self) -> list[Entry]:
        """Entries of z that are in the model together or not at all: friction, the coupling."""
        friction = self.at.terms[list(OPTIONAL)].ravel().tolist()
        return [*((k,) for k in friction), tuple(self.at.coupling.tolist())]

    @property
    def groups(self) -> dict[str, Entry]:
        """Entries of z whose width is one guess, by name."""
        at = self.at
        friction = at.terms[[VISCOUS, COULOMB]]
        return {
            'bodies': tuple(at.bodies.ravel().tolist()),
            'rotors': tuple(at.terms[ROTOR_INERTIA].tolist()),
            'friction': tuple(friction.ravel().tolist()),
            'offsets': tuple(at.terms[OFFSET].tolist()),
        }

    def only(self, kept: Collection[Entry]) -> Prior:
        """Return the prior in which optional entries that are not kept are zero."""
        dropped = [k for entry in self.optional if entry not in kept for k in entry]
        D = self.D.copy()
        D[:, dropped] = 0.0
        cones = [each.but(dropped) for each in self.cones]
        return self._replace(D=D, cones=cones)

    def widened(self, factors: Floats) -> Prior:
        """Return the prior with deviations (k,) times as wide."""
        cones = [
            each._replace(E=each.E * factors[each.entries][:, :, None, None])
            for each in self.cones
        ]
        return self._replace(
            D=self.D * factors, cones=cones, start=self.start / factors
        )


def prior_of(
    robot: Robot,
    chain: Chain,
    parameters: BaseParameters,
    torque: Floats,
    speed: Floats,
    *,
    load: bool,
) -> Prior:
    """Return the prior of a chain: inertias as for learning, joint terms scaled by the recording.

    `torque` and `speed` (n,) are the largest of each joint; `load` says whether one is
    picked up.
    """
    from scipy.linalg import block_diag

    n = len(chain.joints)
    at = indices(n)
    mean = np.zeros(at.delay[0] + 1)
    start = np.zeros_like(mean)
    mean[at.bodies] = chain.inertias
    bodies = []  # entries, J0, E and power of their cones
    blocks = []
    for i, joint in enumerate(chain.joints):
        D = deviations(pseudo_inertia(joint.inertia), LINKS, CENTRE)
        if i == n - 1:
            D = _with_payload(D, chain, robot.payload)
        blocks.append(D)
        own = pseudo_inertia(joint.inertia) - joint.held
        inside = inertia_of(_inside(own, joint.inertia[0]) + joint.held)
        start[at.bodies[i]] = np.linalg.solve(D, inside - joint.inertia)
        bodies.append((at.bodies[i], own, _pseudo_inertias(D), _EXTENT))
    rotors = robot.rotors(chain)
    mean[at.terms[ROTOR_INERTIA]] = rotors
    mean[at.terms[VISCOUS]] = [joint.damping for joint in chain.joints]
    mean[at.terms[COULOMB]] = [joint.friction for joint in chain.joints]
    spread = _of_terms(rotors, torque, speed)
    coupling = spread[[ROTOR_INERTIA, VISCOUS, COULOMB], -1]
    positive = np.append(at.terms[:POSITIVE], at.coupling).astype(np.intp)
    deviation = np.append(spread[:POSITIVE], coupling)
    start[positive] = _FIRST
    terms = Cones(
        positive[:, None],
        mean[positive][:, None, None],
        deviation[:, None, None, None],
        np.zeros(positive.size),
    )
    of_load = np.zeros((LOAD, LOAD))
    if load:
        J = payload_inertia(max(robot.payload, _LIGHTEST))
        of_load = deviations(moved(J, chain.tip_placement), 1.0, 2.0 * PAYLOAD_SIZE)
        bodies.append((at.load, np.zeros((4, 4)), _pseudo_inertias(of_load), 0.0))
    start[at.load[0]] = _FIRST
    of_terms = np.diag(np.append(spread, coupling))
    D = block_diag(*blocks, of_terms, of_load, _DELAY)
    cones = Cones(*map(np.array, zip(*bodies, strict=True))), terms
    return Prior(base_matrix(parameters, n), mean, D, cones, start)


def _with_payload(D: Floats, chain: Chain, payload: float) -> Floats:
    """Return the deviations (10, 10) of the last body, which may carry a payload [kg]."""
    J = moved(payload_inertia(payload), chain.tip_placement)
    both = np.column_stack((D, deviations(J, 1.0, PAYLOAD_SIZE)))
    return np.transpose(np.linalg.qr(both.T, mode='r'))


def _of_terms(rotors: Floats, torque: Floats, speed: Floats) -> Floats:
    """Return the deviations (7, n) of JOINT_TERMS."""
    coulomb = _FRICTION * torque
    viscous = coulomb / speed
    return np.array(
        (
            np.maximum(rotors, torque / _ROTOR),
            viscous,
            coulomb,
            np.full_like(torque, _LOAD),
            _OFFSET * torque,
            coulomb,  # Stribeck
            viscous / speed,  # quadratic
        )
    )


def _pseudo_inertias(D: Floats) -> Floats:
    return np.array([pseudo_inertia(direction) for direction in D.T])


def _inside(J: Floats, mass: float) -> Floats:
    """Return a physical pseudo-inertia near J (4, 4); `mass` [kg] sets the scale."""
    scale = np.sqrt(mass) * np.array([CENTRE, CENTRE, CENTRE, 1.0])
    values, axes = np.linalg.eigh(J / np.outer(scale, scale))
    L = scale[:, None] * axes * np.sqrt(np.maximum(values, _NEAREST))
    return np.asarray(L @ L.T)
