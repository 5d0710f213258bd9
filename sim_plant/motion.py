# SPDX-License-Identifier: Apache-2.0
"""Equation of motion of an arm under a torque, a disturbance, events, and forces at its tip.

Vectors are in the base frame: x to the right, z up.  A force f at the tip loads the joints with
J^T f, where J is the Jacobian of the tip position.  The sloshing load is a point mass m on a damped
spring at the tip. With its position y and velocity v, those of the tip x and dx, and
a = omega^2 (y - x) + 2 zeta omega (v - dx),

    y' = v,   v' = g - a,   force on the tip: m a,

so its motion does not depend on m, which may be ramped.  Loads and events are held over a sample.

A step is fixed, with the torque held and the disturbance varying: the fifth-order solution of
Dormand and Prince (1980), which MATLAB calls ode5.  Stage i is evaluated at t + c_i h and
x + h sum_j a_ij k_j; the step ends at x + h sum_i b_i k_i.
"""

from math import exp, sin, tanh
from typing import Annotated, NamedTuple

import numpy as np

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, Cell, part
from sim_plant.arm import Arm


class JointDisturbance(NamedTuple):
    """Disturbance of each joint; constant, viscous and coulomb as they are without events."""

    constant: Annotated[Array, 'n']  # N m
    amplitude: Annotated[Array, 'n']  # N m
    frequency: Annotated[Array, 'n']  # rad/s
    phase: Annotated[Array, 'n']  # rad
    viscous: Annotated[Array, 'n']  # N m s/rad
    coulomb: Annotated[Array, 'n']  # N m
    coulomb_velocity: Annotated[Array, 'n']  # rad/s, at which tanh reaches three quarters
    stribeck: float  # additional friction near rest, relative to Coulomb friction
    stribeck_velocity: float  # rad/s
    ripple: Annotated[Array, 'n']  # N m
    ripple_frequency: float  # rad/rad


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


@inner
def wall_force(wall: WallSettings, position: Array, velocity: Array) -> float:
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
def locate_tip(arm: Arm, q: Array, dq: Array, tip: TipState) -> None:
    """Write position, velocity and Jacobian of the tip."""
    arm.fill_tip(q, tip.position, tip.jacobian)
    for i in range(3):
        tip.velocity[i] = 0.0
        for j in range(dq.size):
            tip.velocity[i] += tip.jacobian[i, j] * dq[j]


class LoadSettings(NamedTuple):
    """Load that acts all the time."""

    payload: float  # kg, point mass at the tip
    torque: Annotated[Array, 'n']  # N m, pushes the joints
    force: Annotated[Array, '3']  # N, pushes the tip, in the frame of the base
    offset: Annotated[Array, 'n']  # rad, measured minus true position


class EventSettings(NamedTuple):
    """Contribution of each event to load and friction; times are in samples."""

    begin: Annotated[Array, 'events']
    end: Annotated[Array, 'events']  # infinite: permanent
    ramp: Annotated[Array, 'events']
    payload: Annotated[Array, 'events']
    sloshing: Annotated[Array, 'events']
    torque: Annotated[Array, 'events', 'n']
    force: Annotated[Array, 'events', '3']
    viscous: Annotated[Array, 'events', 'n']
    coulomb: Annotated[Array, 'events', 'n']
    offset: Annotated[Array, 'events', 'n']


class Acting(NamedTuple):
    """Sum of load and events in one sample."""

    sample: Cell  # of the sum; -1: none yet
    payload: Cell  # kg
    sloshing: Cell  # kg
    force: Annotated[Array, '3']  # N
    offset: Annotated[Array, 'n']  # rad
    constant: Annotated[Array, 'n']  # N m, of the disturbance, less torques that push the joints
    viscous: Annotated[Array, 'n']  # N m s/rad, not below zero
    coulomb: Annotated[Array, 'n']  # N m, not below zero


@inner
def come(sample: float, at: float, ramp: float) -> float:
    """Return the fraction, from 0 to 1, of a ramp of `ramp` samples that begins at sample `at`."""
    if sample < at:
        return 0.0
    if sample >= at + ramp:
        return 1.0
    return (sample - at) / ramp


@inner
def add(total: Array, fraction: float, vector: Array) -> None:
    """Add a fraction of one vector to another."""
    for i in range(total.size):
        total[i] += fraction * vector[i]


@inner
def put(target: Array, values: Array) -> None:
    """Copy a vector; `target[:] = values` compiles ten functions just for a shape error."""
    for i in range(target.size):
        target[i] = values[i]


@inner
def update_acting(
    disturbance: JointDisturbance,
    load: LoadSettings,
    events: EventSettings,
    sample: float,
    acting: Acting,
) -> None:
    """Sum load and events of a sample, unless already done."""
    if acting.sample[0] == sample:
        return
    acting.sample[0] = sample
    acting.payload[0] = load.payload
    acting.sloshing[0] = 0.0
    put(acting.force, load.force)
    put(acting.offset, load.offset)
    put(acting.constant, disturbance.constant)
    put(acting.viscous, disturbance.viscous)
    put(acting.coulomb, disturbance.coulomb)
    add(acting.constant, -1.0, load.torque)
    for e in range(events.begin.size):
        fraction = come(sample, events.begin[e], events.ramp[e])
        fraction -= come(sample, events.end[e], events.ramp[e])
        if fraction != 0.0:
            acting.payload[0] += fraction * events.payload[e]
            acting.sloshing[0] += fraction * events.sloshing[e]
            add(acting.force, fraction, events.force[e])
            add(acting.offset, fraction, events.offset[e])
            add(acting.constant, -fraction, events.torque[e])
            add(acting.viscous, fraction, events.viscous[e])
            add(acting.coulomb, fraction, events.coulomb[e])
    for i in range(acting.viscous.size):
        acting.viscous[i] = max(acting.viscous[i], 0.0)
        acting.coulomb[i] = max(acting.coulomb[i], 0.0)


