# SPDX-License-Identifier: Apache-2.0
"""Construction of the model, settings and controller of a configuration.

All laws share one kernel; they differ in the surface and in which gains are zero:

    blf_dsc       (28): filtered surface, barrier, composite learning, d^3
    model_based   (16): P^ = P and the disturbance known, no robust term, nothing adapted
    backstepping  (35): linear surface, position gain, leaky adaptation by the tracking error
    slotine_li    tau = H P^ - K_p s, P^' = -Gamma H^T s: (35) without its extra terms,
                  optionally with the integral of s, by (30)
"""

from __future__ import annotations

from copy import deepcopy
from typing import Any, NamedTuple

import numpy as np

from blf_dsc_controller.arms.base_parameters import (
    PAYLOAD_SIZE,
    ROTORS,
    UNKNOWN_ROTOR,
    deviations,
    payload_inertia,
    prior_factor,
)
from blf_dsc_controller.arms.model import ArmModel, arm_model
from blf_dsc_controller.arms.serial_chain import ROTOR
from blf_dsc_controller.arms.tuning import over_postures
from blf_dsc_controller.arms.urdf import inertia_of, moved, pseudo_inertia
from blf_dsc_controller.compiled.algebra import inverse, product
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.robot import drive_model, parameters_of
from blf_dsc_controller.configuration.schema import parameters
from blf_dsc_controller.law import barrier
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.state import CHOICES, LINEAR, Settings
from blf_dsc_controller.reference.approach import plan_start, reference_of

_COLUMNS = 1.0  # Gamma of the disturbance columns
_OMEGA = 100.0  # rad/s, of the filter (8)
_CHECKS = 0.01  # s, between two checks of the excitation
# Of an arm from a URDF, whose many parameters no motion excites all:
_ROWS, _SLOWER_CHECKS = 0.01, 0.05  # s, between rows of the window and between its checks
_PRIOR = 0.01  # 1 / (independent rows in a window): pull to the initial estimate
_SLOW = 0.05  # rad/s, reference velocity below which the rows of a joint count less
_FRICTION = 0.05  # standard deviation of friction, over the rated torque
_MOST_FRICTION = 3.0  # times its initial estimate


def model_of(config: ControllerConfig) -> ArmModel:
    """Return the model named by `model`, with the geometry known to the controller."""
    if config.model == 'urdf':
        robot = config.robot
        base = parameters_of(robot, robot.chain(config.joints))
        return deepcopy(base.model)  # has working memory
    return arm_model(config.model, config.arm.l1, config.arm.gravity)


class Column(NamedTuple):
    """A disturbance column: what is known of its coefficient in theta before the start."""

    name: str
    unit: str
    initial: float  # of a URDF's friction; else zero
    deviation: float  # of the prior
    least: float  # value that it can have
    most: float


def columns_of(config: ControllerConfig) -> tuple[Column, ...]:
    """Return the disturbance columns, in the order of `prediction.fill_columns`.

    The standard deviation is half the initial estimate, or 5 % of the rated torque where that is
    zero, for `viscous` at the largest velocity of the reference.  Friction is between a third of
    its initial estimate and three times that, or between 0 and those 5 %: a push that is learned
    as friction, negative or none, turns over where the joint does.
    """
    learning, joints = config.learning, config.joints
    switched = {'bias': learning.bias, 'viscous': learning.viscous, 'coulomb': learning.coulomb}
    blocks = [name for name, is_on in switched.items() if is_on]
    blocks += [f'{wave} {w:g} rad/s' for w in learning.frequencies for wave in ('sin', 'cos')]
    known = config.robot.friction(config.robot.chain(joints)) if config.model == 'urdf' else {}
    columns = []
    for block in blocks:
        is_viscous, is_friction = block == 'viscous', block in {'viscous', 'coulomb'}
        for i, joint in enumerate(joints):
            initial = known[block][i] if block in known else 0.0
            velocity = config.limits.velocity[i] if is_viscous else 1.0
            usual = _FRICTION * config.torque.limit[i] / velocity
            columns.append(
                Column(
                    name=f'{block} {joint}',
                    unit='N m s/rad' if is_viscous else 'N m',
                    initial=initial,
                    deviation=0.5 * initial or usual,
                    least=initial / _MOST_FRICTION if is_friction else -np.inf,
                    most=(_MOST_FRICTION * initial or usual) if is_friction else np.inf,
                )
            )
    return tuple(columns)


