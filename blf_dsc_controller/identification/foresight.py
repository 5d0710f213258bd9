# SPDX-License-Identifier: Apache-2.0
"""What a motion can show of an arm, before anything is fitted, or even recorded.

Torques are not used: the residual of each joint is taken to be a fiftieth of the torque
that the URDF needs, and to last for a window, as those of real robots do at least.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.analysis.output import aligned
from blf_dsc_controller.arms.base_parameters import base_parameters
from blf_dsc_controller.arms.urdf import Chain
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.identification.prior import Prior, prior_of
from blf_dsc_controller.identification.recording import Recording
from blf_dsc_controller.identification.regression import triangle
from blf_dsc_controller.identification.summary import UNSEEN
from blf_dsc_controller.identification.values import (
    COULOMB,
    JOINT_TERMS,
    ROTOR_INERTIA,
    VISCOUS,
    base_matrix,
    indices,
    units_of,
)
from blf_dsc_controller.identification.windows import (
    HOP,
    STILL,
    WINDOW,
    Indices,
    Rows,
    rows_of,
    split,
)
from blf_dsc_controller.numerics.intervals import TWO_SIDED
from blf_dsc_controller.run import Floats

_RESIDUAL = 0.02  # of the torque
# of the largest torque of all joints, least that a joint is taken to have
_FAINT = 0.01
_RANK = 1e-6  # of the largest singular value, least that counts
_TERMS = {term: JOINT_TERMS[term] for term in (ROTOR_INERTIA, VISCOUS, COULOMB)}


class Foresight(NamedTuple):
    """What a motion can show of p base parameters and of joints' terms (3, n)."""

    names: tuple[str, ...]  # of the base parameters
    joints: tuple[tuple[str, str], ...]  # name and kind
    seconds: float  # of motion
    rank: int  # of the columns of base parameters, each times its deviation `before`
    condition: float  # of these columns, within that rank
    before: Floats  # (p,) standard deviations that the URDF leaves
    after: Floats  # (p,) those that are expected from the motion
    terms: Floats  # (2, 3, n) likewise of rotor, viscous and Coulomb friction
    values: Floats  # (p,) of the URDF

    @property
    def shown(self) -> np.ndarray:
        """Which base parameters (p,) the motion shows."""
        return np.asarray(self.after**2 <= UNSEEN * self.before**2)


def foresee(recording: Recording, robot: Robot) -> Foresight:
    """Return what the motion of a recording can show; its torques are not used.

    Raises:
        BlfDscError: it is too short, or has no motion.
    """
    chain = robot.chain(recording.joints)
    n = len(chain.joints)
    base = base_parameters(chain, robot.gravity)
    rows = rows_of(recording, base.model)
    moving = split(rows).moving
    P = base.of(chain.inertias, robot.rotors(chain))
    needed = _needed_torque(rows, moving, P)
    prior = _prior(robot, chain, rows, needed)
    G = base_matrix(base, n)
    to_base = G[: rows.p]
    R = _triangle_of(rows, moving, needed)
    covariances = prior.D @ prior.D.T, _expected_covariance(R, G, prior)
    before, after = (_deviations(to_base @ C @ to_base.T) for C in covariances)
    sizes = np.linalg.svd(R[:, : rows.p] * before, compute_uv=False)
    sizes = sizes[sizes > _RANK * sizes[0]]
    at = indices(n).terms[list(_TERMS)].astype(int)
    return Foresight(
        names=base.combinations,
        joints=tuple((joint.name, joint.kind) for joint in chain.joints),
        seconds=moving.size * HOP,
        rank=sizes.size,
        condition=float(sizes[0] / sizes[-1]),
        before=before,
        after=after,
        terms=np.array([_deviations(C)[at] for C in covariances]),
        values=P,
    )


def _needed_torque(rows: Rows, moving: Indices, P: Floats) -> Floats:
    """Return the torque (k, n) that base parameters need in some windows."""
    theta = np.zeros(rows.unknowns)
    theta[: rows.p] = P
    return rows.torques(moving, theta)


def _prior(robot: Robot, chain: Chain, rows: Rows, needed: Floats) -> Prior:
    """Return the prior without optional terms, scaled by the motion and the torque it needs."""
    largest = np.abs(needed).max(axis=0)
    speed = np.maximum(rows.speed, STILL)
    return prior_of(robot, chain, largest, speed, load=False).only([])


def _triangle_of(rows: Rows, moving: Indices, needed: Floats) -> Floats:
    """Return R of the QR decomposition of the columns, over the deviations of residuals."""
    torque = np.sqrt(np.mean(needed**2, axis=0))
    torque = np.maximum(torque, _FAINT * torque.max())
    weight = rows.weight[moving] / (_RESIDUAL * torque)

    def weighted() -> Iterator[Floats]:
        for block in rows.blocks(moving):
            X = rows.matrix(moving[block]) * weight[block, :, None]
            yield X.reshape(-1, X.shape[2])

    return triangle(weighted())


def _expected_covariance(R: Floats, G: Floats, prior: Prior) -> Floats:
    """Return the covariance of all values that is expected from the motion."""
    A = R @ (G @ prior.D)[:-1]
    information = HOP / WINDOW * A.T @ A  # windows overlap
    inverse = np.linalg.inv(np.eye(len(information)) + information)
    return np.asarray(prior.D @ inverse @ prior.D.T)


def foresight_lines(found: Foresight) -> Iterator[str]:
    """Yield what the motion can show, as text."""
    p = len(found.names)
    yield (
        f'{found.seconds:.1f} s of motion have columns of rank {found.rank} for {p} base '
        f'parameters (condition {found.condition:.2g}); {int(found.shown.sum())} of these will be '
        'known better than from the URDF'
    )
    yield (
        '95 % intervals, from the URDF and expected from the motion, with residuals of '
        f'{100.0 * _RESIDUAL:g} % of the torque, in kg, kg m, kg m^2:'
    )
    for k, name in enumerate(found.names):
        mark = '' if found.shown[k] else '  NOT SHOWN by this motion: from the URDF'
        halves = f'{_half(found.before[k])} -> {_half(found.after[k])}'
        yield f'{found.values[k]:10.4g} {halves}  {name}{mark}'
    rows = [('joint', *_TERMS.values())]
    for i, (name, kind) in enumerate(found.joints):
        units = units_of(kind)
        cells = [
            f'{_half(deviation)} {units[term]}'
            for term, deviation in zip(_TERMS, found.terms[1, :, i], strict=True)
        ]
        rows.append((name, *cells))
    yield aligned(rows)


def _half(deviation: float) -> str:
    return f'+- {TWO_SIDED * deviation:.2g}'


def _deviations(covariance: Floats) -> Floats:
    return np.asarray(np.sqrt(np.diag(covariance)))