class Motion(NamedTuple):
    """Everything that determines the acceleration besides state and motor torque."""

    arm: Arm
    disturbance: JointDisturbance
    acting: Acting
    wall: WallSettings
    slosh: SloshSettings
    tip: TipState


@inner
def disturbance_torque(motion: Motion, t: float, q: Array, dq: Array, out: Array) -> None:
    """Write the torque (n,) [N m] of disturbance and friction at time t [s].

    Friction has the sign of the velocity; Coulomb friction is smoothed by tanh, so that the
    fixed-step integrator keeps its order.
    """
    given, acting = motion.disturbance, motion.acting
    for i in range(dq.size):
        angle = given.frequency[i] * t + given.phase[i]
        torque = acting.constant[i] + given.amplitude[i] * sin(angle)
        torque += acting.viscous[i] * dq[i]
        if acting.coulomb[i] != 0.0:
            level = acting.coulomb[i]
            if given.stribeck != 0.0:
                speed = dq[i] / given.stribeck_velocity
                level *= 1.0 + given.stribeck * exp(-speed * speed)
            torque += level * tanh(dq[i] / given.coulomb_velocity[i])
        if given.ripple[i] != 0.0:
            torque += given.ripple[i] * sin(given.ripple_frequency * q[i])
        out[i] = torque


@inner
def subtract_contact_torque(motion: Motion, x: Array, torque: Array) -> None:
    """Subtract the torque J^T f (n,) [N m] of the force at the tip from `torque`, in place."""
    push, wall, slosh, tip = motion.acting.force, motion.wall, motion.slosh, motion.tip
    n, mass = torque.size, motion.acting.sloshing[0]
    is_pushed = push[0] != 0.0 or push[1] != 0.0 or push[2] != 0.0
    if not is_pushed and wall.stiffness == 0.0 and mass == 0.0:
        return
    locate_tip(motion.arm, part(x, 0, (n,)), part(x, n, (n,)), tip)
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


@inner
def disturbing_torque(motion: Motion, t: float, x: Array, out: Array) -> None:
    """Write tau_dist (n,) [N m] at time t [s], contact included; `x` as in `state_derivative`."""
    n = out.size
    disturbance_torque(motion, t, part(x, 0, (n,)), part(x, n, (n,)), out)
    subtract_contact_torque(motion, x, out)


@inner
def state_derivative(motion: Motion, t: float, x: Array, torque: Array, dx: Array) -> None:
    """Write dx/dt of x = [q, dq, y, v] (2n + 6,), of which y and v only while a load sloshes."""
    n, acting = torque.size, motion.acting
    q, dq = part(x, 0, (n,)), part(x, n, (n,))
    velocity, net_torque = part(dx, 0, (n,)), part(dx, n, (n,))
    disturbing_torque(motion, t, x, net_torque)
    for i in range(n):
        velocity[i] = dq[i]
        net_torque[i] = torque[i] - net_torque[i]
    motion.arm.accelerate(acting.payload[0], q, dq, net_torque, net_torque)  # in place
    if acting.sloshing[0] > 0.0:
        for i in range(3):
            dx[2 * n + i] = x[2 * n + 3 + i]
            dx[2 * n + 3 + i] = motion.slosh.gravity[i] - motion.tip.pull[i]


_C = np.array([0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1])
_A = np.array(
    [
        [0, 0, 0, 0, 0, 0],
        [1 / 5, 0, 0, 0, 0, 0],
        [3 / 40, 9 / 40, 0, 0, 0, 0],
        [44 / 45, -56 / 15, 32 / 9, 0, 0, 0],
        [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0, 0],
        [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0],
        [35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84],  # b
    ]
)


class Stages(NamedTuple):
    """Working memory of a step."""

    point: Annotated[Array, '2 * n + 6']
    k: Annotated[Array, '6', '2 * n + 6']


@inner
def combine(x: Array, h: float, stage: int, k: Array, begin: int, end: int, out: Array) -> None:
    """Write entries `begin` to `end` of x + h sum_j a_ij k_j; after the last stage, with b_j."""
    for i in range(begin, end):
        slope = 0.0
        for j in range(stage):
            slope += _A[stage, j] * k[j, i]
        out[i] = x[i] + h * slope


@inner
def integrate(motion: Motion, t: float, h: float, torque: Array, x: Array, stages: Stages) -> None:
    """Advance x = [q, dq, y, v] (2n + 6,) in place from t to t + h [s] under a held torque (n,).

    y and v are advanced only while a load sloshes, and may be absent otherwise.
    """
    point, k, end = stages.point, stages.k, 2 * torque.size
    sloshes = motion.acting.sloshing[0] > 0.0
    for stage in range(_C.size):
        combine(x, h, stage, k, 0, end, point)
        if sloshes:
            combine(x, h, stage, k, end, end + 6, point)
        state_derivative(motion, t + _C[stage] * h, point, torque, k[stage])
    combine(x, h, _C.size, k, 0, end, x)
    if sloshes:
        combine(x, h, _C.size, k, end, end + 6, x)
