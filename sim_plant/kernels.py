# SPDX-License-Identifier: Apache-2.0
"""The sampled plant: a reading at each sample k, then a torque held over [k, k + 1].

Time is counted in whole nanoseconds, t_k = (k T_ns) 1e-9 s, so every caller computes
the same floats.  The ROS 2 node and the compiled offline loop run the same kernels and
agree bit for bit.

A reading has an offset, white noise and quantisation; its velocity is either measured,
with noise of its own, or differenced from the measured positions, and a low-pass filter
may follow.  Noise comes from one seeded generator, so the same seed repeats a run
exactly.

With springs between motors and links (`sim_plant.elastic`), the encoders are on either
side of them.

A command is limited in rate, late, limited, lagging and noisy.  Drives of cobots hold
the arm against gravity, and compensate part of their friction, by a model of their own,
right or wrong, with the payload that they are configured for.  Some brake when the
torque jumps (a reflex stop), until the plant is reset; their driver may limit its rate
before.
"""

from typing import Any

import numpy as np

from blf_dsc_controller.compiled.jit import inner, kernel
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.compiled.views import part, view
from blf_dsc_controller.numerics.elementary import exp, sin, tanh
from sim_plant.arm import Arm, fill_gravity
from sim_plant.layout import (
    MEASURED,
    MOTOR,
    Encoders,
    PlantSettings,
    PlantState,
    Springs,
    settings_of,
    state_of,
)
from sim_plant.motion import disturbing_torque, integrate, update_loads

DRIVE, MOVE, OBSERVE, TRUTH = 1, 2, 4, 8
"""Tasks of `run_plant`."""
STEP = DRIVE | MOVE


@inner
def plant_views(
    arm: Arm, settings: Array, state: Array
) -> tuple[PlantSettings, PlantState]:
    """Return views of both vectors, not reference-counted."""
    plant = settings_of(view(settings), arm, arm.joint_count())
    return plant, state_of(view(state), plant)


