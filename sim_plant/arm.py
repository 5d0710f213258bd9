# SPDX-License-Identifier: Apache-2.0
"""Interface between the plant and the mechanics of an arm of n joints.

An arm is a `NamedTuple` of numbers and arrays with the methods of `Arm`.  Kernels call
them as plain Python does; each kernel is compiled for the type of arm that is passed to it.
"""

from __future__ import annotations

from typing import Protocol

from blf_dsc_controller.compiled.jit import compile_methods
from blf_dsc_controller.compiled.layout import Array
from sim_plant.dynamics import PointMassArm
from sim_plant.rigid_arm import RigidArm


class Arm(Protocol):
    """An arm that may carry a payload, a point mass [kg] at its tip."""

    @property
    def n(self) -> int:
        """Number of joints."""

    @property
    def p(self) -> int:
        """Number of parameters P."""

    def fill_parameters(self, payload: float, P: Array) -> None:
        """Write the parameters P (p,) that the controller estimates."""

    def fill_tip(self, q: Array, position: Array, jacobian: Array) -> None:
        """Write the tip position (3,) [m] in the base frame and its Jacobian (3, n) [m/rad]."""

    def accelerate(self, payload: float, q: Array, dq: Array, torque: Array, ddq: Array) -> None:
        """Write ddq (n,) [rad/s^2] of M ddq + C dq + G = torque; `ddq` may alias `torque`."""


compile_methods(Arm, ('fill_parameters', 'fill_tip', 'accelerate'), PointMassArm, RigidArm)
