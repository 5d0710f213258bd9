# SPDX-License-Identifier: Apache-2.0
"""Joint torques due to forces at the tip: a push, a wall that it hits, and a load that sloshes.

Vectors are in the base frame: x to the right, z up.  A force f at the tip loads the joints with
J^T f, where J is the Jacobian of the tip position.

The sloshing load is a point mass m on a damped spring at the tip. With its position y and velocity
v, those of the tip x and dx, and a = omega^2 (y - x) + 2 zeta omega (v - dx),

    y' = v,   v' = g - a,   force on the tip: m a,

so its motion does not depend on m, which may be ramped.
"""

from typing import Annotated, NamedTuple

import numpy as np

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, part
from sim_plant.arm import Arm


class WallSettings(NamedTuple):
    """A plane that pushes the tip along its unit normal."""

    point: Annotated[Array, '3']  # m
    normal: Annotated[Array, '3']
    stiffness: float  # N/m; 0: no wall
    damping: float  # N s/m


class SloshSettings(NamedTuple):
    """Spring and damper of the sloshing load, per kg."""

    stiffness: float  # omega^2, 1/s^2
    damping: float  # 2 zeta omega, 1/s
    gravity: Annotated[Array, '3']  # g, m/s^2


class TipState(NamedTuple):
    """Working memory for the tip of the arm."""

    position: Annotated[Array, '3']  # x, m
    velocity: Annotated[Array, '3']  # dx, m/s
    jacobian: Annotated[Array, '3', 'n']  # m/rad
    force: Annotated[Array, '3']  # N
    pull: Annotated[Array, '3']  # a, m/s^2


class Contact(NamedTuple):
    """Sources of the force at the tip."""

    push: np.ndarray  # (3,) N
    wall: WallSettings
    slosh: SloshSettings
    mass: float  # m of the sloshing load, kg; 0: none
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
def locate_tip(arm: Arm, q: np.ndarray, dq: np.ndarray, tip: TipState) -> None:
    """Write position, velocity and Jacobian of the tip."""
    arm.fill_tip(q, tip.position, tip.jacobian)
    for i in range(3):
        tip.velocity[i] = 0.0
        for j in range(dq.size):
            tip.velocity[i] += tip.jacobian[i, j] * dq[j]


@inner
def subtract_contact_torque(arm: Arm, contact: Contact, x: np.ndarray, torque: np.ndarray) -> None:
    """Subtract the contact torque J^T f (n,) [N m] from `torque`, in place.

    `x` (2n + 6,) is [q, dq, y, v]; the last two are those of the sloshing load.
    """
    push, wall, slosh, mass, tip = contact
    n = torque.size
    is_pushed = push[0] != 0.0 or push[1] != 0.0 or push[2] != 0.0
    if not is_pushed and wall.stiffness == 0.0 and mass == 0.0:
        return
    locate_tip(arm, part(x, 0, (n,)), part(x, n, (n,)), tip)
    size = wall_force(wall, tip.position, tip.velocity) if wall.stiffness > 0.0 else 0.0
    for i in range(3):
        tip.force[i] = push[i] + size * wall.normal[i]
        if mass > 0.0:
            tip.pull[i] = slosh.stiffness * (x[2 * n + i] - tip.position[i])
            tip.pull[i] += slosh.damping * (x[2 * n + 3 + i] - tip.velocity[i])
            tip.force[i] += mass * tip.pull[i]
    for j in range(n):
        for i in range(3):
            torque[j] -= tip.jacobian[i, j] * tip.force[i]
