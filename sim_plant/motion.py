# SPDX-License-Identifier: Apache-2.0
"""Equation of motion of an arm under a torque, a disturbance, and a force at its tip."""

from typing import NamedTuple

import numpy as np

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.views import part
from sim_plant.arm import Arm
from sim_plant.contact import Contact, subtract_contact_torque
from sim_plant.disturbance import JointDisturbance, disturbance_torque


class Motion(NamedTuple):
    """Everything that determines the acceleration besides state and motor torque."""

    arm: Arm
    payload: float  # kg
    disturbance: JointDisturbance
    contact: Contact


@inner
def disturbing_torque(
    motion: Motion, t: float, q: np.ndarray, dq: np.ndarray, out: np.ndarray
) -> None:
    """Write tau_dist (n,) [N m] at time t [s], contact included."""
    disturbance_torque(motion.disturbance, t, q, dq, out)
    subtract_contact_torque(motion.arm, motion.contact, q, dq, out)


@inner
def state_derivative(
    motion: Motion, t: float, x: np.ndarray, torque: np.ndarray, dx: np.ndarray
) -> None:
    """Write dx/dt = [dq, ddq] (2n,) of x = [q, dq] (2n,)."""
    n = torque.size
    q, dq = part(x, 0, (n,)), part(x, n, (n,))
    velocity, net_torque = part(dx, 0, (n,)), part(dx, n, (n,))
    disturbing_torque(motion, t, q, dq, net_torque)
    for i in range(n):
        velocity[i] = dq[i]
        net_torque[i] = torque[i] - net_torque[i]
    motion.arm.accelerate(motion.payload, q, dq, net_torque, net_torque)  # in place
