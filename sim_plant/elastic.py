# SPDX-License-Identifier: Apache-2.0
"""Arms with elastic joints: motors that drive their links through springs, on a base that may sway.

For each joint, with the position theta of its motor and q of its link,

    M(q) ddq + C(q, dq) dq + G(q) + load = s,           B ddtheta + friction + s = u,
    s = K (theta - q) + D (dtheta - dq)

(Spong, Modeling and Control of Elastic Joint Robots, 1987). M is that of the links
alone. Friction and ripple are those of the motor, pushes load the link. A gear with
play has no torque within it. The hysteresis of a gear is dry friction that adds to s; it
builds up with the stiffness of the spring (Dahl, 1968):

    dz = K (1 - sgn(dw) z / z_max) dw,                   w = theta - q

Drives with a joint torque sensor close a loop around the spring, with a lag from the
right-hand side to u:

    u = tau + k_T (tau - s') - k_S ds'/dt,              s' = f s + offset

where s' is what the sensor shows, with its error of scale f.
A joint without stiffness is rigid: M has its motor, u and the friction act on its link.
A base that gives way has coordinates of its own before those of the links, on springs
and dampers that carry the arm's weight without a deflection.

A sample is divided into blocks, in each of which M^-1 and C dq + G are those in its
middle, as predicted.  Springs and motors take many steps in a block: half a step of the
positions, all velocities by the midpoint rule, half a step of the positions.  Without
velocity-dependent torques this is the leapfrog, which keeps the energy of a block.
"""

from blf_dsc_controller.compiled.jit import inner, kernel
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.numerics.elementary import exp, sin
from sim_plant.arm import RigidArm, fill_mobility, fill_tip
from sim_plant.kernels import (
    DRIVE,
    MOVE,
    OBSERVE,
    TRUTH,
    drive,
    limited,
    observe,
    plant_views,
    shown,
)
from sim_plant.layout import PlantSettings, PlantState
from sim_plant.motion import dry_friction, put, subtract_tip_torque, update_loads

REST, PREDICT, SWING = 16, 32, 64
"""Further tasks of `run_elastic_plant`; the last two where something else computes the links."""


@inner
def predict(plant: PlantSettings, now: PlantState) -> None:
    """Write where base and links will be in the middle of this block."""
    state, memory = now.elastic, now.elastic_memory
    half = 0.5 * plant.period_ns * 1e-9 / plant.blocks
    for i in range(state.q.size):
        memory.q[i] = state.q[i] + half * state.dq[i]
        memory.dq[i] = state.dq[i] + 0.5 * (state.dq[i] - state.dq_before[i])
    put(state.dq_before, state.dq)


@inner
def fill_links(arm: RigidArm, now: PlantState) -> None:
    """Write M^-1, C dq + G, and the Jacobian of the tip, where the links are predicted."""
    memory = now.elastic_memory
    fill_mobility(
        arm.bodies,
        arm.memory,
        now.acting.payload[0],
        memory.q,
        memory.dq,
        memory.inverse,
        memory.bias,
    )
    if is_pushed(now):
        fill_tip(arm.bodies, arm.memory, memory.q, now.memory.tip, now.memory.jacobian)


@inner
def is_pushed(now: PlantState) -> bool:
    """Whether anything but the payload acts on the tip."""
    push = now.acting.force
    pushes = push[0] != 0.0 or push[1] != 0.0 or push[2] != 0.0
    return bool(pushes or now.acting.sloshing[0] > 0.0)


@inner
def push_tip(now: PlantState) -> None:
    """Subtract from the bias what a push at the tip adds to the torques."""
    bias = now.elastic_memory.bias
    if not is_pushed(now):
        return
    for i in range(3):
        for j in range(bias.size):
            bias[j] -= now.memory.jacobian[i, j] * now.acting.force[i]


@inner
def add_disturbance(
    plant: PlantSettings, now: PlantState, t: float, out: Array
) -> None:
    """Add the disturbance of the links at time t [s] to torques, those of the base first."""
    given, acting = plant.disturbance, now.acting
    for i in range(plant.n):
        angle = given.frequency[i] * t + given.phase[i]
        wave = given.amplitude[i] * sin(angle)
        out[plant.mounts + i] += acting.constant[i] + wave