def estimate_names(config: ControllerConfig) -> tuple[str, ...]:
    """Return the name of each entry of theta^: model parameters, then disturbance columns."""
    return (*model_of(config).parameter_names, *(column.name for column in columns_of(config)))


def prior_covariance(config: ControllerConfig) -> np.ndarray:
    """Return the prior covariance (m, m) of theta: identity for planar arms, else of the URDF."""
    columns = columns_of(config)
    if config.model != 'urdf':
        return np.eye(model_of(config).p + len(columns))
    robot, chain = config.robot, config.robot.chain(config.joints)
    rotors = robot.rotors(chain)
    unsure = np.where(rotors > 0.0, ROTORS * rotors, UNKNOWN_ROTOR)
    L = prior_factor(chain, parameters_of(robot, chain), robot.payload, unsure)
    covariance = np.diag([0.0] * len(L) + [column.deviation**2 for column in columns])
    covariance[: len(L), : len(L)] = product(L, L.T)
    return covariance


def settings_of_config(config: ControllerConfig) -> Settings:
    """Return the settings of a configuration, in the paper's symbols.

    A gain that is not computed here is the parameter of the same symbol, or of the same name.
    """
    model = model_of(config)
    learning = config.learning
    p, columns = model.p, columns_of(config)
    m, is_urdf, T = p + len(columns), config.model == 'urdf', config.sample_time
    row_interval = max(1, round(_ROWS / T)) if is_urdf else 1
    truth = config.truth
    per_joint = zip(
        config.barrier.bound, config.barrier.weight, config.barrier.slope_limit, strict=True
    )
    floor = np.array(learning.residual_floor)
    least = float(floor.min())
    covariance = prior_covariance(config)
    drive_chain, drive_inertias = drive_model(config.robot, config.joints)
    computed = {
        'model': model,
        'n': model.n,
        'p': p,
        'm': m,
        'surface': CHOICES['surface'].index('filtered'),
        'effort_is_whole': int(config.robot.effort != 'commanded'),
        'drive': drive_inertias.size,
        'drive_size': drive_chain.size,
        'window': round(learning.window / (T * row_interval)),
        'row_interval': row_interval,
        'interval': max(1, round((_SLOWER_CHECKS if is_urdf else _CHECKS) / T)),
        'tones': len(learning.frequencies),
        'truth_known': int(bool(truth.parameters)),
        'feed_forward': 0,
        # Lambda is a heuristic: its rows contradict each other on any arm.
        'change_detection': int(learning.change_detection and learning.prediction != 'lambda'),
        'learning_start': learning.window + learning.settling_time,
        'residual_floor': model.n * least * least,
        'prior_weight': (_PRIOR if is_urdf else 0.0) * least * least,
        'motion_scale': _SLOW if is_urdf else 0.0,
        'pole': learning.filter_pole,
        'omega': _OMEGA,
        'Wc': 0.0,
        'initial_bound': np.array(config.barrier.widest),
        'knee': np.array([barrier.knee(*joint) for joint in per_joint]),
        'Kp': np.array(config.feedback.gain),
        'mu_bar': np.zeros(model.n),
        'row_weight': least / floor,
        'torque_limit': np.array(config.torque.limit),
        'true_disturbance': np.array(
            (truth.constant, truth.amplitude, truth.frequency, truth.phase)
        ),
        'Gamma': np.array(learning.adaptation_gain + (_COLUMNS,) * len(columns)),
        'initial_estimate': np.array((*learning.initial_estimate, *(c.initial for c in columns))),
        'information': inverse(covariance),
        'variance': np.diag(covariance).copy(),
        **_rotors(config, model.n),
        **_load(config, m),
        'least': np.array([-np.inf] * p + [column.least for column in columns]),
        'most': np.array([np.inf] * p + [column.most for column in columns]),
        'true_parameters': np.array(truth.parameters or (0.0,) * p),
        'drive_chain': drive_chain,
        'drive_inertias': drive_inertias,
    }
    settings = Settings(**(_gains(config) | computed))
    return settings._replace(**_of_law(config, settings))


