# SPDX-License-Identifier: Apache-2.0
"""Interface between the plant and the mechanics of an arm of n joints, and that of Section IV.

An arm is a `NamedTuple` of numbers and arrays with the methods of `Arm`.  Kernels call
them as plain Python does; each kernel is compiled for the type of arm that is passed to it.

The two-link arm has a point mass at the end of each link and moves in a vertical plane. It is
derived from the Lagrangian, independently of the controller's regressor, so that each checks the
other.  Joint 1 is measured from the horizontal, joint 2 from link 1:

    M(q) ddq + C(q, dq) dq + G(q) = torque,    (33), (34)

where G is the gradient of the potential; its first term has cos q1, where (34) prints cos q2.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

from blf_dsc_controller.compiled.elementary import cos, sin
from blf_dsc_controller.compiled.jit import compile_methods
from blf_dsc_controller.compiled.layout import Array
from sim_plant.rigid_body import RigidArm


class PointMassArm(NamedTuple):
    """Lengths, masses and gravity; l2, m1 and m2 are unknown to the controller."""

    l1: float  # m
    l2: float  # m
    m1: float  # kg
    m2: float  # kg
    g: float  # m/s^2

    @property
    def p(self) -> int:
        """Number of parameters."""
        return 3

    def joint_count(self) -> int:
        """Return n, a constant in kernels: their loops over two joints are unrolled."""
        return 2

    def fill_parameters(self, payload: float, P: Array) -> None:
        """Write the parameters P (3,) [kg m^2] that the controller estimates."""
        m2 = self.m2 + payload
        P[0] = (self.m1 + m2) * self.l1**2
        P[1] = m2 * self.l2**2
        P[2] = m2 * self.l1 * self.l2

    def fill_tip(self, q: Array, position: Array, jacobian: Array) -> None:
        """Write the position (3,) [m] of the tip and its Jacobian (3, n) [m/rad]."""
        x1, z1 = self.l1 * cos(q[0]), self.l1 * sin(q[0])
        x2, z2 = self.l2 * cos(q[0] + q[1]), self.l2 * sin(q[0] + q[1])
        position[0], position[1], position[2] = x1 + x2, 0.0, z1 + z2
        jacobian[0, 0], jacobian[0, 1] = -z1 - z2, -z2
        jacobian[1, 0], jacobian[1, 1] = 0.0, 0.0
        jacobian[2, 0], jacobian[2, 1] = x1 + x2, x2

    def accelerate(self, payload: float, q: Array, dq: Array, torque: Array, ddq: Array) -> None:
        """Write ddq = M^-1 (torque - C dq - G) (2,) [rad/s^2]; `ddq` may alias `torque`."""
        m2 = self.m2 + payload
        outer = m2 * self.l2**2
        coupling = m2 * self.l1 * self.l2 * cos(q[1])
        m11 = (self.m1 + m2) * self.l1**2 + outer + 2.0 * coupling
        m12 = outer + coupling
        m22 = outer
        c = -m2 * self.l1 * self.l2 * sin(q[1])  # dM12/dq2 = dM11/dq2 / 2
        g2 = m2 * self.g * self.l2 * cos(q[0] + q[1])
        g1 = (self.m1 + m2) * self.g * self.l1 * cos(q[0]) + g2
        f1 = torque[0] - c * dq[1] * (2.0 * dq[0] + dq[1]) - g1
        f2 = torque[1] + c * dq[0] * dq[0] - g2
        determinant = m11 * m22 - m12 * m12
        ddq[0] = (m22 * f1 - m12 * f2) / determinant
        ddq[1] = (m11 * f2 - m12 * f1) / determinant


class Arm(Protocol):
    """An arm that may carry a payload, a point mass [kg] at its tip."""

    @property
    def p(self) -> int:
        """Number of parameters P."""

    def joint_count(self) -> int:
        """Return n, for kernels."""

    def fill_parameters(self, payload: float, P: Array) -> None:
        """Write the parameters P (p,) that the controller estimates."""

    def fill_tip(self, q: Array, position: Array, jacobian: Array) -> None:
        """Write the tip position (3,) [m] in the base frame and its Jacobian (3, n) [m/rad]."""

    def accelerate(self, payload: float, q: Array, dq: Array, torque: Array, ddq: Array) -> None:
        """Write ddq (n,) [rad/s^2] of M ddq + C dq + G = torque; `ddq` may alias `torque`."""


compile_methods(
    Arm, ('joint_count', 'fill_parameters', 'fill_tip', 'accelerate'), PointMassArm, RigidArm
)
