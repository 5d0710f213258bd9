# SPDX-License-Identifier: Apache-2.0
"""Interface between the laws and an arm whose dynamics are linear in p parameters.

An arm is a `NamedTuple` of the geometry that its regressors need (numbers and arrays), with the
properties and methods of `ArmModel`.  Kernels call the methods as Python does: only those of the
type that a kernel receives are compiled into it.  To add an arm, write its class in a file of its
own, and add it to `arm_model`, to `compile_methods` below and to the choices of the parameter
`model`.
"""

from __future__ import annotations

from typing import Protocol

from blf_dsc_controller.arms.combined_chain import CombinedChain
from blf_dsc_controller.arms.planar_chain import PlanarChain
from blf_dsc_controller.arms.serial_chain import SerialChain
from blf_dsc_controller.arms.two_link import TwoLink
from blf_dsc_controller.compiled.jit import compile_methods
from blf_dsc_controller.compiled.layout import Array


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


def arm_model(name: str, n: int, l1: float, gravity: float) -> ArmModel:
    """Return the named model for n joints, with known l1 [m] and gravity [m/s^2]."""
    r = gravity / l1
    models: dict[str, ArmModel] = {'two_link': TwoLink(r), 'planar_chain': PlanarChain(n, r)}
    return models[name]


compile_methods(
    ArmModel,
    ('regressor', 'momentum_regressor', 'regressors'),
    *(TwoLink, PlanarChain, SerialChain, CombinedChain),
)
