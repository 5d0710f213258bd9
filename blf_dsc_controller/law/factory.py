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
    adaptation,
    apparent_inertia,
    barrier,
    columns,
    disturbance,
    excitation,
    external_torque,
    feedback,
    friction,
    load_observer,
    prediction,
    surface,
    torque,
    weighing,
    window,
)
from blf_dsc_controller.law.backstepping import Backstepping
from blf_dsc_controller.law.blf_dsc import BlfDsc
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.interface import Law
from blf_dsc_controller.law.state import STATE, Settings
from blf_dsc_controller.numerics.algebra import inverse, product
from blf_dsc_controller.reference.approach import plan_start, reference_of

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
# standard deviation of what friction has more at breakaway, over its initial estimate
_BREAKAWAY = 0.7
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
    """Return the disturbance columns, in the order of `columns` and `ripple`.

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
    """Return the settings of a configuration: those of each part of the law.

    A setting that is not computed here is the parameter of the same name.
    """
    model = model_of(config)
    learned = columns_of(config)
    m = model.p + len(learned)
    truth = config.truth
    known = (truth.constant, truth.amplitude, truth.frequency, truth.phase)
    covariance = prior_covariance(config)
    initial = (column.initial for column in learned)
    inertia = _joint_inertia(config)
    row = _row(config)
    sliding = _window(config)
    settings = filled(
        Settings,
        config.learning,
        model=model,
        n=model.n,
        p=model.p,
        m=m,
        memory=0,
        has_barrier=int(law_of(config).has_barrier),
        truth_known=int(bool(truth.parameters)),
        feed_forward=0,
        initial_estimate=np.array((*config.learning.initial_estimate, *initial)),
        information=inverse(covariance),
        joint_inertia=inertia,
        robust_gain=np.zeros(model.n),
        true_parameters=np.array(truth.parameters or (0.0,) * model.p),
        true_disturbance=np.array(known),
        barrier=_barrier(config),
        surface=filled(surface.Settings, config.surface, lag=row.lag),
        feedback=_feedback(config),
        disturbance=filled(disturbance.Settings, config.disturbance, config.learning),
        observer=_observer(config, model.p, row.lag, sliding),
        torque=_torque(config),
        columns=_columns(config, model.p),
        row=row,
        window=sliding,
        excitation=_excitation(config),
        adaptation=_adaptation(config, model.p, learned, covariance),
        contact=_contact(config, sliding),
        friction=None,  # follows from the others
        rotors=_rotors(config, row.lag, inertia),
        weighing=_weighing(config, learned, row, sliding),
    )
    settings = _of_law(config, settings)
    return settings._replace(friction=friction_settings(settings))


def _barrier(config: ControllerConfig) -> barrier.Settings:
    """Return the barrier, with the bound at the start, and where its slope is limited."""
    given = config.barrier
    joints = zip(given.bound, given.weight, given.slope_limit, strict=True)
    return filled(
        barrier.Settings,
        given,
        initial_bound=np.array(given.widest),
        knee=np.array([barrier.knee(*joint) for joint in joints]),
    )


def _feedback(config: ControllerConfig) -> feedback.Settings:
    """Return the feedback of the velocity error, and what of it acts through the inertia."""
    return filled(
        feedback.Settings,
        config.feedback,
        follows_inertia=int(_follows_inertia(config)),
        decoupled=int(config.feedback.inertia == 'none'),
    )


def _follows_inertia(config: ControllerConfig) -> bool:
    """Whether the whole feedback acts through the inertia matrix."""
    return config.model == 'urdf' and config.feedback.inertia == 'whole'


def _observer(
    config: ControllerConfig, p: int, lag: float, sliding: window.Settings
) -> load_observer.Settings:
    """Return how the load is observed by joint torque sensors; `lag` [s] is that of the rows."""
    robot = config.robot
    is_on = config.disturbance.observer_bandwidth > 0.0
    rotors = np.zeros(p if is_on else 0)
    if is_on:
        chain = robot.chain(config.joints)
        base = parameters_of(robot, chain)
        rotors += base.of(np.zeros_like(chain.inertias), robot.rotors(chain))
    return filled(
        load_observer.Settings,
        config.disturbance,
        enabled=int(is_on),
        sensor_lag=0.5 * lag,  # the other half is that of the drives
        samples=sliding.length * sliding.row_interval,
        unmodelled=_unmodelled(config),
        most=load_observer.most_load(np.array(config.torque.limit)),
        rotors=rotors,
    )


def _torque(config: ControllerConfig) -> torque.Settings:
    """Return the limits of the torque, and the model of what the drives add."""
    chain, inertias = drive_model(config.robot, config.joints)
    return filled(
        torque.Settings,
        config.torque,
        effort_is_whole=int(config.robot.effort != 'commanded'),
        drive=inertias.size,
        drive_size=chain.size,
        drive_chain=chain,
        drive_inertias=inertias,
    )


def _columns(config: ControllerConfig, p: int) -> columns.Settings:
    """Return which disturbance columns there are."""
    learning = config.learning
    return filled(
        columns.Settings,
        learning,
        first=p,
        tones=len(learning.frequencies),
        ripples=len(learning.ripple_cycles),
    )


def _row(config: ControllerConfig) -> prediction.Settings:
    """Return how rows are formed; those of all joints are scaled to the least of them."""
    is_urdf = config.model == 'urdf'
    return filled(
        prediction.Settings,
        config.learning,
        motion_scale=_SLOW if is_urdf else 0.0,
        lag=config.robot.lag if is_urdf else 0.0,
        omega=_OMEGA,
        row_weight=_least_floor(config) / np.array(config.learning.residual_floor),
    )


def _least_floor(config: ControllerConfig) -> float:
    """Return the least of the joints' rms unmodelled torques [N m]."""
    return min(config.learning.residual_floor)


