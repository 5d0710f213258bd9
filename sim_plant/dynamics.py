# SPDX-License-Identifier: Apache-2.0
"""Two-link arm in a vertical plane, a point mass at the end of each link (Section IV).

Written from the Lagrangian, independently of the controller's regressor, so that each can be
checked against the other. Joint 1 is measured from the horizontal, joint 2 from link 1:

    M(q) ddq + C(q, dq) dq + G(q) = torque,    (33), (34)

with G the gradient of the potential: its first term has cos q1, where (34) prints cos q2.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.compiled.jit import inner

ARM_SIZE = 5
JOINTS = 2


class Arm(NamedTuple):
    """Lengths, masses and gravity; l2, m1 and m2 are what the controller does not know."""

    l1: float  # m
    l2: float  # m
    m1: float  # kg
    m2: float  # kg
    g: float  # m/s^2


@inner
def arm_view(flat: NDArray[np.float64]) -> Arm:
    """Read an arm from its (ARM_SIZE,) vector."""
    return Arm(flat[0], flat[1], flat[2], flat[3], flat[4])


@inner
def parameters(arm: Arm, out: NDArray[np.float64]) -> None:
    """Write the (3,) parameters P the controller estimates, kg m^2."""
    out[0] = (arm.m1 + arm.m2) * arm.l1**2
    out[1] = arm.m2 * arm.l2**2
    out[2] = arm.m2 * arm.l1 * arm.l2


@inner
def inertia(arm: Arm, q2: float) -> tuple[float, float, float]:
    """Return M11, M12 = M21 and M22 of the mass matrix, kg m^2."""
    outer = arm.m2 * arm.l2**2
    coupling = arm.m2 * arm.l1 * arm.l2 * math.cos(q2)
    return (arm.m1 + arm.m2) * arm.l1**2 + outer + 2.0 * coupling, outer + coupling, outer


@inner
def christoffel(arm: Arm, q2: float) -> float:
    """Return dM12/dq2 = dM11/dq2 / 2, of which all of C is made, kg m^2."""
    return -arm.m2 * arm.l1 * arm.l2 * math.sin(q2)


@inner
def gravity_torque(arm: Arm, q1: float, q2: float) -> tuple[float, float]:
    """Return G = grad U, N m."""
    outer = arm.m2 * arm.g * arm.l2 * math.cos(q1 + q2)
    return (arm.m1 + arm.m2) * arm.g * arm.l1 * math.cos(q1) + outer, outer


@inner
def mass_matrix(arm: Arm, q: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """Write M(q), (2, 2), kg m^2."""
    m11, m12, m22 = inertia(arm, q[1])
    out[0, 0] = m11
    out[0, 1] = m12
    out[1, 0] = m12
    out[1, 1] = m22


@inner
def coriolis(
    arm: Arm, q: NDArray[np.float64], dq: NDArray[np.float64], out: NDArray[np.float64]
) -> None:
    """Write C(q, dq), (2, 2), kg m^2/s, in Christoffel form: dM/dt - 2C is skew-symmetric."""
    c = christoffel(arm, q[1])
    out[0, 0] = c * dq[1]
    out[0, 1] = c * (dq[0] + dq[1])
    out[1, 0] = -c * dq[0]
    out[1, 1] = 0.0


@inner
def gravity(arm: Arm, q: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """Write G(q), (2,), N m."""
    out[0], out[1] = gravity_torque(arm, q[0], q[1])


@inner
def acceleration(
    arm: Arm,
    q: NDArray[np.float64],
    dq: NDArray[np.float64],
    torque: NDArray[np.float64],
    ddq: NDArray[np.float64],
) -> None:
    """Write ddq = M^-1 (torque - C dq - G), (2,), rad/s^2; it may be the torque's own vector."""
    m11, m12, m22 = inertia(arm, q[1])
    c = christoffel(arm, q[1])
    g1, g2 = gravity_torque(arm, q[0], q[1])
    f1 = torque[0] - c * dq[1] * (2.0 * dq[0] + dq[1]) - g1
    f2 = torque[1] + c * dq[0] * dq[0] - g2
    determinant = m11 * m22 - m12 * m12
    ddq[0] = (m22 * f1 - m12 * f2) / determinant
    ddq[1] = (m11 * f2 - m12 * f1) / determinant


@inner
def kinetic_energy(arm: Arm, q: NDArray[np.float64], dq: NDArray[np.float64]) -> float:
    """Return dq^T M dq / 2, J."""
    m11, m12, m22 = inertia(arm, q[1])
    return float(0.5 * (m11 * dq[0] ** 2 + 2.0 * m12 * dq[0] * dq[1] + m22 * dq[1] ** 2))


@inner
def potential_energy(arm: Arm, q: NDArray[np.float64]) -> float:
    """Return U, J, zero with the arm stretched out horizontally."""
    height1 = arm.l1 * math.sin(q[0])
    height2 = height1 + arm.l2 * math.sin(q[0] + q[1])
    return arm.g * (arm.m1 * height1 + arm.m2 * height2)