@inner
def swing(plant: PlantSettings, now: PlantState) -> None:
    """Advance by a block, with M^-1, C dq + G and the Jacobian that are in the memory."""
    state, memory = now.elastic, now.elastic_memory
    block = plant.period_ns * 1e-9 / plant.blocks
    start = now.sample[0] * plant.period_ns * 1e-9 + state.block[0] * block
    add_disturbance(plant, now, start + 0.5 * block, memory.bias)
    push_tip(now)
    h = block / plant.steps
    for i in range(plant.n):
        memory.sum[i] = 0.0 if state.block[0] == 0.0 else memory.sum[i]
    for _ in range(plant.steps):
        drift(plant, now, 0.5 * h)
        kick(plant, now, h)
        drift(plant, now, 0.5 * h)
    state.block[0] += 1.0
    if state.block[0] == plant.blocks:
        end_sample(plant, now)


@inner
def end_sample(plant: PlantSettings, now: PlantState) -> None:
    """Write what others see of the links, and begin the next sample."""
    state = now.elastic
    for i in range(plant.n):
        now.x[i] = state.q[plant.mounts + i]
        now.x[plant.n + i] = state.dq[plant.mounts + i]
        total = now.elastic_memory.sum[i]
        state.transmitted[i] = total / (plant.steps * plant.blocks)
    state.block[0] = 0.0
    now.sample[0] += 1.0


@inner
def drift(plant: PlantSettings, now: PlantState, h: float) -> None:
    """Move base, links and motors by their velocities for h seconds; their springs follow."""
    state, springs = now.elastic, plant.transmission
    if now.acting.sloshing[0] > 0.0:
        for i in range(2 * plant.n, 2 * plant.n + 3):
            now.x[i] += h * now.x[i + 3]
    for i in range(state.q.size):
        state.q[i] += h * state.dq[i]
    for i in range(plant.n):
        link = plant.mounts + i
        if springs.stiffness[i] == 0.0:
            state.theta[i] = state.q[link]
            continue
        state.theta[i] += h * state.dtheta[i]
        if springs.hysteresis[i] > 0.0:
            change = h * (state.dtheta[i] - state.dq[link])
            slip(plant, now, i, change)


@inner
def slip(plant: PlantSettings, now: PlantState, i: int, change: float) -> None:
    """Advance the hysteresis of a spring whose twist changes: exact for a constant velocity."""
    springs, z = plant.transmission, now.elastic.hysteresis
    largest = springs.hysteresis[i] if change > 0.0 else -springs.hysteresis[i]
    left = exp(-springs.stiffness[i] * abs(change) / springs.hysteresis[i])
    z[i] = largest + left * (z[i] - largest)


@inner
def twist_springs(plant: PlantSettings, now: PlantState) -> None:
    """Write the torque of each spring by its twist, and whether it is beyond its play."""
    state, memory, springs = now.elastic, now.elastic_memory, plant.transmission
    for i in range(plant.n):
        twist = state.theta[i] - state.q[plant.mounts + i]
        within = min(max(twist, -springs.play[i]), springs.play[i])
        memory.touches[i] = 1.0 if twist != within or springs.play[i] == 0.0 else 0.0
        memory.spring[i] = springs.stiffness[i] * (twist - within) + state.hysteresis[i]


@inner
def kick(plant: PlantSettings, now: PlantState, h: float) -> None:
    """Change all velocities for h seconds, with the positions held, by the midpoint rule."""
    state, memory = now.elastic, now.elastic_memory
    twist_springs(plant, now)
    slosh(plant, now, h)
    close_loop(plant, now)
    accelerate(plant, now, state.dq, state.dtheta)
    for i in range(state.q.size):
        memory.speed[i] = state.dq[i] + 0.5 * h * memory.ddq[i]
    for i in range(plant.n):
        memory.motor_speed[i] = state.dtheta[i] + 0.5 * h * memory.ddtheta[i]
    accelerate(plant, now, memory.speed, memory.motor_speed)
    for i in range(state.q.size):
        state.dq[i] += h * memory.ddq[i]
    for i in range(plant.n):
        link = plant.mounts + i
        state.dtheta[i] += h * memory.ddtheta[i]
        if plant.transmission.stiffness[i] == 0.0:
            state.dtheta[i] = state.dq[link]
        memory.sum[i] += memory.force[link]
    close_loop(plant, now)


