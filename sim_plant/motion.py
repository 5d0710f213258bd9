# SPDX-License-Identifier: Apache-2.0
"""Equation of motion of an arm under a torque, a disturbance, and a force at its tip."""

from typing import NamedTuple

import numpy as np

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import part
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
def disturbing_torque(motion: Motion, t: float, x: np.ndarray, out: np.ndarray) -> None:
    """Write tau_dist (n,) [N m] at time t [s], contact included; `x` as in `state_derivative`."""
    n = out.size
    disturbance_torque(motion.disturbance, t, part(x, 0, (n,)), part(x, n, (n,)), out)
    subtract_contact_torque(motion.arm, motion.contact, x, out)


@inner
def state_derivative(
    motion: Motion, t: float, x: np.ndarray, torque: np.ndarray, dx: np.ndarray
) -> None:
    """Write dx/dt of x = [q, dq, y, v] (2n + 6,), of which y and v only while a load sloshes."""
    n = torque.size
    q, dq = part(x, 0, (n,)), part(x, n, (n,))
    velocity, net_torque = part(dx, 0, (n,)), part(dx, n, (n,))
    disturbing_torque(motion, t, x, net_torque)
    for i in range(n):
        velocity[i] = dq[i]
        net_torque[i] = torque[i] - net_torque[i]
    motion.arm.accelerate(motion.payload, q, dq, net_torque, net_torque)  # in place
    contact = motion.contact
    if contact.mass > 0.0:
        for i in range(3):
            dx[2 * n + i] = x[2 * n + 3 + i]
            dx[2 * n + 3 + i] = contact.slosh.gravity[i] - contact.tip.pull[i]
