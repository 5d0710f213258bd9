# SPDX-License-Identifier: Apache-2.0
"""Equation of motion of an arm under a torque, a disturbance, events, and forces at its tip.

Vectors are in the base frame: x to the right, z up.  A force f at the tip loads the
joints with J^T f, where J is the Jacobian of the tip position.  The sloshing load is a
point mass m on a damped spring at the tip. With its position y and velocity v, those of
the tip x and dx, and a = omega^2 (y - x) + 2 zeta omega (v - dx),

    y' = v,   v' = g - a,   force on the tip: m a,

so its motion does not depend on m, which may be ramped.  Loads and events are held over
a sample.

A step is fixed, with the torque held and the disturbance varying: the fifth-order
solution of Dormand and Prince (1980), which MATLAB calls ode5.  Stage i is evaluated at
t + c_i h and x + h sum_j a_ij k_j; the step ends at x + h sum_i b_i k_i.
"""

import numpy as np

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.compiled.views import part
from blf_dsc_controller.numerics.elementary import exp, sin, tanh
from sim_plant.layout import PlantSettings, PlantState


@inner
def ramp_fraction(sample: float, at: float, ramp: float) -> float:
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
    """Copy a vector.

    `target[:] = values` compiles ten functions just for a shape error.
    """
    for i in range(target.size):
        target[i] = values[i]


@inner
def update_loads(plant: PlantSettings, now: PlantState) -> None:
    """Sum load and events of this sample, unless already done."""
    sample = now.sample[0]
    load = plant.load
    events = plant.schedule
    acting = now.acting
    if acting.sample[0] == sample:
        return
    acting.sample[0] = sample
    acting.payload[0] = load.payload
    acting.sloshing[0] = 0.0
    put(acting.force, load.force)
    put(acting.offset, load.offset)
    put(acting.constant, plant.disturbance.constant)
    put(acting.viscous, plant.disturbance.viscous)
    put(acting.coulomb, plant.disturbance.coulomb)
    add(acting.constant, -1.0, load.torque)
    for e in range(plant.events):
        fraction = ramp_fraction(sample, events.begin[e], events.ramp[e])
        fraction -= ramp_fraction(sample, events.end[e], events.ramp[e])
        if fraction != 0.0:
            acting.payload[0] += fraction * events.payload[e]
            acting.sloshing[0] += fraction * events.sloshing[e]
            add(acting.force, fraction, events.force[e])
            add(acting.offset, fraction, events.offset[e])
            add(acting.constant, -fraction, events.torque[e])
            add(acting.viscous, fraction, events.viscous[e])
            add(acting.coulomb, fraction, events.coulomb[e])
    for i in range(plant.n):
        acting.viscous[i] = max(acting.viscous[i], 0.0)
        acting.coulomb[i] = max(acting.coulomb[i], 0.0)
    warm_up(plant, now)
    attach_load(plant, now)


@inner
def warm_up(plant: PlantSettings, now: PlantState) -> None:
    """Scale friction by that of the present temperature."""
    given, acting = plant.disturbance, now.acting
    if given.warm_factor == 1.0:
        return
    cold = exp(-now.sample[0] / given.warm_samples)
    factor = given.warm_factor + (1.0 - given.warm_factor) * cold
    for i in range(plant.n):
        acting.viscous[i] *= factor
        acting.coulomb[i] *= factor


@inner
def locate_tip(plant: PlantSettings, now: PlantState, q: Array, dq: Array) -> None:
    """Write position, velocity and Jacobian of the tip at q and dq (n,), those of a base first."""
    memory = now.memory
    plant.arm.fill_tip(q, memory.tip, memory.jacobian)
    for i in range(3):
        memory.tip_velocity[i] = 0.0
        for j in range(q.size):
            memory.tip_velocity[i] += memory.jacobian[i, j] * dq[j]


@inner
def attach_load(plant: PlantSettings, now: PlantState) -> None:
    """Place a sloshing load that begins at the tip, moving with it."""
    n, sloshes = plant.n, now.acting.sloshing[0] > 0.0
    if sloshes and now.sloshes[0] == 0.0:
        if plant.springs > 0:
            locate_tip(plant, now, now.elastic.q, now.elastic.dq)
        else:
            locate_tip(plant, now, part(now.x, 0, (n,)), part(now.x, n, (n,)))
        for i in range(3):
            now.x[2 * n + i] = now.memory.tip[i]
            now.x[2 * n + 3 + i] = now.memory.tip_velocity[i]
    now.sloshes[0] = 1.0 if sloshes else 0.0