def _window(config: ControllerConfig) -> window.Settings:
    """Return what enters the excitation window, and when it is checked."""
    is_urdf = config.model == 'urdf'
    T = config.sample_time
    row_interval = max(1, round(_ROWS / T)) if is_urdf else 1
    between_checks = _SLOWER_CHECKS if is_urdf else _CHECKS
    least = _least_floor(config)
    return filled(
        window.Settings,
        config.learning,
        length=round(config.learning.window / (T * row_interval)),
        row_interval=row_interval,
        interval=max(1, round(between_checks / T)),
        prior_weight=(_PRIOR if is_urdf else 0.0) * least * least,
    )


def _excitation(config: ControllerConfig) -> excitation.Settings:
    """Return which windows are learned from."""
    learning = config.learning
    least = _least_floor(config)
    # Lambda is a heuristic: its rows contradict each other on any arm.
    is_lambda = learning.prediction == 'lambda'
    return filled(
        excitation.Settings,
        learning,
        learning_start=learning.window + learning.settling_time,
        change_detection=int(learning.change_detection and not is_lambda),
        residual_floor=len(config.joints) * least * least,
    )


def _adaptation(
    config: ControllerConfig,
    p: int,
    learned: Sequence[Column],
    covariance: np.ndarray,
) -> adaptation.Settings:
    """Return the update, and the range of theta: p parameters, then the columns."""
    learning = config.learning
    gains = learning.adaptation_gain + (_COLUMNS,) * len(learned)
    return filled(
        adaptation.Settings,
        learning,
        leakage=0.0,
        adaptation_gain=np.array(gains),
        variance=np.diag(covariance).copy(),
        least=np.array([-np.inf] * p + [column.least for column in learned]),
        most=np.array([np.inf] * p + [column.most for column in learned]),
    )


def _contact(
    config: ControllerConfig, sliding: window.Settings
) -> external_torque.Settings:
    """Return whether contacts are found, what they do, and what is no contact."""
    contact = config.contact
    least = _least_floor(config)
    return filled(
        external_torque.Settings,
        contact,
        loads=int(contact.loads and config.learning.weighing),
        freezes=int(contact.reaction != 'none'),
        window=sliding.length,
        row_interval=sliding.row_interval,
        coulomb_velocity=config.learning.coulomb_velocity,
        row_variance=_PRIOR * least * least,
        unmodelled=_unmodelled(config),
    )


def _unmodelled(config: ControllerConfig) -> np.ndarray:
    """Return the rms torque (n,) [N m] that no column describes."""
    least = np.sqrt(_excitation(config).residual_floor / len(config.joints))
    return np.asarray(least / _row(config).row_weight)


def friction_settings(settings: Settings) -> friction.Settings:
    """Return what is known of friction, by all other settings."""
    n = settings.n
    of, adapts = settings.columns, settings.adaptation
    viscous = settings.p + n * of.bias
    coulomb = viscous + n * of.viscous
    own = slice(coulomb, coulomb + n)

    def of_coulomb(values: np.ndarray) -> np.ndarray:
        return values[own] if of.coulomb else np.zeros(n)

    is_filtered = settings.row.prediction == prediction.FILTERED
    return friction.Settings(
        viscous=of.viscous,
        coulomb=of.coulomb,
        first_viscous=viscous,
        first_coulomb=coulomb,
        learns=int(of.coulomb and is_filtered),
        bumpless=settings.disturbance.bumpless,
        coulomb_velocity=of.coulomb_velocity,
        lag=settings.row.lag,
        pole=settings.row.filter_pole,
        unmodelled=settings.contact.unmodelled,
        initial=of_coulomb(settings.initial_estimate),
        variance=of_coulomb(adapts.variance),
        least=of_coulomb(adapts.least),
        most=of_coulomb(adapts.most),
        gain=of_coulomb(adapts.adaptation_gain * adapts.weight),
    )


def joint_inertia(config: ControllerConfig, P: tuple[float, ...]) -> np.ndarray:
    """Return m (n,) [kg m^2] of parameters P: least inertia of a joint with the others free."""
    robot = config.robot
    chain = robot.chain(config.joints)
    limits = (config.limits.position_lower, config.limits.position_upper)
    base = parameters_of(robot, chain)
    return over_postures(chain, base, robot.payload, P, *limits).free_inertia


