# SPDX-License-Identifier: Apache-2.0
"""The sampled plant: a reading at each sample k, then a torque held over [k, k + 1].

Settings and state are one flat vector each.  Time is counted in whole nanoseconds,
t_k = (k T_ns) 1e-9 s, so every caller computes the same floats.  The ROS 2 node and the compiled
offline loop run the same kernels and agree bit for bit.
"""

from typing import Annotated, NamedTuple

import numpy as np

from blf_dsc_controller.compiled.jit import inner, kernel
from blf_dsc_controller.compiled.layout import Array, Cell, Passed, part, size_of, view, view_of
from sim_plant.arm import Arm
from sim_plant.drives import (
    Compensation,
    CompensationState,
    Drives,
    DriveState,
    actuate,
    compensate,
    let_pass,
)
from sim_plant.motion import (
    Acting,
    EventSettings,
    JointDisturbance,
    LoadSettings,
    Motion,
    SloshSettings,
    Stages,
    TipState,
    WallSettings,
    disturbing_torque,
    integrate,
    locate_tip,
    update_acting,
)
from sim_plant.sensors import EncoderReading, Encoders, draw, is_noisy, sense


class PlantSettings(NamedTuple):
    """Everything that defines a plant except its seed and its initial state.

    The arm is passed to kernels as is, everything else in one vector.
    """

    arm: Arm
    n: Passed  # joints of the arm
    p: int  # parameters of the arm
    period_ns: int
    steps: int  # of the integrator in a sample
    events: int  # number of events
    encoders: Encoders
    disturbance: JointDisturbance
    drives: Drives
    compensation: Compensation
    drive_size: int  # of drive_bodies; 0: the drives add nothing
    drive_memory: int
    drive_bodies: Annotated[Array, 'drive_size']  # RigidBodies, as the drives know them
    load: LoadSettings
    wall: WallSettings
    slosh: SloshSettings
    schedule: EventSettings


class PlantState(NamedTuple):
    """Everything that changes from sample to sample except the random generator."""

    sample: Cell  # k
    x: Annotated[Array, '2 * n + 6']  # q [rad], dq [rad/s], noise-free; load: y [m], v [m/s]
    sloshes: Cell  # 1: y and v are those of a load
    reading: EncoderReading
    drives: DriveState
    compensation: CompensationState
    stages: Stages
    acting: Acting
    tip: TipState


settings_of = view_of(PlantSettings)
state_of, state_size = view_of(PlantState), size_of(PlantState)


@inner
def plant_views(arm: Arm, settings: Array, state: Array) -> tuple[PlantSettings, PlantState]:
    """Return views of both vectors, not reference-counted."""
    plant = settings_of(view(settings), arm, arm.joint_count())
    return plant, state_of(view(state), plant)


@inner
def attach_load(plant: PlantSettings, now: PlantState) -> None:
    """Place a sloshing load that begins at the tip, moving with it."""
    n, sloshes = plant.n, now.acting.sloshing[0] > 0.0
    if sloshes and now.sloshes[0] == 0.0:
        locate_tip(plant.arm, part(now.x, 0, (n,)), part(now.x, n, (n,)), now.tip)
        for i in range(3):
            now.x[2 * n + i] = now.tip.position[i]
            now.x[2 * n + 3 + i] = now.tip.velocity[i]
    now.sloshes[0] = 1.0 if sloshes else 0.0


@inner
def update_motion(plant: PlantSettings, now: PlantState) -> Motion:
    """Return the equation of motion of this sample."""
    update_acting(plant.disturbance, plant.load, plant.schedule, now.sample[0], now.acting)
    attach_load(plant, now)
    return Motion(plant.arm, plant.disturbance, now.acting, plant.wall, plant.slosh, now.tip)


@inner
def add_compensation(plant: PlantSettings, now: PlantState) -> None:
    """Compute what the drives add in this sample, by the true state."""
    n, motion = plant.n, update_motion(plant, now)
    q, dq = part(now.x, 0, (n,)), part(now.x, n, (n,))
    compensate(plant.compensation, plant.drive_bodies, motion, q, dq, now.compensation)


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
        add_compensation(plant, now)
    if is_due(plant, now):
        update_motion(plant, now)
        q, dq = part(now.x, 0, (n,)), part(now.x, n, (n,))
        offset = now.acting.offset
        period = plant.period_ns * 1e-9
        sense(plant.encoders, int(now.sample[0]), period, q, dq, offset, now.reading)
    for i in range(n):
        measurement[i] = now.reading.position[i]
        measurement[n + i] = now.reading.velocity[i]
        measurement[2 * n + i] = now.drives.applied[i]
        if plant.compensation.effort_is_whole == 1:
            measurement[2 * n + i] += now.compensation.added[i]
        measurement[2 * n + i] *= plant.compensation.effort_scale


@inner
def step(plant: PlantSettings, now: PlantState, command: Array) -> None:
    """Apply the commanded torque (n,) [N m] of this sample and advance to the next one."""
    own = now.compensation
    if let_pass(plant.compensation, command, own):
        for i in range(plant.n):
            now.x[plant.n + i] = now.drives.applied[i] = now.drives.motor[i] = 0.0
        now.sample[0] += 1.0
        return
    actuate(plant.drives, int(now.sample[0]), own.command, now.drives)
    motion = update_motion(plant, now)
    add_compensation(plant, now)
    for i in range(plant.n):
        own.whole[i] = now.drives.applied[i] + own.added[i]
    h = plant.period_ns * 1e-9 / plant.steps
    for k in range(plant.steps):
        t = now.sample[0] * plant.period_ns * 1e-9 + k * h
        integrate(motion, t, h, own.whole, now.x, now.stages)
    now.sample[0] += 1.0


@inner
def truth(plant: PlantSettings, now: PlantState, out: Array) -> None:
    """Write the noise-free truth [P, tau_dist, q, dq] (p + 3n,) of this sample."""
    n = plant.n
    t = now.sample[0] * plant.period_ns * 1e-9
    motion = update_motion(plant, now)
    plant.arm.fill_parameters(now.acting.payload[0], out)
    disturbing_torque(motion, t, now.x, part(out, plant.p, (n,)))
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


KERNELS = (observe_plant, step_plant, plant_truth)
"""Plant kernels that are called from Python; compiled before the node starts."""