def generator(seed: int) -> np.random.Generator:
    """Return the generator of a seed: PCG64 on every version of numpy."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))


def drawn(plant: PlantSettings) -> slice:
    """Return which of the 4n random numbers of a reading are drawn at all.

    They are those of positions and velocities, of the torques, and of torque sensors.
    """
    encoders = plant.encoders
    sensed = encoders.position_noise > 0.0 or encoders.velocity_noise > 0.0
    n = plant.n
    last = 3 * n if plant.drives.torque_noise > 0.0 else 2 * n
    if np.any(plant.transmission.sensor_noise > 0.0):
        last = 4 * n
    return slice(0 if sensed else 2 * n, last)


@inner
def quantised(angle: float, resolution: float) -> float:
    """Round to the nearest multiple of the resolution; 0 means no quantisation."""
    if resolution == 0.0:
        return angle
    return float(np.rint(angle / resolution) * resolution)


@inner
def motor_position(plant: PlantSettings, now: PlantState, i: int) -> float:
    """Return the position of a motor [rad], which is that of its link without springs."""
    return float(now.elastic.theta[i] if plant.springs > 0 else now.x[i])


@inner
def motor_velocity(plant: PlantSettings, now: PlantState, i: int) -> float:
    """Return the velocity of a motor [rad/s]."""
    return float(now.elastic.dtheta[i] if plant.springs > 0 else now.x[plant.n + i])


@inner
def sense(plant: PlantSettings, now: PlantState) -> None:
    """Write the reading of this sample, including offset and noise.

    A differenced velocity spans the samples since the last reading; the first reading
    has no predecessor and gets the true velocity.
    """
    n = plant.n
    encoders = plant.encoders
    reading = now.reading
    first = reading.sample[0] < 0
    span = (int(now.sample[0]) - reading.sample[0]) * (plant.period_ns * 1e-9)
    filters = encoders.velocity_pole > 0.0 and not first
    old = exp(-encoders.velocity_pole * span) if filters else 0.0
    for i in range(n):
        q, dq = now.x[i], now.x[n + i]
        if encoders.side == MOTOR:
            q, dq = motor_position(plant, now, i), motor_velocity(plant, now, i)
        position = q + now.acting.offset[i] + encoders.position_noise * reading.noise[i]
        if encoders.eccentricity[i] != 0.0:
            position += encoders.eccentricity[i] * sin(q)
        position = quantised(position, encoders.resolution)
        if encoders.velocity_source == MEASURED:
            velocity = dq + encoders.velocity_noise * reading.noise[n + i]
        elif first:
            velocity = dq
        else:
            velocity = (position - reading.position[i]) / span
        if filters:
            velocity += old * (reading.velocity[i] - velocity)
        reading.velocity[i] = velocity
        reading.position[i] = position
    reading.sample[0] = now.sample[0]


@inner
def limited(torque: float, limit: float) -> float:
    """Clamp a torque to +-limit; 0 means no limit."""
    if limit == 0.0:
        return torque
    return min(max(torque, -limit), limit)


@inner
def apply_rate_limit(plant: PlantSettings, now: PlantState, command: Array) -> bool:
    """Store the rate-limited command (n,); return whether the drives have stopped."""
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


@inner
def compensate(plant: PlantSettings, now: PlantState) -> None:
    """Write what the drives add in this sample, by the true state and the true friction."""
    n = plant.n
    drives = plant.drives
    state = now.drives
    acting = now.acting
    if drives.bodies.size == 0:
        return
    fill_gravity(drives.bodies, state.memory, part(now.x, 0, (n,)), state.added)
    if drives.friction > 0.0:
        for i in range(n):
            dq = motor_velocity(plant, now, i)
            torque = acting.viscous[i] * dq
            torque += acting.coulomb[i] * tanh(dq / plant.disturbance.coulomb_velocity)
            state.eased[i] = drives.friction * torque
            state.added[i] += state.eased[i]


@inner
def is_repeat(encoders: Encoders, sample: Any) -> Any:
    """Return whether the encoders repeat their reading in this sample, or in each of several."""
    every = encoders.repeat_every
    return (every > 0) & (sample > 0) & (sample % max(every, 1) == 0)


@inner
def is_due(plant: PlantSettings, now: PlantState) -> bool:
    """Return whether the encoders read this sample, which they have not done yet."""
    sample = int(now.sample[0])
    is_new = now.reading.sample[0] != now.sample[0]
    return is_new and not is_repeat(plant.encoders, sample)


@inner
def observe(
    plant: PlantSettings, now: PlantState, noise: Array, measurement: Array
) -> None:
    """Write [q, dq, effort] (3n,) of this sample, with its standard normal noise (4n,).

    `effort` is the torque applied over the last interval [N m], as a whole, with a torque
    loop, what its sensors show; before the first interval, what the drives hold the arm with.
    Reading a sample again gives the same numbers.
    """
    n = plant.n
    if now.sample[0] == 0.0:
        update_loads(plant, now)
        compensate(plant, now)
    if is_due(plant, now):
        for i in range(2 * n):
            now.reading.noise[i] = noise[i]
        for i in range(n):
            now.drives.noise[i] = noise[2 * n + i]
            now.drives.sensed[i] = noise[3 * n + i]
        update_loads(plant, now)
        sense(plant, now)
    for i in range(n):
        measurement[i] = now.reading.position[i]
        measurement[n + i] = now.reading.velocity[i]
        effort = now.drives.applied[i]
        if plant.drives.effort_is_whole == 1:
            effort += now.drives.added[i]
            if plant.transmission.loop_gain > 0.0:
                effort = sensed_torque(plant, now, i, effort)
        measurement[2 * n + i] = effort * plant.drives.effort_scale


@inner
def sensed_torque(plant: PlantSettings, now: PlantState, i: int, held: float) -> float:
    """Return what the torque sensor of a joint shows [N m]; the drives have `held` the arm."""
    torque = held if now.sample[0] == 0.0 else now.elastic.transmitted[i]
    noise = plant.transmission.sensor_noise[i] * now.drives.sensed[i]
    return float(shown(plant.transmission, i, torque) + noise)


@inner
def shown(springs: Springs, i: int, torque: float) -> float:
    """Return the torque [N m] of a joint as its sensor shows it, without noise."""
    return float(springs.sensor_factor[i] * torque + springs.sensor_offset[i])


@inner
def drive(plant: PlantSettings, now: PlantState, command: Array) -> None:
    """Write what the drives make of the commanded torque (n,) [N m] in this sample, and the loads.

    If they stop, the arm stands still at once.
    """
    drives = now.drives
    if apply_rate_limit(plant, now, command):
        for i in range(plant.n):
            now.x[plant.n + i] = drives.applied[i] = drives.motor[i] = 0.0
        return
    actuate(plant, now, drives.command)
    update_loads(plant, now)
    compensate(plant, now)
    for i in range(plant.n):
        drives.whole[i] = drives.applied[i] + drives.added[i]


@inner
def move(plant: PlantSettings, now: PlantState) -> None:
    """Advance to the next sample, with the torque of the drives."""
    if now.drives.stopped[0] == 0.0:
        h = plant.period_ns * 1e-9 / plant.steps
        for k in range(plant.steps):
            t = now.sample[0] * plant.period_ns * 1e-9 + k * h
            integrate(plant, now, t, h, now.drives.whole)
    now.sample[0] += 1.0


@inner
def truth(plant: PlantSettings, now: PlantState, out: Array) -> None:
    """Write the noise-free truth [P, tau_dist, q, dq] (p + 3n,) of this sample."""
    n = plant.n
    update_loads(plant, now)
    plant.arm.fill_parameters(now.acting.payload[0], out)
    t = now.sample[0] * plant.period_ns * 1e-9
    disturbing_torque(plant, now, t, now.x, part(out, plant.p, (n,)))
    for i in range(2 * n):
        out[plant.p + n + i] = now.x[i]


@kernel
def run_plant(
    arm: Arm,
    settings: Array,
    state: Array,
    noise: Array,
    tasks: int,
    command: Array,
    measurement: Array,
    out: Array,
) -> None:
    """Do the tasks, a sum of them, in their order, with packed vectors."""
    plant, now = plant_views(arm, settings, state)
    if tasks & DRIVE:
        drive(plant, now, command)
    if tasks & MOVE:
        move(plant, now)
    if tasks & OBSERVE:
        observe(plant, now, noise, measurement)
    if tasks & TRUTH:
        truth(plant, now, out)
