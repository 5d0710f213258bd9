# SPDX-License-Identifier: Apache-2.0
"""Computed torque and PD with gravity compensation, from a URDF model, in a compiled loop.

    u   = -k_p e - k_d e' - k_i int e,   e = q - qr
    tau = M0 (qr'' + u) + C0 q' + G0 + F0(qr')                               computed torque
    tau = m u + G0 + F0(qr')                                                 PD with gravity

M0, C0, G0 are those of P0, the initial estimate of the law, and m is the inertia of each joint with
the others free.  F0 is the friction known to the controller, at the velocity of the reference as in
the law.  The integrators are held while any torque is saturated.
"""

from __future__ import annotations

from math import tanh
from typing import Annotated, NamedTuple

import numpy as np

from blf_dsc_controller.arms.model import ArmModel
from blf_dsc_controller.compiled.jit import inner, kernel
from blf_dsc_controller.compiled.layout import Array, pack, size_of, view_of
from blf_dsc_controller.compiled.views import part, view
from blf_dsc_controller.configuration.nodes import LoopConfig
from blf_dsc_controller.law.factory import model_of
from blf_dsc_controller.reference import terms as reference
from blf_dsc_controller.reference.approach import plan_start
from sim_plant import kernels as plants
from sim_plant.arm import Arm
from sim_plant.plant import plant_of, steps_of


class Gains(NamedTuple):
    """Gains of a baseline, and its model of the arm."""

    n: int
    p: int
    computed: float  # 1: computed torque, 0: PD with gravity
    position: float  # k_p, 1/s^2
    velocity: float  # k_d, 1/s
    integral: float  # k_i, 1/s^3
    coulomb_velocity: float  # rad/s
    inertia: Annotated[Array, 'n']  # m, kg m^2
    viscous: Annotated[Array, 'n']  # N m s/rad, compensated
    coulomb: Annotated[Array, 'n']  # N m, likewise
    limit: Annotated[Array, 'n']  # N m
    P: Annotated[Array, 'p']  # P0


class Memory(NamedTuple):
    """State of a baseline, and what it computes in a sample."""

    integrated: Annotated[Array, 'n']  # int e, rad s
    measurement: Annotated[Array, '3 * n']  # [q, dq, effort]
    qr: Annotated[Array, 'n']  # rad
    dqr: Annotated[Array, 'n']  # rad/s
    ddqr: Annotated[Array, 'n']  # rad/s^2
    u: Annotated[Array, 'n']  # rad/s^2
    v: Annotated[Array, 'n']  # velocity of the model, rad/s
    a: Annotated[Array, 'n']  # acceleration of the model, rad/s^2
    torque: Annotated[Array, 'n']  # N m
    H: Annotated[Array, 'n', 'p']


gains_of = view_of(Gains)
memory_of, memory_size = view_of(Memory), size_of(Memory)


@inner
def compute_torque(model: ArmModel, gains: Gains, memory: Memory, dt: float) -> None:
    """Write the torque for the measurement and the reference of this sample."""
    n = gains.n
    q, dq = part(memory.measurement, 0, (n,)), part(memory.measurement, n, (n,))
    for i in range(n):
        memory.u[i] = -gains.position * (q[i] - memory.qr[i])
        memory.u[i] -= gains.velocity * (dq[i] - memory.dqr[i])
        memory.u[i] -= gains.integral * memory.integrated[i]
        memory.v[i] = gains.computed * dq[i]
        memory.a[i] = gains.computed * (memory.ddqr[i] + memory.u[i])
    model.regressor(q, memory.v, memory.v, memory.a, memory.H)
    cut = False
    for i in range(n):
        torque = (1.0 - gains.computed) * gains.inertia[i] * memory.u[i]
        torque += gains.viscous[i] * memory.dqr[i]
        torque += gains.coulomb[i] * tanh(memory.dqr[i] / gains.coulomb_velocity)
        for j in range(gains.p):
            torque += memory.H[i, j] * gains.P[j]
        memory.torque[i] = min(max(torque, -gains.limit[i]), gains.limit[i])
        cut = cut or memory.torque[i] != torque
    if not cut:
        for i in range(n):
            memory.integrated[i] += dt * (q[i] - memory.qr[i])


@kernel
def run_baseline(
    arm: Arm,
    plant_settings: np.ndarray,
    plant_state: np.ndarray,
    rng: np.random.Generator,
    model: ArmModel,
    gains_vector: np.ndarray,
    memory_vector: np.ndarray,
    reference_vector: np.ndarray,
    errors: np.ndarray,
    torques: np.ndarray,
) -> None:
    """Run as many samples as `errors` (k, n) [rad] and `torques` (k, n) [N m] have rows.

    The errors are those of the true state, not of the measured one.
    """
    plant, now = plants.plant_views(arm, plant_settings, plant_state)
    gains = gains_of(view(gains_vector))
    memory = memory_of(view(memory_vector), gains)
    dt = plant.period_ns * 1e-9
    for k in range(errors.shape[0]):
        plants.draw_noise(plant, now, rng)
        plants.observe(plant, now, memory.measurement)
        t = (k * plant.period_ns) * 1e-9
        reference.evaluate(view(reference_vector), t, memory.qr, memory.dqr, memory.ddqr)
        compute_torque(model, gains, memory, dt)
        for i in range(gains.n):
            errors[k, i] = now.x[i] - memory.qr[i]
            torques[k, i] = memory.torque[i]
        plants.step(plant, now, memory.torque)


def simulate_baseline(
    loop: LoopConfig,
    inertia: np.ndarray,
    values: dict[str, float],
    *,
    computed: bool,
    friction: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Return errors (k, n) [rad] and torques (k, n) [N m] of a loop that starts as its law does.

    `inertia` (n,) is m, `values` are gains by name; gains that are not given are zero.

    Raises MotionError if there is no approach within the limits.
    """
    config, plant = loop.controller, plant_of(loop.plant)
    n, known = plant.joints, config.robot.friction(config.robot.chain(config.joints))
    gains = Gains(
        n=n,
        p=len(config.learning.initial_estimate),
        computed=float(computed),
        position=values.get('position', 0.0),
        velocity=values.get('velocity', 0.0),
        integral=values.get('integral', 0.0),
        coulomb_velocity=config.learning.coulomb_velocity,
        inertia=inertia,
        viscous=friction * np.array(known['viscous']),
        coulomb=friction * np.array(known['coulomb']),
        limit=np.array(config.torque.limit),
        P=np.array(config.learning.initial_estimate),
    )
    q, dq = np.split(plant.measure()[: 2 * n], 2)
    motion = plan_start(config, np.array(config.barrier.widest), q, dq)
    errors, torques = np.zeros((2, steps_of(loop.plant) + 1, n))
    run_baseline(
        plant.arm,
        plant.settings,
        plant.state,
        plant.rng,
        model_of(config),
        pack(gains),
        np.zeros(memory_size(gains)),
        motion.vector,
        errors,
        torques,
    )
    return errors, torques
