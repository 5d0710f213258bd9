# SPDX-License-Identifier: Apache-2.0
"""The arm's equation of motion in first order: x = [q, dq], with held torque and disturbance."""

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.views import part
from sim_plant.disturbance import disturbance_torque
from sim_plant.dynamics import JOINTS, Arm, acceleration


@inner
def motion(
    arm: Arm,
    disturbance: NDArray[np.float64],
    t: float,
    x: NDArray[np.float64],
    torque: NDArray[np.float64],
    dx: NDArray[np.float64],
) -> None:
    """Write dx/dt = [dq, M^-1 (torque - tau_dist(t, dq) - C dq - G)], (2n,)."""
    q, dq = part(x, 0, (JOINTS,)), part(x, JOINTS, (JOINTS,))
    velocity, net_torque = part(dx, 0, (JOINTS,)), part(dx, JOINTS, (JOINTS,))
    disturbance_torque(disturbance, t, dq, net_torque)
    for i in range(JOINTS):
        velocity[i] = dq[i]
        net_torque[i] = torque[i] - net_torque[i]
    acceleration(arm, q, dq, net_torque, net_torque)  # in place