def _joint_inertia(config: ControllerConfig) -> np.ndarray:
    """Return m (n,) [kg m^2] of each joint by the initial estimate; ones of a planar arm."""
    if config.model != 'urdf':
        return np.ones(len(config.joints))
    return joint_inertia(config, config.learning.initial_estimate)


def _rotors(
    config: ControllerConfig, lag: float, inertia: np.ndarray
) -> apparent_inertia.Settings:
    """Return what `apparent_inertia` needs to measure assumed rotors.

    `inertia` (n,) [kg m^2] is m of each joint, `lag` [s] that of `robot.lag`.
    """
    n = len(config.joints)
    rotors = apparent_inertia.Settings(
        unsure=0,
        lag=lag,
        rotor=np.zeros(n),
        joint=inertia,
        link=np.ones(n),
    )
    if not _follows_inertia(config) or config.robot.rotor_inertia:
        return rotors
    robot = config.robot
    chain = robot.chain(config.joints)
    links = parameters_of(robot, chain).of(chain.inertias, np.zeros(n))
    return rotors._replace(
        unsure=1,
        rotor=robot.rotors(chain),
        link=joint_inertia(config, tuple(links)),
    )


def _weighing(
    config: ControllerConfig,
    learned: Sequence[Column],
    row: prediction.Settings,
    sliding: window.Settings,
) -> weighing.Settings:
    """Return how a load in the tip changes the base parameters, and which rows count."""
    n = len(config.joints)
    settings = weighing.Settings(
        size=0,
        window=sliding.length,
        row_interval=sliding.row_interval,
        pole=row.filter_pole,
        motion_scale=row.motion_scale,
        unmodelled=_excitation(config).residual_floor / n,
        breakaway=np.zeros(n),
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
    columns = np.zeros((len(K) + len(learned) + n + 1, 10))
    moves = [inertia_of(moved(pseudo_inertia(direction), T)) for direction in D.T]
    columns[: len(K)] = product(K, np.transpose(moves))
    known = np.array(robot.friction(chain)['coulomb'])
    usual = _FRICTION * np.array(config.torque.limit)
    unsure = _BREAKAWAY * np.where(known > 0.0, known, usual)
    return settings._replace(
        size=len(columns), breakaway=unsure**-2.0, columns=columns, scale=D[:4]
    )


def _of_law(config: ControllerConfig, settings: Settings) -> Settings:
    """Return the settings with what a law does otherwise than `blf_dsc`."""
    of_law = {
        'model_based': _of_model_based,
        'backstepping': _of_backstepping,
        'slotine_li': _of_slotine_li,
    }
    if law_file.is_file(config.law):
        return _of_file(config, settings)
    return of_law[config.law](config, settings) if config.law in of_law else settings


def _of_model_based(_config: ControllerConfig, settings: Settings) -> Settings:
    """Return the settings of (16): everything is known, nothing adapts."""
    nothing = np.zeros(settings.n)
    columns = settings.initial_estimate[settings.p :]
    return settings._replace(
        initial_estimate=np.concatenate((settings.true_parameters, columns)),
        feed_forward=1,
        feedback=settings.feedback._replace(robust_gain=nothing),
        disturbance=settings.disturbance._replace(gain=nothing),
        adaptation=settings.adaptation._replace(adaptation_gain=np.zeros(settings.m)),
    )


def _of_linear_surface(config: ControllerConfig, settings: Settings) -> Settings:
    """Return what the laws with a linear surface share; they learn if they are told to."""
    gains = config.comparison
    nothing = np.zeros(settings.n)
    return settings._replace(
        compensation=STATE,
        surface=settings.surface._replace(gain=np.array(gains.surface_gain)),
        feedback=settings.feedback._replace(robust_gain=nothing),
        disturbance=settings.disturbance._replace(gain=nothing, bumpless=0),
        excitation=settings.excitation._replace(change_detection=0),
        adaptation=settings.adaptation._replace(weight=gains.learning_weight),
    )


def _of_backstepping(config: ControllerConfig, settings: Settings) -> Settings:
    """Return the settings of (35)."""
    gains = config.comparison
    linear = _of_linear_surface(config, settings)
    return linear._replace(
        barrier=linear.barrier._replace(weight=np.array(gains.position_gain)),
        robust_gain=np.array(gains.robust_gain),
        adaptation=linear.adaptation._replace(leakage=gains.leakage),
    )


def _of_slotine_li(config: ControllerConfig, settings: Settings) -> Settings:
    """Return the settings of Slotine and Li's law: (35) without its extra terms."""
    nothing = np.zeros(settings.n)
    integral = np.array(config.comparison.integral_gain or nothing)
    linear = _of_linear_surface(config, settings)
    return linear._replace(
        barrier=linear.barrier._replace(weight=nothing),
        disturbance=linear.disturbance._replace(gain=integral),
    )


def _of_file(config: ControllerConfig, settings: Settings) -> Settings:
    """Return the settings of a law of a file: its memory, and the inertias to scale gains by."""
    memory = law_file.memory_of(law_file.load_law(config.law))
    return settings._replace(
        joint_inertia=least_inertias(config),
        memory=size_of(memory)(settings) if memory else 0,
    )


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
