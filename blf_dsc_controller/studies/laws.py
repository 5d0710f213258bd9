# SPDX-License-Identifier: Apache-2.0
"""The laws that are compared on arms from URDFs, their tuned gains, and the figures of one run.

Two baselines are simulated here, in a compiled loop of their own:

    u   = -k_p e - k_d e' - k_i int e,   e = q - qr
    tau = M0 (qr'' + u) + C0 q' + G0 + F0(qr')                               computed torque
    tau = m u + G0 + F0(qr')                                                 PD with gravity

M0, C0, G0 are those of P0, the initial estimate of the law, and m is the inertia of each joint with
the others free.  F0 is the friction known to the controller, at the velocity of the reference as in
the law.  The integrators are held while any torque is saturated.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import tanh
from typing import Annotated, NamedTuple

import numpy as np

from blf_dsc_controller.arms.model import ArmModel
from blf_dsc_controller.arms.tuning import over_postures
from blf_dsc_controller.compiled.jit import inner, kernel
from blf_dsc_controller.compiled.layout import Array, pack, part, size_of, view, view_of
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import LoopConfig
from blf_dsc_controller.configuration.robot import parameters_of
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.law.factory import model_of
from blf_dsc_controller.law.state import sample_of
from blf_dsc_controller.reference import terms as reference
from blf_dsc_controller.reference.approach import plan_start
from blf_dsc_controller.simulation.loop import simulate_law
from blf_dsc_controller.simulation.metrics import torque_error
from sim_plant import kernels as plants
from sim_plant.arm import Arm
from sim_plant.plant import plant_of, steps_of

PICK_UP = 15.0  # s
DURATION = 30.0  # s
INTERVALS = {
    'first 3 s': (0.0, 3.0),
    '8 to 15 s': (8.0, PICK_UP),
    'pick-up': (PICK_UP, 17.0),
    'from 20 s': (20.0, DURATION),
}
_BEFORE = PICK_UP - 0.01  # s, when the model is evaluated for the first time
_STIFFEST = 4.0  # least slope limit of the barrier, as a multiple of its weight


class Gain(NamedTuple):
    """One tuned number: its name, its range, and whether it multiplies each joint's inertia m."""

    name: str
    least: float
    most: float
    inertial: bool = False


class Contender(NamedTuple):
    """A law and its tuned gains; without any, all gains follow from the URDF."""

    label: str
    gains: tuple[Gain, ...] = ()
    law: str = 'blf_dsc'  # or one of BASELINES
    learns: bool = True
    friction: bool = True  # compensates the friction that the controller knows


BASELINES = ('computed_torque', 'pd_gravity')

_DAMPING = Gain('feedback.damping_rate', 10.0, 200.0)
_ADAPTATION = Gain('learning.adaptation_gain', 0.01, 30.0)
_FEEDBACK = (
    _DAMPING,
    Gain('surface.gain', 5.0, 300.0),
    Gain('surface.mu', 2.0, 100.0),
    Gain('barrier.weight', 100.0, 1e4, inertial=True),
    Gain('disturbance.gain', 100.0, 3e4, inertial=True),
)
_SLOTINE_LI = (
    _DAMPING,
    Gain('comparison.surface_gain', 5.0, 300.0),
    Gain('comparison.integral_gain', 100.0, 3e4, inertial=True),
    _ADAPTATION,
)
_PD = (Gain('position', 100.0, 3e4), Gain('velocity', 10.0, 200.0))
_PID = (*_PD, Gain('integral', 100.0, 3e6))

CONTENDERS = {
    'proposed': Contender('proposed, gains from the URDF'),
    'no_learning': Contender('the same without learning', learns=False),
    'slotine_li': Contender('Slotine-Li, the same gains', law='slotine_li'),
    'proposed_tuned': Contender('proposed, tuned', (*_FEEDBACK, _ADAPTATION)),
    'no_learning_tuned': Contender('without learning, tuned', _FEEDBACK, learns=False),
    'slotine_li_tuned': Contender('Slotine-Li with integrator, tuned', _SLOTINE_LI, 'slotine_li'),
    'computed_torque': Contender('computed torque', _PD, BASELINES[0], friction=False),
    'computed_torque_i': Contender('+ integrator', _PID, BASELINES[0], friction=False),
    'computed_torque_if': Contender('+ integrator, friction', _PID, BASELINES[0]),
    'pd_gravity': Contender('PD + gravity', _PD, BASELINES[1], friction=False),
    'pd_gravity_i': Contender('+ integrator', _PID, BASELINES[1], friction=False),
    'pd_gravity_if': Contender('+ integrator, friction', _PID, BASELINES[1]),
}


