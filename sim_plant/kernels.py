# SPDX-License-Identifier: Apache-2.0
"""The sampled plant: a reading at each sample k, then a torque held over [k, k + 1].

Time is counted in whole nanoseconds, t_k = (k T_ns) 1e-9 s, so every caller computes the same
floats.  The ROS 2 node and the compiled offline loop run the same kernels and agree bit for bit.
"""

import numpy as np

from blf_dsc_controller.compiled.jit import inner, kernel
from blf_dsc_controller.compiled.layout import Array, part, view
from sim_plant.arm import Arm
from sim_plant.drives import actuate, compensate, draw, is_noisy, let_pass, sense
from sim_plant.layout import PlantSettings, PlantState, settings_of, state_of
from sim_plant.motion import disturbing_torque, integrate, update_loads


@inner
def plant_views(arm: Arm, settings: Array, state: Array) -> tuple[PlantSettings, PlantState]:
    """Return views of both vectors, not reference-counted."""
    plant = settings_of(view(settings), arm, arm.joint_count())
    return plant, state_of(view(state), plant)


@inner
def is_due(plant: PlantSettings, now: PlantState) -> bool:
    """Return whether the encoders read this sample, which they have not done yet."""
    sample, every = int(now.sample[0]), plant.encoders.repeat_every
    is_repeat = every > 0 and sample > 0 and sample % every == 0
    return now.reading.sample[0] != now.sample[0] and not is_repeat


@inner
def draw_noise(plant: PlantSettings, now: PlantState, rng: np.random.Generator) -> None:
    """Draw encoder and drive noise for this sample, unless it has been read already."""
    if is_due(plant, now):
        if is_noisy(plant.encoders):
            draw(rng, now.reading.noise)
        if plant.drives.torque_noise > 0.0:
            draw(rng, now.drives.noise)


@inner
def observe(plant: PlantSettings, now: PlantState, measurement: Array) -> None:
    """Write [q, dq, effort] (3n,) of this sample, with the noise already drawn.

    `effort` is the torque applied over the last interval [N m], before the first one that with
    which the drives hold the arm.  Reading a sample again gives the same numbers.
    """
    n = plant.n
    if now.sample[0] == 0.0:
        update_loads(plant, now)
        compensate(plant, now)
    if is_due(plant, now):
        update_loads(plant, now)
        sense(plant, now)
    for i in range(n):
        measurement[i] = now.reading.position[i]
        measurement[n + i] = now.reading.velocity[i]
        measurement[2 * n + i] = now.drives.applied[i]
        if plant.drives.effort_is_whole == 1:
            measurement[2 * n + i] += now.drives.added[i]
        measurement[2 * n + i] *= plant.drives.effort_scale


@inner
def step(plant: PlantSettings, now: PlantState, command: Array) -> None:
    """Apply the commanded torque (n,) [N m] of this sample and advance to the next one."""
    drives = now.drives
    if let_pass(plant, now, command):
        for i in range(plant.n):
            now.x[plant.n + i] = drives.applied[i] = drives.motor[i] = 0.0
        now.sample[0] += 1.0
        return
    actuate(plant, now, drives.command)
    update_loads(plant, now)
    compensate(plant, now)
    for i in range(plant.n):
        drives.whole[i] = drives.applied[i] + drives.added[i]
    h = plant.period_ns * 1e-9 / plant.steps
    for k in range(plant.steps):
        t = now.sample[0] * plant.period_ns * 1e-9 + k * h
        integrate(plant, now, t, h, drives.whole)
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
def observe_plant(arm: Arm, settings: Array, state: Array, measurement: Array) -> None:
    """Call `observe` with packed vectors."""
    plant, now = plant_views(arm, settings, state)
    observe(plant, now, measurement)


@kernel
def step_plant(arm: Arm, settings: Array, state: Array, command: Array) -> None:
    """Call `step` with packed vectors."""
    plant, now = plant_views(arm, settings, state)
    step(plant, now, command)


@kernel
def plant_truth(arm: Arm, settings: Array, state: Array, out: Array) -> None:
    """Call `truth` with packed vectors."""
    plant, now = plant_views(arm, settings, state)
    truth(plant, now, out)
