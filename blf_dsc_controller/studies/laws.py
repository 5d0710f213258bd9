# SPDX-License-Identifier: Apache-2.0
"""The laws that are compared on arms from URDFs, their tuned gains, and the figures of one run.

Laws of the package are chosen by name. Any other is a `Law`: a named tuple of gains and arrays with
a method that computes the torque, compiled into the closed loop. Two are here:

    u   = -k_p e - k_d e' - k_i int e,   e = q - qr
    tau = M0 (qr'' + u) + C0 q' + G0 + F0(qr')                               computed torque
    tau = m u + G0 + F0(qr')                                                 PD with gravity

M0, C0, G0 are those of P0, the initial estimate of the law, and m is the inertia of each joint with
the others free.  F0 is the friction known to the controller, at the velocity of the reference as in
the law.  The integrators are held while any torque is saturated.  `load_laws` adds those of a file.
"""

from __future__ import annotations

import functools
import importlib
import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from blf_dsc_controller.arms.model import ArmModel
from blf_dsc_controller.arms.tuning import over_postures
from blf_dsc_controller.compiled.elementary import tanh
from blf_dsc_controller.compiled.jit import compile_methods, kernel
from blf_dsc_controller.compiled.layout import Array, part, view
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import LoopConfig
from blf_dsc_controller.configuration.robot import parameters_of
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.law.factory import model_of
from blf_dsc_controller.law.telemetry import sample_columns
from blf_dsc_controller.reference import terms as reference
from blf_dsc_controller.reference.approach import plan_start
from blf_dsc_controller.run import Floats
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.studies.monte_carlo import torque_error
from blf_dsc_controller.studies.tuning import Gain, parameters_at
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


class Known(NamedTuple):
    """What every law is told of an arm of n joints; P0, m and friction are those of its URDF."""

    model: ArmModel
    P: Array  # (p,) P0
    inertia: Array  # (n,) kg m^2, m
    viscous: Array  # (n,) N m s/rad
    coulomb: Array  # (n,) N m
    coulomb_velocity: float  # rad/s
    limit: Array  # (n,) N m
    bound: Array  # (n,) rad, on the error


class Now(NamedTuple):
    """What every law is told in a sample."""

    dt: float  # s
    q: Array  # (n,) rad, measured
    dq: Array  # (n,) rad/s, measured
    qr: Array  # (n,) rad
    dqr: Array  # (n,) rad/s
    ddqr: Array  # (n,) rad/s^2


class Law(Protocol):
    """A law: a `NamedTuple` of its gains (float), its memory and its scratch (arrays)."""

    def fill_torque(self, arm: Known, now: Now, torque: Array) -> None:
        """Write the torque (n,) [N m]; the loop cuts it at its limit afterwards."""


class ModelBased(NamedTuple):
    """Computed torque, or PD with gravity compensation, both with an integrator."""

    computed: float  # 1: computed torque, 0: PD with gravity
    position: float  # k_p, 1/s^2
    velocity: float  # k_d, 1/s
    integral: float  # k_i, 1/s^3
    integrated: Array  # (n,) rad s, int e
    u: Array  # (n,) rad/s^2
    v: Array  # (n,) rad/s, velocity of the model
    a: Array  # (n,) rad/s^2, acceleration of the model
    H: Array  # (n, p)

    def fill_torque(self, arm: Known, now: Now, torque: Array) -> None:
        """Write the torque."""
        n = now.q.size
        for i in range(n):
            self.u[i] = -self.position * (now.q[i] - now.qr[i])
            self.u[i] -= self.velocity * (now.dq[i] - now.dqr[i])
            self.u[i] -= self.integral * self.integrated[i]
            self.v[i] = self.computed * now.dq[i]
            self.a[i] = self.computed * (now.ddqr[i] + self.u[i])
        arm.model.regressor(now.q, self.v, self.v, self.a, self.H)
        cut = False
        for i in range(n):
            torque[i] = (1.0 - self.computed) * arm.inertia[i] * self.u[i]
            torque[i] += arm.viscous[i] * now.dqr[i]
            torque[i] += arm.coulomb[i] * tanh(now.dqr[i] / arm.coulomb_velocity)
            for j in range(arm.P.size):
                torque[i] += self.H[i, j] * arm.P[j]
            cut = cut or abs(torque[i]) > arm.limit[i]
        if not cut:
            for i in range(n):
                self.integrated[i] += now.dt * (now.q[i] - now.qr[i])


