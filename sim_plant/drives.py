# SPDX-License-Identifier: Apache-2.0
"""From a command to the torque at the joint: delay, limit, lag, noise, and what drives add.

Drives of cobots hold the arm against gravity, and overcome part of their friction, by a model of
their own, right or wrong, with the payload that they have been told of.  Some brake when the
torque jumps (a reflex stop), until the plant is reset; their driver may limit its rate before.
"""

from blf_dsc_controller.compiled.elementary import exp, tanh
from blf_dsc_controller.compiled.jit import called, inner
from blf_dsc_controller.compiled.layout import Array, part, size_of, view_of
from sim_plant.layout import PlantSettings, PlantState
from sim_plant.rigid_body import BodyMotion, RigidBodies, gravity_torque, locate


@inner
def limited(torque: float, limit: float) -> float:
    """Clamp a torque to +-limit; 0 means no limit."""
    if limit == 0.0:
        return torque
    return min(max(torque, -limit), limit)


@inner
def let_pass(plant: PlantSettings, now: PlantState, command: Array) -> bool:
    """Store what the driver lets pass of a command (n,); return whether the drives have stopped."""
    drives, state = plant.drives, now.drives
    for i in range(plant.n):
        last = state.command[i]
        change = limited(command[i] - last, drives.step)
        state.command[i] = command[i] if change == command[i] - last else last + change
        # 1e-9: a command at the limit of its rate may be rounded beyond it.
        if drives.jump > 0.0 and abs(change) > drives.jump * (1.0 + 1e-9):
            state.stopped[0] = 1.0
    return bool(state.stopped[0] == 1.0)


@inner
def actuate(plant: PlantSettings, now: PlantState, command: Array) -> None:
    """Process the command (n,) of this sample and write the torque applied in it to the state.

    Until the first command has passed the delay, the applied torque is zero.
    """
    drives, state = plant.drives, now.drives
    for i in range(plant.n):
        torque = command[i]
        if drives.delay > 0:
            slot = int(now.sample[0]) % drives.delay
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


bodies_of, motion_of, memory_size = view_of(RigidBodies), view_of(BodyMotion), size_of(BodyMotion)


@called
def fill_gravity(bodies_vector: Array, memory: Array, q: Array, still: Array, out: Array) -> None:
    """Write the torque (n,) [N m] that holds the bodies at q against gravity."""
    bodies = bodies_of(bodies_vector)
    now = motion_of(memory, bodies)
    locate(bodies, q, still, now)
    gravity_torque(bodies, now, out)


@inner
def compensate(plant: PlantSettings, now: PlantState) -> None:
    """Write what the drives add in this sample, by the true state and the true friction."""
    n, drives, state, acting = plant.n, plant.drives, now.drives, now.acting
    if drives.bodies.size == 0:
        return
    fill_gravity(drives.bodies, state.memory, part(now.x, 0, (n,)), state.still, state.added)
    if drives.friction > 0.0:
        for i in range(n):
            dq = now.x[n + i]
            torque = acting.viscous[i] * dq
            torque += acting.coulomb[i] * tanh(dq / plant.disturbance.coulomb_velocity)
            state.added[i] += drives.friction * torque
