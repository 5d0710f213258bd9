# SPDX-License-Identifier: Apache-2.0
"""Construction of the model, law, settings and controller of a configuration.

blf_dsc       (28): filtered surface, barrier, composite learning, d^3     `law.blf_dsc`
model_based   (16): the same with P^ = P and the disturbance known
backstepping  (35): linear surface, adaptation by the tracking error       `law.backstepping`
slotine_li    the same without position gain, robust term and leakage
FILE.py       a law of a user's own                                        its `LAW`
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
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
from blf_dsc_controller.arms.model import (
    ArmModel,
    arm_model,
    free_inertias,
    inertia_matrices,
)
from blf_dsc_controller.arms.serial_chain import ROTOR
from blf_dsc_controller.arms.tuning import over_postures
from blf_dsc_controller.arms.urdf import inertia_of, moved, pseudo_inertia
from blf_dsc_controller.compiled.layout import filled, size_of
from blf_dsc_controller.configuration import law_file
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.robot import drive_model, parameters_of
from blf_dsc_controller.law import (
    apparent_inertia,
    barrier,
    external_torque,
    friction,
    weighing,
)
from blf_dsc_controller.law.backstepping import Backstepping
from blf_dsc_controller.law.blf_dsc import BlfDsc
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.interface import Law
from blf_dsc_controller.law.state import CHOICES, FILTERED, Settings
from blf_dsc_controller.numerics.algebra import inverse, product
from blf_dsc_controller.reference.approach import plan_start, reference_of

_PARAMETER_OF = {
    'bound': 'barrier.bound',
    'funnel_rate': 'barrier.funnel_rate',
    'weight': 'barrier.weight',
    'slope_limit': 'barrier.slope_limit',
    'Kp': 'feedback.gain',
    'K': 'surface.gain',
    'mu': 'surface.mu',
    'time_constant': 'surface.time_constant',
    'known_rate': 'surface.known_rate',
    'damping_rate': 'feedback.damping_rate',
    'd2': 'feedback.damping',
    'gamma': 'disturbance.gain',
    'eta': 'disturbance.leakage',
    'torque_limit': 'torque.limit',
    'rate_limit': 'torque.rate_limit',
    'kappa': 'learning.weight',
    'update': 'learning.update',
    'prediction': 'learning.prediction',
    'rho': 'learning.regularization',
    'sigma': 'learning.excitation_threshold',
    'bias': 'learning.bias',
    'viscous': 'learning.viscous',
    'coulomb': 'learning.coulomb',
    'coulomb_velocity': 'learning.coulomb_velocity',
    'frequencies': 'learning.frequencies',
    'ripple_cycles': 'learning.ripple_cycles',
    'pole': 'learning.filter_pole',
    'radius': 'learning.radius',
    'compensation': 'learning.compensation',
    'bumpless': 'learning.bumpless',
    'anchor_weight': 'learning.anchor_weight',
}
"""Parameters that settings take as they are; the others are computed from several."""

_COLUMNS = 1.0  # Gamma of the disturbance columns
_OMEGA = 100.0  # rad/s, of the filter (8)
_CHECKS = 0.01  # s, between two checks of the excitation
# Of an arm from a URDF, whose many parameters no motion excites all:
# s, between rows of the window and between its checks
_ROWS, _SLOWER_CHECKS = 0.01, 0.05
_PRIOR = 0.01  # 1 / (independent rows in a window): pull to the initial estimate
_SLOW = 0.05  # rad/s, reference velocity below which the rows of a joint count less
_FRICTION = 0.05  # standard deviation of friction, over the rated torque
_MOST_FRICTION = 3.0  # times its initial estimate
_POSTURES = 1000  # random ones of a planar arm


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
    """Return the disturbance columns, in the order of `prediction.fill_columns` and `ripple`.

    The standard deviation is half the initial estimate, or 5 % of the rated torque
    where that is zero, for `viscous` at the largest velocity of the reference.
    Friction is between a third of its initial estimate and three times that, or between
    0 and those 5 %: a push that is learned as friction, negative or none, turns over
    where the joint does.
    """
    known: dict[str, Any] = {}
    if config.model == 'urdf':
        known = config.robot.friction(config.robot.chain(config.joints))
    return tuple(
        _column(config, block, i, known[block][i] if block in known else 0.0)
        for block in _column_blocks(config)
        for i in range(len(config.joints))
    )


def _column_blocks(config: ControllerConfig) -> list[str]:
    """Return the names of the blocks of columns, each with a column per joint."""
    learning = config.learning
    switched = {
        'bias': learning.bias,
        'viscous': learning.viscous,
        'coulomb': learning.coulomb,
    }
    blocks = [name for name, is_on in switched.items() if is_on]
    for w in learning.frequencies:
        blocks += [f'sin {w:g} rad/s', f'cos {w:g} rad/s']
    for cycles in learning.ripple_cycles:
        blocks += [f'sin {cycles:g} q', f'cos {cycles:g} q']
    return blocks


def _column(config: ControllerConfig, block: str, i: int, initial: float) -> Column:
    """Return the column of a block for joint i, with its initial estimate."""
    is_viscous = block == 'viscous'
    is_friction = block in {'viscous', 'coulomb'}
    velocity = config.limits.velocity[i] if is_viscous else 1.0
    usual = _FRICTION * config.torque.limit[i] / velocity
    return Column(
        name=f'{block} {config.joints[i]}',
        unit='N m s/rad' if is_viscous else 'N m',
        initial=initial,
        deviation=0.5 * initial or usual,
        least=initial / _MOST_FRICTION if is_friction else -np.inf,
        most=(_MOST_FRICTION * initial or usual) if is_friction else np.inf,
    )


def estimate_names(config: ControllerConfig) -> tuple[str, ...]:
    """Return the name of each entry of theta^: model parameters, then disturbance columns."""
    return (
        *model_of(config).parameter_names,
        *(column.name for column in columns_of(config)),
    )


def prior_covariance(config: ControllerConfig) -> np.ndarray:
    """Return the prior covariance (m, m) of theta: identity for planar arms, else of the URDF."""
    columns = columns_of(config)
    if config.model != 'urdf':
        return np.eye(model_of(config).p + len(columns))
    robot = config.robot
    chain = config.robot.chain(config.joints)
    rotors = robot.rotors(chain)
    unsure = np.where(rotors > 0.0, ROTORS * rotors, UNKNOWN_ROTOR)
    L = prior_factor(chain, parameters_of(robot, chain), robot.payload, unsure)
    covariance = np.diag([0.0] * len(L) + [column.deviation**2 for column in columns])
    covariance[: len(L), : len(L)] = product(L, L.T)
    return covariance


def settings_of_config(config: ControllerConfig) -> Settings:
    """Return the settings of a configuration, in the paper's symbols.

    A gain that is not computed here is the parameter of the same symbol, or of the same
    name.
    """
    model = model_of(config)
    columns = columns_of(config)
    m = model.p + len(columns)
    window = _window(config)
    residuals = _residuals(config, model.n)
    computed = {
        'model': model,
        'n': model.n,
        'p': model.p,
        'm': m,
        **_of_other_laws(model.n),
        **_barrier(config),
        **window,
        **residuals,
        'contact': _contact(config, residuals, window),
        'friction': None,  # follows from the others
        **_estimates(config, model.p, columns),
        **_known_arm(config, model.p),
        **_inertias(config, model.n),
        'weighing': _weighing(config, m, residuals, window),
        **_drive(config),
    }
    settings = Settings(**(_gains(config) | computed))
    settings = settings._replace(**_of_law(config, settings))
    return settings._replace(friction=friction_settings(settings))


def _gains(config: ControllerConfig) -> dict[str, Any]:
    """Return the settings that are parameters of the configuration."""
    return {name: _setting(config, name, at) for name, at in _PARAMETER_OF.items()}


def _setting(config: ControllerConfig, name: str, parameter: str) -> Any:
    """Return the value of a parameter as kernels take it: choices as their number."""
    group, _, key = parameter.partition('.')
    value = getattr(getattr(config, group), key)
    if name in CHOICES:
        return CHOICES[name].index(value)
    return np.array(value) if isinstance(value, tuple) else value


def _of_other_laws(n: int) -> dict[str, Any]:
    """Return what `blf_dsc` does without: terms of other laws, that are zero."""
    return {'Wc': 0.0, 'memory': 0, 'feed_forward': 0, 'mu_bar': np.zeros(n)}


def _barrier(config: ControllerConfig) -> dict[str, Any]:
    """Return the bound at the start [rad], and where the slope is limited [rad], (n,) each."""
    given = config.barrier
    joints = zip(given.bound, given.weight, given.slope_limit, strict=True)
    return {
        'has_barrier': int(law_of(config).has_barrier),
        'initial_bound': np.array(given.widest),
        'knee': np.array([barrier.knee(*joint) for joint in joints]),
    }


def _window(config: ControllerConfig) -> dict[str, Any]:
    """Return what enters the excitation window, and when it is checked."""
    learning = config.learning
    is_urdf = config.model == 'urdf'
    T = config.sample_time
    row_interval = max(1, round(_ROWS / T)) if is_urdf else 1
    between_checks = _SLOWER_CHECKS if is_urdf else _CHECKS
    is_lambda = learning.prediction == 'lambda'
    return {
        'window': round(learning.window / (T * row_interval)),
        'row_interval': row_interval,
        'interval': max(1, round(between_checks / T)),
        'tones': len(learning.frequencies),
        'ripples': len(learning.ripple_cycles),
        'learning_start': learning.window + learning.settling_time,
        'motion_scale': _SLOW if is_urdf else 0.0,
        'omega': _OMEGA,
        # Lambda is a heuristic: its rows contradict each other on any arm.
        'change_detection': int(learning.change_detection and not is_lambda),
    }


def _residuals(config: ControllerConfig, n: int) -> dict[str, Any]:
    """Return what follows from the rms unmodelled torque [N m] of each joint.

    The rows of all joints are scaled to the least of them.
    """
    floor = np.array(config.learning.residual_floor)
    least = float(floor.min())
    prior = _PRIOR if config.model == 'urdf' else 0.0
    return {
        'row_weight': least / floor,
        'residual_floor': n * least * least,
        'prior_weight': prior * least * least,
        'row_variance': _PRIOR * least * least,
    }


def _contact(
    config: ControllerConfig, residuals: dict[str, Any], window: dict[str, Any]
) -> external_torque.Settings:
    """Return whether contacts are found, what they do, and what is no contact."""
    contact = config.contact
    least = np.sqrt(residuals['residual_floor'] / len(config.joints))
    return filled(
        external_torque.Settings,
        contact,
        loads=int(contact.loads and config.learning.weighing),
        freezes=int(contact.reaction != 'none'),
        window=window['window'],
        row_interval=window['row_interval'],
        coulomb_velocity=config.learning.coulomb_velocity,
        unmodelled=least / residuals['row_weight'],
    )


def friction_settings(settings: Settings) -> friction.Settings:
    """Return what is known of friction, by all other settings."""
    n = settings.n
    viscous = settings.p + n * settings.bias
    coulomb = viscous + n * settings.viscous
    own = slice(coulomb, coulomb + n)

    def of_coulomb(values: np.ndarray) -> np.ndarray:
        return values[own] if settings.coulomb else np.zeros(n)

    return friction.Settings(
        viscous=settings.viscous,
        coulomb=settings.coulomb,
        first_viscous=viscous,
        first_coulomb=coulomb,
        learns=int(settings.coulomb and settings.prediction == FILTERED),
        bumpless=settings.bumpless,
        coulomb_velocity=settings.coulomb_velocity,
        lag=settings.lag,
        pole=settings.pole,
        unmodelled=settings.contact.unmodelled,
        initial=of_coulomb(settings.initial_estimate),
        variance=of_coulomb(settings.variance),
        least=of_coulomb(settings.least),
        most=of_coulomb(settings.most),
        gain=of_coulomb(settings.Gamma * settings.kappa),
    )


def _estimates(
    config: ControllerConfig, p: int, columns: Sequence[Column]
) -> dict[str, Any]:
    """Return what is known of theta before the start: p parameters, then the columns."""
    learning = config.learning
    initial = [column.initial for column in columns]
    gains = learning.adaptation_gain + (_COLUMNS,) * len(columns)
    covariance = prior_covariance(config)
    return {
        'Gamma': np.array(gains),
        'initial_estimate': np.array((*learning.initial_estimate, *initial)),
        'information': inverse(covariance),
        'variance': np.diag(covariance).copy(),
        'least': np.array([-np.inf] * p + [column.least for column in columns]),
        'most': np.array([np.inf] * p + [column.most for column in columns]),
    }


def _known_arm(config: ControllerConfig, p: int) -> dict[str, Any]:
    """Return the truth: p parameters, zero where unknown, and the disturbance."""
    truth = config.truth
    disturbance = (truth.constant, truth.amplitude, truth.frequency, truth.phase)
    return {
        'truth_known': int(bool(truth.parameters)),
        'true_parameters': np.array(truth.parameters or (0.0,) * p),
        'true_disturbance': np.array(disturbance),
    }


def _drive(config: ControllerConfig) -> dict[str, Any]:
    """Return the gravity that the drive adds, and whether measured efforts contain it."""
    chain, inertias = drive_model(config.robot, config.joints)
    return {
        'effort_is_whole': int(config.robot.effort != 'commanded'),
        'drive': inertias.size,
        'drive_size': chain.size,
        'drive_chain': chain,
        'drive_inertias': inertias,
    }


def joint_inertia(config: ControllerConfig, P: tuple[float, ...]) -> np.ndarray:
    """Return m (n,) [kg m^2] of parameters P: least inertia of a joint with the others free."""
    robot = config.robot
    chain = robot.chain(config.joints)
    limits = (config.limits.position_lower, config.limits.position_upper)
    base = parameters_of(robot, chain)
    return over_postures(chain, base, robot.payload, P, *limits).free_inertia


def _inertias(config: ControllerConfig, n: int) -> dict[str, Any]:
    """Return m of each joint, and what `apparent_inertia` needs to measure assumed rotors."""
    is_urdf = config.model == 'urdf'
    follows_inertia = is_urdf and config.feedback.inertia == 'whole'
    P0 = config.learning.initial_estimate
    m = joint_inertia(config, P0) if is_urdf else np.ones(n)
    lag = config.robot.lag if is_urdf else 0.0
    rotors = apparent_inertia.Settings(
        unsure=0, lag=lag, rotor=np.zeros(n), joint=m, link=np.ones(n)
    )
    if follows_inertia and not config.robot.rotor_inertia:
        robot = config.robot
        chain = robot.chain(config.joints)
        links = parameters_of(robot, chain).of(chain.inertias, np.zeros(n))
        rotors = rotors._replace(
            unsure=1,
            rotor=robot.rotors(chain),
            link=joint_inertia(config, tuple(links)),
        )
    return {
        'follows_inertia': int(follows_inertia),
        'decoupled': int(config.feedback.inertia == 'none'),
        'lag': lag,
        'joint_inertia': m,
        'rotors': rotors,
    }


def _weighing(
    config: ControllerConfig, m: int, residuals: dict[str, Any], window: dict[str, Any]
) -> weighing.Settings:
    """Return how a load in the tip changes the base parameters, and which rows count."""
    settings = weighing.Settings(
        size=0,
        window=window['window'],
        row_interval=window['row_interval'],
        pole=config.learning.filter_pole,
        motion_scale=window['motion_scale'],
        unmodelled=residuals['residual_floor'] / len(config.joints),
        columns=np.zeros((0, 10)),
        scale=np.zeros((4, 10)),
    )
    if not config.learning.weighing:
        return settings
    robot = config.robot
    chain = robot.chain(config.joints)
    D = deviations(payload_inertia(max(robot.payload, 1.0)), 1.0, 2.0 * PAYLOAD_SIZE)
    T = chain.tip_placement
    K = parameters_of(robot, chain).K[:, -(ROTOR + 1) : -1]
    columns = np.zeros((m + 1, 10))
    moves = [inertia_of(moved(pseudo_inertia(direction), T)) for direction in D.T]
    columns[: len(K)] = product(K, np.transpose(moves))
    return settings._replace(size=m + 1, columns=columns, scale=D[:4])


def _of_law(config: ControllerConfig, settings: Settings) -> dict[str, Any]:
    """Return the settings of a law that differ from those of `blf_dsc`."""
    of_law = {
        'model_based': _of_model_based,
        'backstepping': _of_backstepping,
        'slotine_li': _of_slotine_li,
    }
    if law_file.is_file(config.law):
        return _of_file(config, settings)
    return of_law[config.law](config, settings) if config.law in of_law else {}


def _of_model_based(_config: ControllerConfig, settings: Settings) -> dict[str, Any]:
    """Return the settings of (16): everything is known, nothing adapts."""
    nothing = np.zeros(settings.n)
    columns = settings.initial_estimate[settings.p :]
    return {
        'initial_estimate': np.concatenate((settings.true_parameters, columns)),
        'feed_forward': 1,
        'd2': nothing,
        'gamma': nothing,
        'Gamma': np.zeros(settings.m),
    }


def _of_linear_surface(config: ControllerConfig, n: int) -> dict[str, Any]:
    """Return what the laws with a linear surface share; they learn if they are told to."""
    nothing = np.zeros(n)
    return {
        'K': np.array(config.comparison.surface_gain),
        'd2': nothing,
        'gamma': nothing,
        'kappa': config.comparison.learning_weight,
        'compensation': CHOICES['compensation'].index('state'),
        'bumpless': 0,
        'change_detection': 0,
    }


def _of_backstepping(config: ControllerConfig, settings: Settings) -> dict[str, Any]:
    """Return the settings of (35)."""
    return _of_linear_surface(config, settings.n) | {
        'weight': np.array(config.comparison.position_gain),
        'mu_bar': np.array(config.comparison.robust_gain),
        'Wc': config.comparison.leakage,
    }


def _of_slotine_li(config: ControllerConfig, settings: Settings) -> dict[str, Any]:
    """Return the settings of Slotine and Li's law: (35) without its extra terms."""
    nothing = np.zeros(settings.n)
    return _of_linear_surface(config, settings.n) | {
        'weight': nothing,
        'gamma': np.array(config.comparison.integral_gain or nothing),
    }


