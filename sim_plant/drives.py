# SPDX-License-Identifier: Apache-2.0
"""From a command to the torque at the joint: delay, limit, lag, noise, and what drives add.

Drives of cobots hold the arm against gravity, and overcome part of their friction, by a model of
their own, right or wrong, with the payload that they have been told of.  Some brake when the
torque jumps (a reflex stop), until the plant is reset; their driver may limit its rate before.
"""

from __future__ import annotations

from math import exp, tanh
from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import called, inner
from blf_dsc_controller.compiled.layout import Array, Cell, size_of, view_of
from sim_plant.motion import Motion
from sim_plant.rigid_body import BodyMotion, RigidBodies, gravity_torque, locate


class Drives(NamedTuple):
    """Properties of the drives of all joints.

    The lag is solved exactly for a held command; the torque applied in a sample is its mean.
    """

    torque_limit: Annotated[Array, 'n']  # N m, 0 = none
    delay: int  # samples
    decay: float  # of the lag over a sample, exp(-T / time constant); 0: no lag
    mean_decay: float  # its mean over the sample
    torque_noise: float  # standard deviation, relative to the torque


class DriveState(NamedTuple):
    """Last applied torque, motor torque at the end of the sample, and a ring of delayed torques."""

    applied: Annotated[Array, 'n']  # N m
    motor: Annotated[Array, 'n']  # N m
    noise: Annotated[Array, 'n']  # standard normal
    ring: Annotated[Array, 'drives.delay', 'n']  # N m


@inner
def limited(torque: float, limit: float) -> float:
    """Clamp a torque to +-limit; 0 means no limit."""
    if limit == 0.0:
        return torque
    return min(max(torque, -limit), limit)


@inner
def actuate(drives: Drives, sample: int, command: Array, state: DriveState) -> None:
    """Process the command of this sample and write the torque applied in it to the state.

    Until the first command has passed the delay, the applied torque is zero.
    """
    for i in range(command.size):
        torque = command[i]
        if drives.delay > 0:
            slot = sample % drives.delay
            torque = state.ring[slot, i]
            state.ring[slot, i] = command[i]
        torque = limited(torque, drives.torque_limit[i])
        if drives.decay > 0.0:
            lacking = state.motor[i] - torque
            state.motor[i] = torque + drives.decay * lacking
            torque += drives.mean_decay * lacking
        if drives.torque_noise > 0.0:
            torque *= 1.0 + drives.torque_noise * state.noise[i]
        state.applied[i] = torque


def lag(time_constant: float, period: float) -> tuple[float, float]:
    """Return decay and mean decay over a period [s] of a lag with a time constant [s] (0: none)."""
    if time_constant == 0.0:
        return 0.0, 0.0
    decay = exp(-period / time_constant)
    return decay, time_constant / period * (1.0 - decay)


class Compensation(NamedTuple):
    """What the drives of all joints add, and the jump at which they stop."""

    friction: float  # share of viscous and Coulomb friction that they overcome
    effort_is_whole: int  # 1: the measured effort contains what they add
    effort_scale: float  # of the measured effort: 1, or A/N m of a current
    step: float  # N m from one command to the next that their driver lets pass; 0: any
    jump: float  # N m from one torque to the next at which they stop; 0: none


class CompensationState(NamedTuple):
    """What the drives added in the last sample, and whether they have stopped."""

    stopped: Cell
    command: Annotated[Array, 'n']  # the last one that the driver let pass, N m
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
    motion: Motion,
    q: Array,
    dq: Array,
    state: CompensationState,
) -> None:
    """Write what the drives add at q, dq (n,), by the true friction of a motion."""
    if bodies.size == 0:
        return
    fill_gravity(bodies, state.memory, q, state.still, state.added)
    if compensation.friction > 0.0:
        for i in range(q.size):
            torque = motion.acting.viscous[i] * dq[i]
            speed = dq[i] / motion.disturbance.coulomb_velocity[i]
            torque += motion.acting.coulomb[i] * tanh(speed)
            state.added[i] += compensation.friction * torque


@inner
def let_pass(compensation: Compensation, command: Array, state: CompensationState) -> bool:
    """Store what the driver lets pass of a command (n,); return whether the drives have stopped."""
    for i in range(command.size):
        last = state.command[i]
        change = limited(command[i] - last, compensation.step)
        state.command[i] = command[i] if change == command[i] - last else last + change
        # 1e-9: a command at the limit of its rate may be rounded beyond it.
        if compensation.jump > 0.0 and abs(change) > compensation.jump * (1.0 + 1e-9):
            state.stopped[0] = 1.0
    return bool(state.stopped[0] == 1.0)