def model_based(gains: Mapping[str, float], arm: Known, *, computed: bool) -> ModelBased:
    """Return the law with these gains; those that are not given are zero."""
    n, p = arm.inertia.size, arm.P.size
    k_p, k_d, k_i = (gains.get(name, 0.0) for name in ('position', 'velocity', 'integral'))
    integrated, u, v, a = np.zeros((4, n))
    return ModelBased(float(computed), k_p, k_d, k_i, integrated, u, v, a, np.zeros((n, p)))


computed_torque = partial(model_based, computed=True)
pd_gravity = partial(model_based, computed=False)


def _run(
    arm: Arm,
    plant_settings: np.ndarray,
    plant_state: np.ndarray,
    rng: np.random.Generator,
    law: Law,
    known: Known,
    motion: np.ndarray,
    rows: np.ndarray,
) -> None:
    """Run a sample for each of `rows` (k, 8 n): [q, dq, effort, qr, dqr, ddqr, true q, torque]."""
    plant, state = plants.plant_views(arm, plant_settings, plant_state)
    n, dt = plant.n, plant.period_ns * 1e-9
    every = view(rows)
    for k in range(rows.shape[0]):
        row = every[k]
        q, dq, torque = part(row, 0, (n,)), part(row, n, (n,)), part(row, 7 * n, (n,))
        qr, dqr, ddqr = part(row, 3 * n, (n,)), part(row, 4 * n, (n,)), part(row, 5 * n, (n,))
        plants.draw_noise(plant, state, rng)
        plants.observe(plant, state, part(row, 0, (3 * n,)))
        reference.evaluate(view(motion), (k * plant.period_ns) * 1e-9, qr, dqr, ddqr)
        law.fill_torque(known, Now(dt, q, dq, qr, dqr, ddqr), torque)
        for i in range(n):
            row[6 * n + i] = state.x[i]
            torque[i] = min(max(torque[i], -known.limit[i]), known.limit[i])
        plants.step(plant, state, torque)


@functools.cache
def _loop_with(law: type) -> Callable[..., None]:
    """Return the loop compiled for a type of law, from its cache if its file has not changed."""
    compile_methods(Law, ('fill_torque',), law)
    return kernel(_run)


def known_of(config: ControllerConfig, *, friction: bool) -> Known:
    """Return what a law is told of the arm of a configuration; without `friction` it knows none."""
    robot = config.robot
    on_joints = robot.friction(robot.chain(config.joints))
    return Known(
        model=model_of(config),
        P=np.array(config.learning.initial_estimate),
        inertia=joint_inertia(config),
        viscous=friction * np.array(on_joints['viscous']),
        coulomb=friction * np.array(on_joints['coulomb']),
        coulomb_velocity=config.learning.coulomb_velocity,
        limit=np.array(config.torque.limit),
        bound=np.array(config.barrier.bound),
    )


def simulate_with(
    loop: LoopConfig,
    make: Callable[[Mapping[str, float], Known], Law],
    gains: Mapping[str, float],
    *,
    friction: bool = True,
) -> tuple[np.ndarray, np.ndarray]:
    """Return true errors (k, n) [rad] and torques (k, n) [N m] of `make(gains, known)`.

    The loop starts as that of the package's law does.

    Raises MotionError if there is no approach within the limits.
    """
    config, plant = loop.controller, plant_of(loop.plant)
    n, known = plant.joints, known_of(config, friction=friction)
    q, dq, _ = plant.measure().reshape(3, n)
    motion = plan_start(config, np.array(config.barrier.widest), q, dq)
    rows = np.zeros((steps_of(loop.plant) + 1, 8, n))
    law = make(gains, known)
    run_with = _loop_with(type(law))
    run_with(
        *(plant.arm, plant.settings, plant.state, plant.rng),
        *(law, known, motion.vector, rows.reshape(len(rows), -1)),
    )
    return rows[:, 6] - rows[:, 3], rows[:, 7]