@inner
def close_loop(plant: PlantSettings, now: PlantState) -> None:
    """Write the torque of the motors half a step later: that of the drives, or of their loop.

    What the drives add against friction is for the motor, not for the spring.
    """
    state, memory, springs = now.elastic, now.elastic_memory, plant.transmission
    for i in range(plant.n):
        torque = now.drives.whole[i]
        if springs.loop_gain > 0.0:
            rate = state.dtheta[i] - state.dq[plant.mounts + i]
            rate *= springs.sensor_factor[i] * springs.stiffness[i] * memory.touches[i]
            sensed = shown(springs, i, memory.spring[i])
            missing = torque - now.drives.eased[i] - sensed
            torque += springs.loop_gain * missing - springs.loop_damping * rate
            torque = limited(torque, springs.loop_limit[i])
            torque += springs.loop_decay * (state.torque[i] - torque)
        state.torque[i] = torque


@inner
def slosh(plant: PlantSettings, now: PlantState, h: float) -> None:
    """Write what loads the links, and change the velocity of a sloshing mass for h seconds.

    The tip is where its Jacobian takes it from the middle of the block.
    """
    state, memory, tip = now.elastic, now.elastic_memory, now.memory
    mass = now.acting.sloshing[0]
    put(memory.load, memory.bias)
    if mass == 0.0:
        return
    at = 2 * plant.n
    for i in range(3):
        lead, speed = now.x[at + i] - tip.tip[i], now.x[at + 3 + i]
        for j in range(state.q.size):
            lead -= tip.jacobian[i, j] * (state.q[j] - memory.q[j])
            speed -= tip.jacobian[i, j] * state.dq[j]
        pull = plant.load.stiffness * lead + plant.load.damping * speed
        now.x[at + 3 + i] += h * (plant.load.gravity[i] - pull)
        for j in range(state.q.size):
            memory.load[j] -= tip.jacobian[i, j] * mass * pull


@inner
def accelerate(plant: PlantSettings, now: PlantState, dq: Array, dtheta: Array) -> None:
    """Write the accelerations of base and links, and of motors, at their velocities."""
    memory, springs = now.elastic_memory, plant.transmission
    support_base(plant, now, dq)
    for i in range(plant.n):
        link = plant.mounts + i
        torque = now.elastic.torque[i]
        if springs.stiffness[i] == 0.0:
            torque -= friction(plant, now, i, dq[link], torque)
            memory.force[link] = torque
            continue
        twisting = memory.touches[i] * (dtheta[i] - dq[link])
        passed = memory.spring[i] + springs.damping[i] * twisting
        torque -= passed + friction(plant, now, i, dtheta[i], passed)
        memory.ddtheta[i] = springs.mobility[i] * torque
        memory.force[link] = passed
    for i in range(dq.size):
        memory.ddq[i] = 0.0
    for j in range(dq.size):
        net = memory.force[j] - memory.load[j]
        # by rows of a symmetric matrix, whose entries are adjacent
        for i in range(dq.size):
            memory.ddq[i] += memory.inverse[j, i] * net


@inner
def support_base(plant: PlantSettings, now: PlantState, dq: Array) -> None:
    """Write the forces of the base's springs and dampers."""
    base, state = plant.base, now.elastic
    for i in range(plant.mounts):
        force = state.preload[i]
        for j in range(plant.mounts):
            force -= base.stiffness[i, j] * state.q[j] + base.damping[i, j] * dq[j]
        now.elastic_memory.force[i] = force


@inner
def friction(
    plant: PlantSettings, now: PlantState, i: int, speed: float, load: float
) -> float:
    """Return friction and ripple [N m] of a motor at its speed, with a load [N m] on its gear."""
    given = plant.disturbance
    torque = now.acting.viscous[i] * speed + dry_friction(plant, now, i, speed, load)
    if given.ripple[i] != 0.0:
        angle = given.ripple_frequency * now.elastic.theta[i]
        torque += given.ripple[i] * sin(angle)
    return float(torque)