def _gains(config: ControllerConfig) -> dict[str, Any]:
    """Return the parameters that are settings, under the name of the field."""
    groups = (config.barrier, config.surface, config.feedback, config.disturbance, config.torque)
    found: dict[str, Any] = {}
    for group in (*groups, config.learning):
        for param in parameters(type(group)):
            name = param.symbol if param.symbol in Settings._fields else param.name
            if name in Settings._fields:
                value = getattr(group, param.name)
                if name in CHOICES:
                    value = CHOICES[name].index(value)
                found[name] = np.array(value) if param.is_array else value
    return found


def _rotors(config: ControllerConfig, n: int) -> dict[str, Any]:
    """Return what `apparent_inertia` needs: it measures rotor inertias that are only assumed."""
    settings = {
        'rotors_unsure': 0,
        'lag': config.robot.lag,
        'unsure_rotor': np.zeros(n),
        'joint_inertia': np.ones(n),
        'link_inertia': np.ones(n),
    }
    if config.model != 'urdf' or config.robot.rotor_inertia:
        return settings
    robot, limits = config.robot, (config.limits.position_lower, config.limits.position_upper)
    chain = robot.chain(config.joints)
    rotors = robot.rotors(chain)
    base = parameters_of(robot, chain)
    links, joints = (
        over_postures(chain, base, robot.payload, tuple(P), *limits)[0]
        for P in (base.of(chain.inertias, J) for J in (np.zeros(n), rotors))
    )
    return settings | {
        'rotors_unsure': 1,
        'unsure_rotor': rotors,
        'joint_inertia': joints,
        'link_inertia': links,
    }


def _load(config: ControllerConfig, m: int) -> dict[str, Any]:
    """Return what `weighing` needs: how a load in the tip changes the base parameters."""
    if not config.learning.weighing:
        return {'weighed': 0, 'load_columns': np.zeros((0, 10)), 'load_scale': np.zeros((4, 10))}
    robot = config.robot
    chain = robot.chain(config.joints)
    D = deviations(payload_inertia(max(robot.payload, 1.0)), 1.0, 2.0 * PAYLOAD_SIZE)
    T = chain.tip_placement
    K = parameters_of(robot, chain).K[:, -(ROTOR + 1) : -1]
    columns = np.zeros((m + 1, 10))
    moves = [inertia_of(moved(pseudo_inertia(direction), T)) for direction in D.T]
    columns[: len(K)] = product(K, np.transpose(moves))
    return {'weighed': m + 1, 'load_columns': columns, 'load_scale': D[:4]}


def _of_law(config: ControllerConfig, settings: Settings) -> dict[str, Any]:
    comparison = config.comparison
    nothing = np.zeros(settings.n)
    linear = {
        'surface': LINEAR,
        'K': np.array(comparison.surface_gain),
        'd2': nothing,
        'gamma': nothing,
        'kappa': 0.0,
        'compensation': CHOICES['compensation'].index('state'),
        'bumpless': 0,
        'change_detection': 0,
    }
    laws: dict[str, dict[str, Any]] = {
        'blf_dsc': {},
        'model_based': {
            'initial_estimate': np.concatenate(
                (settings.true_parameters, settings.initial_estimate[settings.p :])
            ),
            'feed_forward': 1,
            'd2': nothing,
            'gamma': nothing,
            'Gamma': np.zeros(settings.m),
        },
        'backstepping': linear
        | {
            'weight': np.array(comparison.position_gain),
            'mu_bar': np.array(comparison.robust_gain),
            'Wc': comparison.leakage,
        },
        'slotine_li': linear
        | {'weight': nothing, 'gamma': np.array(comparison.integral_gain or nothing)},
    }
    return laws[config.law]


def controller_of(config: ControllerConfig) -> Controller:
    """Return the controller of a configuration, compiled and in its initial state."""
    return Controller(settings_of_config(config), reference_of(config))


def begin(
    controller: Controller,
    config: ControllerConfig,
    q: np.ndarray,
    dq: np.ndarray,
    t: float = 0.0,
) -> float:
    """Set the planned reference of the controller; return when [s] the approach ends, or `t`.

    Arguments and errors are those of `plan_start`.
    """
    motion = plan_start(config, controller.bound_at(t), q, dq, t)
    controller.reference_vector = motion.vector
    return motion.settled