def _of_file(config: ControllerConfig, settings: Settings) -> dict[str, Any]:
    """Return the settings of a law of a file: its memory, and the inertias to scale gains by."""
    memory = law_file.memory_of(law_file.load_law(config.law))
    return {
        'joint_inertia': least_inertias(config),
        'memory': size_of(memory)(settings) if memory else 0,
    }


def least_inertias(config: ControllerConfig) -> np.ndarray:
    """Return the least inertia (n,) [kg m^2] of each joint over the postures, the others free."""
    P0 = config.learning.initial_estimate
    lower = config.limits.position_lower
    upper = config.limits.position_upper
    if config.model == 'urdf':
        chain = config.robot.chain(config.joints)
        base = parameters_of(config.robot, chain)
        payload = config.robot.payload
        return over_postures(chain, base, payload, P0, lower, upper).free_inertia
    rng = np.random.default_rng(0)
    postures = rng.uniform(lower, upper, (_POSTURES, len(lower)))
    inertias = inertia_matrices(model_of(config), np.array(P0), postures)
    return np.asarray(free_inertias(inertias).min(axis=0))


def law_of(config: ControllerConfig) -> Law:
    """Return the law of a configuration, with its own gains."""
    if config.law in ('backstepping', 'slotine_li'):
        return Backstepping()
    if law_file.is_file(config.law):
        gains = getattr(config, law_file.GROUP)
        law: Law = law_file.load_law(config.law)(**dataclasses.asdict(gains))
        return law
    return BlfDsc()


def controller_of(config: ControllerConfig) -> Controller:
    """Return the controller of a configuration, compiled and in its initial state."""
    return Controller(law_of(config), settings_of_config(config), reference_of(config))


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
