# SPDX-License-Identifier: Apache-2.0
"""Model of a serial chain of rigid bodies, linear in its inertial parameters: an `ArmModel`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blf_dsc_controller.arms.chain_kernels import (
    AXES,
    ROTOR,
    Bodies,
    bodies_of,
    fill_momentum_regressor,
    fill_regressor,
    fill_regressors,
)
from blf_dsc_controller.arms.inertia import INERTIA_NAMES, INERTIA_UNITS
from blf_dsc_controller.arms.urdf import Chain
from blf_dsc_controller.compiled.layout import Array, pack


class SerialChain(NamedTuple):
    """Arm of any serial chain: an `ArmModel`.

    It contains its working memory, so each thread needs its own.
    """

    n: int
    p: int
    vector: Array  # Bodies

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the entries of P, joints numbered from 1: m7, m*cx7, Ixx7, rotor7."""
        names = (*INERTIA_NAMES, 'rotor')
        return tuple(f'{names[entry]}{body + 1}' for body, entry in self._columns())

    @property
    def parameter_units(self) -> tuple[str, ...]:
        """Units of the entries of P; the rotor of a prismatic joint is in kg."""
        axis = bodies_of(self.vector).axis
        return tuple(
            (*INERTIA_UNITS, 'kg m^2' if axis[body, :3].any() else 'kg')[entry]
            for body, entry in self._columns()
        )

    def _columns(self) -> list[tuple[int, int]]:
        bodies = bodies_of(self.vector)
        body = np.repeat(np.arange(self.n), np.diff(bodies.first).astype(int))
        return [(int(b), int(e)) for b, e in zip(body, bodies.entry, strict=True)]

    def regressor(self, q: Array, dq: Array, v: Array, a: Array, H: Array) -> None:
        """Fill H (n, p) so that H P = M(q) a + C(q, dq) v + G(q)   [N m], Property III."""
        fill_regressor(self.vector, q, dq, v, a, H)

    def momentum_regressor(self, q: Array, dq: Array, Yp: Array, Yr: Array) -> None:
        """Fill Yp, Yr (n, p) so that Yp P = M dq [N m s] and Yr P = G - C^T dq [N m]."""
        fill_momentum_regressor(self.vector, q, dq, Yp, Yr)

    def regressors(
        self, q: Array, dq: Array, v: Array, a: Array, H: Array, Yp: Array, Yr: Array
    ) -> None:
        """Compute `regressor` and `momentum_regressor` in one pass along the chain."""
        fill_regressors(self.vector, q, dq, v, a, H, Yp, Yr)


def serial_chain(
    chain: Chain,
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81),
    columns: list[tuple[int, int]] | None = None,
) -> SerialChain:
    """Return the model of a chain; `gravity` [m/s^2] is given in its base.

    `columns` are the parameters as (body, entry), both counted from 0, in ascending order of the
    bodies; ROTOR is the entry after the ten. None selects all n * 11.
    """
    n = len(chain.joints)
    if columns is None:
        columns = [(i, entry) for i in range(n) for entry in range(ROTOR + 1)]
    rotation = np.zeros((n, 3, 3, 3))
    offset, slide, axis = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 6))
    for i, joint in enumerate(chain.joints):
        R, offset[i] = joint.placement[:3, :3], joint.placement[:3, 3]
        if joint.kind == 'prismatic':
            rotation[i, 0], slide[i], axis[i, 3:] = R, R @ joint.axis, joint.axis
        else:
            along = np.outer(joint.axis, joint.axis)
            rotation[i] = R @ along, R @ (np.eye(3) - along), R @ np.cross(np.eye(3), joint.axis)
            axis[i, :3] = joint.axis
    body, entry = np.transpose(columns)
    bodies = Bodies(
        n=n,
        p=len(columns),
        gravity=np.array(gravity),
        rotation=rotation,
        offset=offset,
        slide=slide,
        axis=axis,
        first=np.searchsorted(body, np.arange(n + 1)),
        entry=entry,
        motions=np.zeros((AXES + 2 * n, 6)),
        products=np.zeros((3, ROTOR + 1)),
    )
    return SerialChain(n, len(columns), pack(bodies))