class Contender(NamedTuple):
    """A law and its tuned gains; without any, all gains follow from the URDF."""

    label: str
    gains: tuple[Gain, ...] = ()
    law: str | Callable[[Mapping[str, float], Known], Law] = 'blf_dsc'
    """Law of the package by its name, or a function of the gains by name that makes another."""
    learns: bool = True
    friction: bool = True  # compensates the friction that the controller knows


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
    'computed_torque': Contender('computed torque', _PD, computed_torque, friction=False),
    'computed_torque_i': Contender(
        'computed torque + integrator', _PID, computed_torque, friction=False
    ),
    'computed_torque_if': Contender(
        'computed torque + integrator, friction', _PID, computed_torque
    ),
    'pd_gravity': Contender('PD + gravity', _PD, pd_gravity, friction=False),
    'pd_gravity_i': Contender('PD + gravity + integrator', _PID, pd_gravity, friction=False),
    'pd_gravity_if': Contender('PD + gravity + integrator, friction', _PID, pd_gravity),
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
        without = [0.0] * len(config.learning.initial_estimate)
        changes |= {'learning.weight': 0.0, 'learning.adaptation_gain': without}
    gains = contender.gains
    each = (values[gain.name] for gain in gains)
    changes |= parameters_at(config, gains, each, joint_inertia(config) if gains else 1.0)
    if 'barrier.weight' in changes:
        weight = np.array(changes['barrier.weight'], dtype=float)
        limit = np.maximum(config.barrier.slope_limit, _STIFFEST * weight)
        changes['barrier.slope_limit'] = limit.tolist()
    return changes


def joint_inertia(config: ControllerConfig) -> np.ndarray:
    """Return m (n,) [kg m^2] of the gains: the least inertia of a joint with the others free."""
    robot, limits = config.robot, (config.limits.position_lower, config.limits.position_upper)
    chain, P0 = robot.chain(config.joints), config.learning.initial_estimate
    return over_postures(chain, parameters_of(robot, chain), robot.payload, P0, *limits)[0]


def run(name: str, loop: LoopConfig, values: Mapping[str, float], unseen: Floats) -> Figures:
    """Run a contender with `values` of its gains by name.

    `unseen` (k, p) are the rows of H on which the learned model is evaluated.
    """
    contender, config = CONTENDERS[name], loop.controller
    model: tuple[float, ...] = ()
    with np.errstate(all='ignore'):  # a run that diverges has figures too
        if isinstance(contender.law, str):
            config = change(config, law_changes(contender, config, values))
            record = simulate(config, loop.plant, supervised=False)
            samples = sample_columns(record.samples, record.controller.settings)
            errors, torques, p = record.true_errors(), samples.torque, unseen.shape[1]
            model = tuple(
                torque_error(unseen, samples.estimate[row, :p], record.truths[row, :p])
                for row in (round(_BEFORE / config.sample_time), -1)
            )
        else:
            friction = contender.friction
            errors, torques = simulate_with(loop, contender.law, values, friction=friction)
        time = np.arange(len(errors)) * loop.plant.sample_time
        peaks = [
            float(np.abs(errors[(time >= begin) & (time < end)]).max(initial=0.0))
            for begin, end in INTERVALS.values()
        ]
        steps = np.diff(torques, axis=0) / config.torque.limit
        rough = np.sqrt(np.mean(steps**2, axis=0)).max()
    ratio = np.abs(errors / config.barrier.bound).max()
    return Figures(tuple(peaks), float(ratio), float(rough), model)


def load_laws(path: Path) -> list[str]:
    """Add the contenders of a Python file, by name in its `CONTENDERS`, and return their names.

    Raises BlfDscError if it has none, if it cannot be imported, or if a name is taken.
    """
    sys.path.insert(0, str(path.parent))
    try:
        module = importlib.import_module(path.stem)
    except Exception as error:
        raise BlfDscError(f'{path} cannot be imported: {error!r}') from error
    finally:
        sys.path.remove(str(path.parent))
    if getattr(module, '__file__', '') != str(path):
        raise BlfDscError(f'{path}: there is another module of this name: rename the file')
    added: dict[str, Contender] = getattr(module, 'CONTENDERS', {})
    if not added or not all(isinstance(each, Contender) for each in added.values()):
        raise BlfDscError(f'{path}: CONTENDERS must be a dict of Contender by name')
    for name, contender in added.items():
        if CONTENDERS.setdefault(name, contender) is not contender:
            raise BlfDscError(f'{path}: the study has a law {name} already: choose another name')
    return list(added)