@inner
def move(arm: RigidArm, plant: PlantSettings, now: PlantState, tasks: int) -> None:
    """Advance to the next sample with the torque of the drives, or by parts of a block."""
    moves = tasks & MOVE
    if moves and now.drives.stopped[0] != 0.0:
        stand_still(now)
        return
    for _ in range(plant.blocks if moves else 1):
        if moves or tasks & PREDICT:
            predict(plant, now)
        if moves:
            fill_links(arm, now)
        if moves or tasks & SWING:
            swing(plant, now)


@inner
def stand_still(now: PlantState) -> None:
    """Brake base, links and motors at once, and advance to the next sample."""
    state = now.elastic
    for i in range(state.q.size):
        state.dq[i] = state.dq_before[i] = 0.0
    for i in range(state.theta.size):
        state.dtheta[i] = 0.0
    now.sample[0] += 1.0


@inner
def rest(arm: RigidArm, plant: PlantSettings, now: PlantState) -> None:
    """Load the springs with the weight of the links, as the brakes of the motors hold them."""
    state, memory, springs = now.elastic, now.elastic_memory, plant.transmission
    for i in range(plant.n):
        link = plant.mounts + i
        state.q[link], state.dq[link] = now.x[i], now.x[plant.n + i]
    put(memory.q, state.q)
    for i in range(memory.dq.size):
        memory.dq[i] = 0.0
    put(state.dq_before, state.dq)
    update_loads(plant, now)
    fill_links(arm, now)
    add_disturbance(plant, now, 0.0, memory.bias)
    push_tip(now)
    for i in range(plant.mounts):
        state.preload[i] = memory.bias[i]
    for i in range(plant.n):
        link = plant.mounts + i
        torque = memory.bias[link]
        state.theta[i], state.dtheta[i] = state.q[link], state.dq[link]
        state.torque[i] = state.transmitted[i] = torque
        if springs.stiffness[i] > 0.0:
            play = springs.play[i] if torque > 0.0 else -springs.play[i]
            state.theta[i] += torque / springs.stiffness[i] + play


@inner
def truth(plant: PlantSettings, now: PlantState, out: Array) -> None:
    """Write the truth [P, tau_dist, q, dq] (p + 3n,) of this sample, as commands see it.

    A torque loop makes the friction of the motors smaller by its gain, but follows its sensors.
    """
    n, state = plant.n, now.elastic
    update_loads(plant, now)
    plant.arm.fill_parameters(now.acting.payload[0], out)
    torque = now.elastic_memory.load
    for i in range(torque.size):
        torque[i] = 0.0
    t = now.sample[0] * plant.period_ns * 1e-9
    add_disturbance(plant, now, t, torque)
    subtract_tip_torque(plant, now, state.q, state.dq, now.x, torque)
    for i in range(n):
        passed = now.drives.whole[i]
        if plant.transmission.stiffness[i] > 0.0:
            passed = state.transmitted[i]
        own = friction(plant, now, i, state.dtheta[i], passed)
        loop = plant.transmission.loop_gain
        own += loop * (shown(plant.transmission, i, passed) - passed)
        own /= 1.0 + loop
        out[plant.p + i] = torque[plant.mounts + i] + own
        out[plant.p + n + i] = now.x[i]
        out[plant.p + 2 * n + i] = now.x[n + i]


@kernel
def run_elastic_plant(
    arm: RigidArm,
    settings: Array,
    state: Array,
    noise: Array,
    tasks: int,
    command: Array,
    measurement: Array,
    out: Array,
) -> None:
    """Do the tasks, a sum of them, in their order, as `run_plant` does without springs."""
    plant, now = plant_views(arm, settings, state)
    if tasks & REST:
        rest(arm, plant, now)
    if tasks & DRIVE:
        drive(plant, now, command)
    if tasks & (MOVE | PREDICT | SWING):
        move(arm, plant, now, tasks)
    if tasks & OBSERVE:
        observe(plant, now, noise, measurement)
    if tasks & TRUTH:
        truth(plant, now, out)