@inner
def dry_friction(
    plant: PlantSettings, now: PlantState, i: int, dq: float, load: float
) -> float:
    """Return Coulomb and Stribeck friction [N m] of a joint, with a load [N m] on its gear.

    The motor drives the load where this has the sign of the velocity.
    """
    given = plant.disturbance
    driven = given.load_asymmetry * (load if dq > 0.0 else -load)
    level = now.acting.coulomb[i] + given.load_share * (abs(load) + driven)
    if level == 0.0:
        return 0.0
    if given.stribeck != 0.0:
        speed = dq / given.stribeck_velocity
        level *= 1.0 + given.stribeck * exp(-speed * speed)
    return float(level * tanh(dq / given.coulomb_velocity))


@inner
def disturbing_torque(
    plant: PlantSettings, now: PlantState, t: float, x: Array, out: Array
) -> None:
    """Write tau_dist (n,) [N m] at time t [s]; `x` as in `state_derivative`.

    Friction has the sign of the velocity; Coulomb friction is smoothed by tanh, so that
    the fixed-step integrator keeps its order.
    """
    n = plant.n
    given = plant.disturbance
    acting = now.acting
    for i in range(n):
        q, dq = x[i], x[n + i]
        angle = given.frequency[i] * t + given.phase[i]
        torque = acting.constant[i] + given.amplitude[i] * sin(angle)
        torque += acting.viscous[i] * dq
        torque += dry_friction(plant, now, i, dq, now.drives.whole[i])
        if given.ripple[i] != 0.0:
            torque += given.ripple[i] * sin(given.ripple_frequency * q)
        out[i] = torque
    q, dq = part(x, 0, (n,)), part(x, n, (n,))
    subtract_tip_torque(plant, now, q, dq, x, out)


@inner
def subtract_tip_torque(
    plant: PlantSettings,
    now: PlantState,
    q: Array,
    dq: Array,
    x: Array,
    torque: Array,
) -> None:
    """Subtract the torque J^T f (n,) [N m] of the force at the tip from `torque`, in place.

    q and dq begin with those of a base; y and v of a sloshing load are in x.
    """
    at = 2 * plant.n
    push = now.acting.force
    load = plant.load
    memory = now.memory
    mass = now.acting.sloshing[0]
    if push[0] == 0.0 and push[1] == 0.0 and push[2] == 0.0 and mass == 0.0:
        return
    locate_tip(plant, now, q, dq)
    for i in range(3):
        force = push[i]
        if mass > 0.0:
            memory.pull[i] = load.stiffness * (x[at + i] - memory.tip[i])
            memory.pull[i] += load.damping * (x[at + 3 + i] - memory.tip_velocity[i])
            force += mass * memory.pull[i]
        for j in range(torque.size):
            torque[j] -= memory.jacobian[i, j] * force


@inner
def state_derivative(
    plant: PlantSettings, now: PlantState, t: float, x: Array, torque: Array, dx: Array
) -> None:
    """Write dx/dt of x = [q, dq, y, v] (2n + 6,), of which y and v only while a load sloshes."""
    n, acting = plant.n, now.acting
    net_torque = part(dx, n, (n,))
    disturbing_torque(plant, now, t, x, net_torque)
    for i in range(n):
        dx[i] = x[n + i]
        net_torque[i] = torque[i] - net_torque[i]
    q, dq = part(x, 0, (n,)), part(x, n, (n,))
    plant.arm.accelerate(acting.payload[0], q, dq, net_torque, net_torque)  # in place
    if acting.sloshing[0] > 0.0:
        for i in range(3):
            dx[2 * n + i] = x[2 * n + 3 + i]
            dx[2 * n + 3 + i] = plant.load.gravity[i] - now.memory.pull[i]


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


@inner
def combine(
    x: Array, h: float, stage: int, k: Array, begin: int, end: int, out: Array
) -> None:
    """Write entries `begin` to `end` of x + h sum_j a_ij k_j.

    After the last stage, with b_j.
    """
    for i in range(begin, end):
        slope = 0.0
        for j in range(stage):
            slope += _A[stage, j] * k[j, i]
        out[i] = x[i] + h * slope


@inner
def integrate(
    plant: PlantSettings, now: PlantState, t: float, h: float, torque: Array
) -> None:
    """Advance x in place from t to t + h [s] under a held torque (n,) [N m].

    y and v are advanced only while a load sloshes.
    """
    x = now.x
    point = now.memory.point
    k = now.memory.k
    end = 2 * plant.n
    sloshes = now.acting.sloshing[0] > 0.0
    for stage in range(_C.size):
        combine(x, h, stage, k, 0, end, point)
        if sloshes:
            combine(x, h, stage, k, end, end + 6, point)
        state_derivative(plant, now, t + _C[stage] * h, point, torque, k[stage])
    combine(x, h, _C.size, k, 0, end, x)
    if sloshes:
        combine(x, h, _C.size, k, end, end + 6, x)