class Figures(NamedTuple):
    """Figures of one run: largest true error of any joint in each of INTERVALS, torque, model."""

    errors: tuple[float, ...]  # rad
    ratio: float  # largest error of the whole run, relative to the bound
    roughness: float  # rms change of the torque from sample to sample, relative to its limit
    model: tuple[float, ...]  # torque error on another motion: before the pick-up, at the end


def law_changes(
    contender: Contender, config: ControllerConfig, values: Mapping[str, float]
) -> dict[str, object]:
    """Return the parameters that turn the configured law into a contender with these gains."""
    changes: dict[str, object] = {'law': contender.law}
    if contender.law == 'slotine_li':  # the slope of the proposed law's surface at zero
        slope = np.array(config.surface.gain) / 2.0 + config.surface.mu
        changes['comparison.surface_gain'] = slope.tolist()
    elif not contender.learns:
        changes |= {
            'learning.weight': 0.0,
            'learning.adaptation_gain': [0.0] * len(config.learning.initial_estimate),
            'learning.excitation_threshold': 1e9,
            'learning.change_detection': False,
        }
    for gain in contender.gains:
        group, _, field = gain.name.partition('.')
        present, value = getattr(getattr(config, group), field), values[gain.name]
        per_entry = joint_inertia(config) if gain.inertial else np.ones(np.size(present))
        each = value * per_entry
        changes[gain.name] = each.tolist() if isinstance(present, tuple) else value
        if gain.name == 'barrier.weight':
            limit = np.maximum(config.barrier.slope_limit, _STIFFEST * each)
            changes['barrier.slope_limit'] = limit.tolist()
    return changes


def joint_inertia(config: ControllerConfig) -> np.ndarray:
    """Return m (n,) [kg m^2] of the gains: the least inertia of a joint with the others free."""
    robot, limits = config.robot, (config.limits.position_lower, config.limits.position_upper)
    chain, P0 = robot.chain(config.joints), config.learning.initial_estimate
    return over_postures(chain, parameters_of(robot, chain), robot.payload, P0, *limits)[0]


def run(name: str, loop: LoopConfig, values: Mapping[str, float], unseen: np.ndarray) -> Figures:
    """Run a contender with `values` of its gains by name.

    `unseen` (k, p) are the rows of H on which the learned model is evaluated.
    """
    contender = CONTENDERS[name]
    with np.errstate(all='ignore'):  # a run that diverges has figures too
        if contender.law in BASELINES:
            errors, torques = simulate_baseline(
                loop,
                joint_inertia(loop.controller),
                dict(values),
                computed=contender.law == BASELINES[0],
                friction=contender.friction,
            )
            model: tuple[float, ...] = ()
        else:
            errors, torques, model = _simulate_law(contender, loop, values, unseen)
        time = np.arange(len(errors)) * loop.plant.sample_time
        peaks = [
            np.abs(errors[(time >= begin) & (time < end)]).max(initial=0.0)
            for begin, end in INTERVALS.values()
        ]
        change = np.diff(torques, axis=0) / loop.controller.torque.limit
        rough = np.sqrt(np.mean(change**2, axis=0)).max()
    ratio = np.abs(errors / loop.controller.barrier.bound).max()
    return Figures(tuple(map(float, peaks)), float(ratio), float(rough), model)


def _simulate_law(
    contender: Contender, loop: LoopConfig, values: Mapping[str, float], unseen: np.ndarray
) -> tuple[np.ndarray, np.ndarray, tuple[float, ...]]:
    config = change(loop.controller, law_changes(contender, loop.controller, values))
    record = simulate_law(config, loop.plant)
    settings = record.controller.settings
    n, p = settings.n, settings.p
    columns = sample_of(np.arange(record.samples.shape[1]), settings)
    errors = record.truths[:, p + n : p + 2 * n] - record.samples[:, columns.qr]
    rows = [round(_BEFORE / config.sample_time), -1]
    estimates = record.samples[rows][:, columns.estimate[:p]]
    model = tuple(
        torque_error(unseen, estimate, P)
        for estimate, P in zip(estimates, record.truths[rows, :p], strict=True)
    )
    return errors, record.samples[:, columns.torque], model


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
