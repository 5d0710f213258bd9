# SPDX-License-Identifier: Apache-2.0
"""What a drive adds to the commanded torque by itself, and what makes it refuse to move.

Drives of cobots hold the arm against gravity, and overcome part of their friction, by a model of
their own, right or wrong, with the payload that they have been told of.  Some brake when the
commands jump (a reflex stop), until the plant is reset.
"""

from __future__ import annotations

from math import tanh
from typing import Annotated, NamedTuple

import numpy as np

from blf_dsc_controller.compiled.jit import called, inner
from blf_dsc_controller.compiled.layout import Array, Cell, size_of, view_of
from sim_plant.disturbance import JointDisturbance
from sim_plant.rigid_body import BodyMotion, RigidBodies, gravity_torque, locate


class Compensation(NamedTuple):
    """What the drives of all joints add, and the jump at which they stop."""

    friction: float  # share of viscous and Coulomb friction that they overcome
    effort_is_whole: int  # 1: the measured effort contains what they add
    effort_scale: float  # of the measured effort: 1, or A/N m of a current
    jump: float  # N m from one command to the next at which they stop; 0: none


class CompensationState(NamedTuple):
    """What the drives added in the last sample, and whether they have stopped."""

    stopped: Cell
    command: Annotated[Array, 'n']  # the last one, N m
    added: Annotated[Array, 'n']  # N m
    whole: Annotated[Array, 'n']  # torque at the joints, N m
    still: Annotated[Array, 'n']  # zeros
    memory: Annotated[Array, 'drive_memory']  # BodyMotion


bodies_of, motion_of, memory_size = view_of(RigidBodies), view_of(BodyMotion), size_of(BodyMotion)


@called
def fill_gravity(bodies_vector: Array, memory: Array, q: Array, still: Array, out: Array) -> None:
    """Write the torque (n,) [N m] that holds the bodies at q against gravity."""
    bodies = bodies_of(bodies_vector)
    now = motion_of(memory, bodies)
    locate(bodies, q, still, now)
    gravity_torque(bodies, now, out)


@inner
def compensate(
    compensation: Compensation,
    bodies: Array,
    friction: JointDisturbance,
    q: np.ndarray,
    dq: np.ndarray,
    state: CompensationState,
) -> None:
    """Write what the drives add at q, dq (n,); `friction` is the true one."""
    if bodies.size == 0:
        return
    fill_gravity(bodies, state.memory, q, state.still, state.added)
    if compensation.friction > 0.0:
        for i in range(q.size):
            torque = friction.viscous[i] * dq[i]
            torque += friction.coulomb[i] * tanh(dq[i] / friction.coulomb_velocity[i])
            state.added[i] += compensation.friction * torque


@inner
def jumps(compensation: Compensation, command: np.ndarray, state: CompensationState) -> bool:
    """Return whether a command (n,) [N m] makes the drives stop, and remember it."""
    if compensation.jump > 0.0:
        for i in range(command.size):
            # 1e-9: a command at the limit of its rate may be rounded beyond it.
            if abs(command[i] - state.command[i]) > compensation.jump * (1.0 + 1e-9):
                state.stopped[0] = 1.0
            state.command[i] = command[i]
    return bool(state.stopped[0] == 1.0)
