# SPDX-License-Identifier: Apache-2.0
"""Interface between the laws and an arm whose dynamics are linear in p parameters.

An arm is a `NamedTuple` of the geometry that its regressors need (numbers and arrays),
with the properties and methods of `ArmModel`.  Kernels call the methods as Python does:
only those of the type that a kernel receives are compiled into it.  An arm that no URDF
describes has a class in a file of its own, which `arm_model` returns, and is compiled by
`compile_methods` below.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from blf_dsc_controller.arms.serial_chain import SerialChain
from blf_dsc_controller.arms.two_link import TwoLink
from blf_dsc_controller.compiled.jit import compile_methods, kernel
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.numerics.algebra import inverse, product


class ArmModel(Protocol):
    """Regressors of an arm of n joints, and the names of the p parameters P they multiply."""

    @property
    def n(self) -> int:
        """Number of joints."""

    @property
    def p(self) -> int:
        """Number of parameters."""

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the p entries of P, in order."""

    @property
    def parameter_units(self) -> tuple[str, ...]:
        """Units of the entries of P."""

    def sizes(self) -> tuple[int, int]:
        """Return n and p, in kernels too.

        Literal numbers are constants of the kernels.
        """

    def regressor(self, q: Array, dq: Array, v: Array, a: Array, H: Array) -> None:
        """Fill H (n, p) so that H P = M(q) a + C(q, dq) v + G(q)   [N m], Property III."""

    def momentum_regressor(self, q: Array, dq: Array, Yp: Array, Yr: Array) -> None:
        """Fill Yp, Yr (n, p) so that Yp P = M dq [N m s] and Yr P = G - C^T dq [N m].

        Then d/dt(Yp P) + Yr P = tau - tau_dist: the dynamics without the acceleration.
        """

    def regressors(
        self, q: Array, dq: Array, v: Array, a: Array, H: Array, Yp: Array, Yr: Array
    ) -> None:
        """Compute `regressor` and `momentum_regressor` for one state."""


def arm_model(l1: float, gravity: float) -> ArmModel:
    """Return the model of an arm without a URDF, with known l1 [m] and gravity [m/s^2]."""
    return TwoLink(gravity / l1)


compile_methods(
    ArmModel,
    ('sizes', 'regressor', 'momentum_regressor', 'regressors'),
    TwoLink,
    SerialChain,
)


def regressors_at(model: ArmModel, q: Array, dq: Array, v: Array, a: Array) -> Array:
    """Return H (k, n, p) of (19) at k states (k, n): H P = M(q) a + C(q, dq) v + G(q)   [N m]."""
    H = np.zeros((*q.shape, model.p))
    q, dq, v, a = (np.ascontiguousarray(array) for array in (q, dq, v, a))
    _fill_regressors(model, q, dq, v, a, H)
    return H


def inertia_matrices(model: ArmModel, P: Array, q: Array) -> Array:
    """Return M (k, n, n) [kg m^2] at positions (k, n) of an arm with the parameters P (p,)."""
    k, n = q.shape
    Yp, Yr = np.zeros((2, k * n, n, P.size))
    units = np.tile(np.eye(n), (k, 1))
    _fill_momentum_regressors(model, np.repeat(q, n, axis=0), units, Yp, Yr)
    return np.swapaxes(product(Yp, P[:, np.newaxis]).reshape(k, n, n), 1, 2)


def free_inertias(M: Array) -> Array:
    """Return 1 / (M^-1)_ii (k, n) [kg m^2], the inertia of each joint with the others free.

    M is (k, n, n).
    """
    return 1.0 / np.diagonal(inverse(M), axis1=1, axis2=2)


@kernel
def _fill_regressors(
    model: ArmModel,
    q: np.ndarray,
    dq: np.ndarray,
    v: np.ndarray,
    a: np.ndarray,
    H: np.ndarray,
) -> None:
    for k in range(q.shape[0]):
        model.regressor(q[k], dq[k], v[k], a[k], H[k])


@kernel
def _fill_momentum_regressors(
    model: ArmModel, q: np.ndarray, dq: np.ndarray, Yp: np.ndarray, Yr: np.ndarray
) -> None:
    for k in range(q.shape[0]):
        model.momentum_regressor(q[k], dq[k], Yp[k], Yr[k])
