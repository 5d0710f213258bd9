# SPDX-License-Identifier: Apache-2.0
"""Joint torques due to forces at the tip: a push, and a wall that the tip hits.

Vectors are in the base frame: x to the right, z up.  A force f at the tip loads the joints with
J^T f, where J is the Jacobian of the tip position.
"""

from typing import Annotated, NamedTuple

import numpy as np

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array
from sim_plant.arm import Arm


class WallSettings(NamedTuple):
    """A plane that pushes the tip along its unit normal."""

    point: Annotated[Array, '3']  # m
    normal: Annotated[Array, '3']
    stiffness: float  # N/m; 0: no wall
    damping: float  # N s/m


class TipState(NamedTuple):
    """Working memory for the tip of the arm."""

    position: Annotated[Array, '3']  # m
    jacobian: Annotated[Array, '3', 'n']  # m/rad
    force: Annotated[Array, '3']  # N


class Contact(NamedTuple):
    """Sources of the force at the tip."""

    push: np.ndarray  # (3,) N
    wall: WallSettings
    tip: TipState


@inner
def wall_force(wall: WallSettings, position: np.ndarray, velocity: np.ndarray) -> float:
    """Return the normal force [N], >= 0, on a tip with position (3,) [m] and velocity (3,) [m/s].

    Kelvin-Voigt model: k depth + d d(depth)/dt inside the wall, 0 outside.
    """
    depth = 0.0
    speed = 0.0
    for i in range(3):
        depth += wall.normal[i] * (wall.point[i] - position[i])
        speed -= wall.normal[i] * velocity[i]
    if depth <= 0.0:
        return 0.0
    return max(0.0, wall.stiffness * depth + wall.damping * speed)


@inner
def subtract_contact_torque(
    arm: Arm, contact: Contact, q: np.ndarray, dq: np.ndarray, torque: np.ndarray
) -> None:
    """Subtract the contact torque J^T f (n,) [N m] from `torque`, in place."""
    push, wall, state = contact
    is_pushed = push[0] != 0.0 or push[1] != 0.0 or push[2] != 0.0
    if not is_pushed and wall.stiffness == 0.0:
        return
    arm.fill_tip(q, state.position, state.jacobian)
    force = state.force
    if wall.stiffness > 0.0:
        for i in range(3):  # first used for the tip velocity
            force[i] = 0.0
            for j in range(dq.size):
                force[i] += state.jacobian[i, j] * dq[j]
        size = wall_force(wall, state.position, force)
        for i in range(3):
            force[i] = push[i] + size * wall.normal[i]
    else:
        for i in range(3):
            force[i] = push[i]
    for j in range(torque.size):
        for i in range(3):
            torque[j] -= state.jacobian[i, j] * force[i]
