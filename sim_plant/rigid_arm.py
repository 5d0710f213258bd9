# SPDX-License-Identifier: Apache-2.0
"""An `Arm` for any serial chain, with a payload at its tip."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from blf_dsc_controller.arms.base_parameters import BaseParameters
from blf_dsc_controller.arms.inertia import inertia_of
from blf_dsc_controller.arms.urdf import Chain
from blf_dsc_controller.compiled.jit import called
from blf_dsc_controller.compiled.layout import Array, pack, size_of, view_of
from sim_plant.rigid_body import BodyMotion, RigidBodies, acceleration, locate, rigid_bodies, tip

motion_of, motion_size = view_of(BodyMotion), size_of(BodyMotion)


class ArmContent(NamedTuple):
    """Constants of an arm."""

    n: int
    p: int
    bodies: RigidBodies
    P: Annotated[Array, 'p']  # without payload
    P_payload: Annotated[Array, 'p']  # contribution of 1 kg at the tip
    rest: Annotated[Array, 'n']  # zero velocities


content_of = view_of(ArmContent)


class RigidArm(NamedTuple):
    """A serial-chain arm with its working memory: threads must not share one."""

    n: int
    p: int
    content: Array  # ArmContent
    memory: Array  # BodyMotion

    def fill_parameters(self, payload: float, P: Array) -> None:
        """Write the base parameters P (p,) with a payload [kg]."""
        content = content_of(self.content)
        for k in range(self.p):
            P[k] = content.P[k] + payload * content.P_payload[k]

    def fill_tip(self, q: Array, position: Array, jacobian: Array) -> None:
        """Write `rigid_body.tip` at q (n,)."""
        fill_tip(self.content, self.memory, q, position, jacobian)

    def accelerate(self, payload: float, q: Array, dq: Array, torque: Array, ddq: Array) -> None:
        """Write `rigid_body.acceleration` with a payload [kg] at q, dq (n,)."""
        accelerate(self.content, self.memory, payload, q, dq, torque, ddq)


@called
def fill_tip(vector: Array, memory: Array, q: Array, position: Array, jacobian: Array) -> None:
    """Implement `RigidArm.fill_tip`."""
    content = content_of(vector)
    now = motion_of(memory, content.bodies)
    locate(content.bodies, q, content.rest, now)
    tip(content.bodies, now, position, jacobian)


@called
def accelerate(
    vector: Array, memory: Array, payload: float, q: Array, dq: Array, torque: Array, ddq: Array
) -> None:
    """Implement `RigidArm.accelerate`."""
    bodies = content_of(vector).bodies
    now = motion_of(memory, bodies)
    locate(bodies, q, dq, now)
    acceleration(bodies, now, payload, torque, ddq)


def rigid_arm(
    chain: Chain,
    gravity: tuple[float, ...],
    inertias: Array,
    rotors: Array,
    parameters: BaseParameters,
) -> RigidArm:
    """Return an arm with a chain's geometry, inertias (n, 10), rotors (n,) [kg m^2, or kg]."""
    bodies = rigid_bodies(chain, gravity, inertias, rotors)
    point = np.append(bodies.tip, 1.0)
    payload = np.zeros_like(inertias)
    payload[-1] = inertia_of(np.outer(point, point))
    P = parameters.of(inertias, rotors)
    content = ArmContent(
        n=bodies.n,
        p=P.size,
        bodies=bodies,
        P=P,
        P_payload=parameters.of(payload, np.zeros(bodies.n)),
        rest=np.zeros(bodies.n),
    )
    return RigidArm(bodies.n, P.size, pack(content), np.zeros(motion_size(bodies)))
