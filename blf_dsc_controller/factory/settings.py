# SPDX-License-Identifier: Apache-2.0
"""Settings of each part of the law, as a configuration asks for them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from blf_dsc_controller.arms.base_parameters import (
    PAYLOAD_SIZE,
    deviations,
    payload_inertia,
)
from blf_dsc_controller.arms.inertia import pseudo_inertia
from blf_dsc_controller.arms.joint_gains import SURFACE
from blf_dsc_controller.compiled.layout import filled
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.robot import (
    UNKNOWN_FRICTION,
    drive_model,
    parameters_of,
)
from blf_dsc_controller.factory.estimate import (
    Column,
    blocks_of,
    columns_of,
    doubting_covariance,
    model_of,
    prior_covariance,
    tip_parameters,
)
from blf_dsc_controller.factory.gains import law_gains
from blf_dsc_controller.factory.inertia import joint_inertia
from blf_dsc_controller.factory.laws import law_of, with_memory
from blf_dsc_controller.law import (
    adaptation,
    barrier,
    columns,
    contact,
    disturbance,
    excitation,
    external_torque,
    feedback,
    friction,
    load_observer,
    motor_friction,
    payload,
    prediction,
    reversals,
    surface,
    torque,
    window,
)
from blf_dsc_controller.law.state import Settings
from blf_dsc_controller.numerics.algebra import inverse

_COLUMNS = 1.0  # Gamma of the disturbance columns
_CHECKS = 0.01  # s, between two checks of the excitation
# Of an arm from a URDF, whose many parameters no motion excites all:
# s, between rows of the window and between its checks
_ROWS, _SLOWER_CHECKS = 0.01, 0.05
_PRIOR = 0.01  # 1 / (independent rows in a window): pull to the initial estimate
# rad/s, of the filters of rows: ten times a usual reference's frequency, far below 1/T
_ROW_POLE, _SLOW_ROW_POLE = 20.0, 10.0
# s for these filters, and that of (8), to settle
_SETTLING, _SLOW_SETTLING = 0.3, 0.5
_REGULARISATION = 1e-5  # rho, which pulls P (about 1) to 0
# pull to the estimate before a change until a new window is full: times the mean square
# of the unmodelled torque; of the two links, whose rows are not scaled
_ANCHOR, _PLANAR_ANCHOR = 15.0, 0.1
# rad/s: a sharper sign change of friction chatters with noise
_REVERSAL, _SLOW_REVERSAL = 0.02, 0.01
_EXTERNAL = 30.0  # rad/s, pole of the external torque: a faster one is noisier
_SURFACE = 0.002  # s, of the surface filter of the two links
_SLOW = 0.05  # rad/s, reference velocity below which the rows of a joint count less
# standard deviation of what friction has more at breakaway, over its initial estimate
_BREAKAWAY = 0.7
# likewise of the share of the torque in a gear that is lost there
_LOAD_FRICTION = 0.15
# and of the change of friction as the arm gets warm, over what is unsure of it at first
_CHANGED_FRICTION = 0.4


def settings_of_config(config: ControllerConfig) -> Settings:
    """Return the settings of a configuration: those of each part of the law.

    A setting that is not computed here is the parameter of the same name.
    """
    model = model_of(config)
    learned = columns_of(config)
    row = _row(config)
    settings = filled(
        Settings,
        config.learning,
        model=model,
        n=model.n,
        p=model.p,
        m=model.p + len(learned),
        memory=0,
        has_barrier=int(law_of(config).has_barrier),
        joint_inertia=_joint_inertia(config),
        friction=None,  # follows from the others
        **_parts_of_feedback(config, model.p, row.lag),
        **_parts_of_learning(config, model.p, learned, row),
    )
    settings = with_memory(config, settings)
    return settings._replace(friction=friction_settings(settings))


settings_in_loop = lru_cache(maxsize=2)(settings_of_config)
"""`settings_of_config`, computed once before and after a change.

It takes some samples of the loop, in whose thread a change is checked and applied. The
arrays are for reading only.
"""


def _parts_of_feedback(config: ControllerConfig, p: int, lag: float) -> dict[str, Any]:
    """Return the settings of what computes a torque by errors, and limits it, by field."""
    return {
        'barrier': _barrier(config),
        'surface': _surface(config, lag),
        'feedback': _feedback(config),
        'disturbance': filled(
            disturbance.Settings,
            config.disturbance,
            leakage=law_gains(config).leakage,
        ),
        'observer': _observer(config, p, lag),
        'torque': _torque(config),
    }


def _parts_of_learning(
    config: ControllerConfig,
    p: int,
    learned: Sequence[Column],
    row: prediction.Settings,
) -> dict[str, Any]:
    """Return theta^ at first, its prior, and the settings of what learns it, by field."""
    initial = (column.initial for column in learned)
    estimate = np.array((*law_gains(config).initial_estimate, *initial))
    covariance = prior_covariance(config)
    sliding = _window(config)
    of = _columns(config, p)
    return {
        'initial_estimate': estimate,
        'prior_mean': estimate.copy(),
        'information': inverse(covariance),
        'row_information': inverse(doubting_covariance(config)),
        'columns': of,
        'row': row,
        'window': sliding,
        'excitation': _excitation(config),
        'adaptation': _adaptation(config, p, learned, covariance),
        'motors': motor_friction.Settings(
            size=columns.first_column(of, columns.COULOMB, len(config.joints)),
            filter_pole=row.filter_pole,
            length=sliding.length,
            period=sliding.row_interval * config.sample_time,
            min_weight=sliding.prior_weight + sliding.regularization,
        ),
        'external': _external(config, sliding),
        'contact': _contact(config),
        'payload': _payload(config, learned, row, sliding),
    }


def _barrier(config: ControllerConfig) -> barrier.Settings:
    """Return the barrier, with the bound at the start, and where its slope is limited."""
    bound, gains = config.barrier.bound, law_gains(config)
    joints = zip(bound, gains.weight, gains.slope_limit, strict=True)
    return barrier.Settings(
        bound=np.array(bound),
        initial_bound=np.array(gains.initial_bound),
        funnel_rate=gains.funnel_rate,
        weight=np.array(gains.weight),
        slope_limit=np.array(gains.slope_limit),
        knee=np.array([barrier.knee(*joint) for joint in joints]),
    )


def _surface(config: ControllerConfig, lag: float) -> surface.Settings:
    """Return the surface; the filter of an arm from a URDF uses the known rate f."""
    is_urdf = config.model == 'urdf'
    fastest = SURFACE if is_urdf else _SURFACE
    gains = law_gains(config)
    return surface.Settings(
        gain=np.array(gains.surface),
        mu=np.array(gains.mu),
        time_constant=max(config.sample_time, fastest),
        known_rate=int(is_urdf),
        lag=lag,
    )


def _feedback(config: ControllerConfig) -> feedback.Settings:
    """Return the feedback of the velocity error, and what of it acts through the inertia."""
    gains = law_gains(config)
    lags = config.feedback.lags(len(config.joints))
    return feedback.Settings(
        gain=np.array(gains.feedback),
        robust_gain=np.array(gains.robust),
        damping_rate=gains.damping_rate,
        follows_inertia=int(_follows_inertia(config)),
        decoupled=int(config.feedback.inertia == 'none'),
        damping_lag=np.array(lags),
        lags=int(any(lags)),
    )


def _follows_inertia(config: ControllerConfig) -> bool:
    """Whether the whole feedback acts through the inertia matrix."""
    return config.model == 'urdf' and config.feedback.inertia == 'whole'


def _observer(config: ControllerConfig, p: int, lag: float) -> load_observer.Settings:
    """Return how the load is observed by joint torque sensors; `lag` [s] is that of the rows."""
    robot = config.robot
    is_on = config.observes_load
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
        unmodelled=np.array(config.learning.residual_floor),
        max_torque=load_observer.max_load_torque(np.array(config.torque.limit)),
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
    blocks = blocks_of(config)
    return columns.Settings(
        first=p,
        blocks=len(blocks),
        coulomb_velocity=_coulomb_velocity(config),
        kinds=np.array([float(block.kind) for block in blocks]),
        rates=np.array([block.rate for block in blocks]),
    )


def _coulomb_velocity(config: ControllerConfig) -> float:
    """Return the velocity scale [rad/s] of the sign change of the Coulomb column."""
    return _REVERSAL if config.model == 'urdf' else _SLOW_REVERSAL


def _row(config: ControllerConfig) -> prediction.Settings:
    """Return how rows are formed; those of all joints are scaled to the least of them."""
    is_urdf = config.model == 'urdf'
    return filled(
        prediction.Settings,
        config.learning,
        filter_pole=_ROW_POLE if is_urdf else _SLOW_ROW_POLE,
        motion_scale=_SLOW if is_urdf else 0.0,
        lag=config.robot.lag if is_urdf else 0.0,
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
        regularization=_REGULARISATION,
    )


def _excitation(config: ControllerConfig) -> excitation.Settings:
    """Return which windows are learned from.

    The first must be full (27), unless its rows are compared with a prior from the start.
    Rows that are not exact contradict each other on any arm, which is not taken for a change.
    With feedback through the inertia matrix it must be, too.
    """
    least = _least_floor(config)
    is_urdf = config.model == 'urdf'
    settling_time = _SETTLING if is_urdf else _SLOW_SETTLING
    is_soft = is_urdf and config.feedback.inertia == 'none'
    has_prior = is_soft and config.has_exact_rows
    return excitation.Settings(
        excitation_threshold=law_gains(config).excitation_threshold,
        learning_start=config.learning.window + settling_time,
        change_detection=int(config.has_exact_rows),
        anchor_weight=_ANCHOR * least**2 if is_urdf else _PLANAR_ANCHOR,
        starts_full=int(not has_prior),
        residual_floor=len(config.joints) * least * least,
    )


def _adaptation(
    config: ControllerConfig,
    p: int,
    learned: Sequence[Column],
    covariance: np.ndarray,
) -> adaptation.Settings:
    """Return the update, and the range of theta: p parameters, then the columns."""
    gains = law_gains(config)
    of_columns = _COLUMNS if config.learning.enabled else 0.0
    return adaptation.Settings(
        weight=gains.learning_weight,
        radius=gains.radius,
        adaptation_gain=np.array(gains.adaptation + (of_columns,) * len(learned)),
        variance=np.diag(covariance).copy(),
        lower=np.array([-np.inf] * p + [column.least for column in learned]),
        upper=np.array([np.inf] * p + [column.most for column in learned]),
    )


def _contact(config: ControllerConfig) -> contact.Settings:
    """Return whether contacts are found, what they do, and what is not a contact."""
    given = config.contact
    return filled(
        contact.Settings,
        given,
        loads=int(given.loads and config.weighs),
        freezes=int(given.reaction != 'none'),
    )


def _external(
    config: ControllerConfig, sliding: window.Settings
) -> external_torque.Settings:
    """Return how the external torque and its interval are found."""
    least = _least_floor(config)
    return filled(
        external_torque.Settings,
        config.contact,
        bandwidth=_EXTERNAL,
        window=sliding.length,
        row_interval=sliding.row_interval,
        coulomb_velocity=_coulomb_velocity(config),
        row_variance=_PRIOR * least * least,
        unmodelled=np.array(config.learning.residual_floor),
    )


def friction_settings(settings: Settings) -> friction.Settings:
    """Return what is known of friction, by all other settings."""
    n = settings.n
    of, adapts = settings.columns, settings.adaptation
    coulomb = columns.first_column(of, columns.COULOMB, n)
    has_coulomb = coulomb < settings.m

    def of_coulomb(values: np.ndarray) -> np.ndarray:
        return values[coulomb : coulomb + n] if has_coulomb else np.zeros(n)

    return friction.Settings(
        coulomb=int(has_coulomb),
        first_coulomb=coulomb,
        coulomb_velocity=of.coulomb_velocity,
        pole=settings.row.filter_pole,
        reversals=reversals.Settings(
            unmodelled=settings.external.unmodelled,
            initial=of_coulomb(settings.initial_estimate),
            variance=of_coulomb(adapts.variance),
            lower=of_coulomb(adapts.lower),
            upper=of_coulomb(adapts.upper),
        ),
        gain=of_coulomb(adapts.adaptation_gain * adapts.weight),
    )


def _joint_inertia(config: ControllerConfig) -> np.ndarray:
    """Return m (n,) [kg m^2] of each joint by the initial estimate; ones of a planar arm."""
    if config.model != 'urdf':
        return np.ones(len(config.joints))
    return joint_inertia(config, law_gains(config).initial_estimate)


def _payload(
    config: ControllerConfig,
    learned: Sequence[Column],
    row: prediction.Settings,
    sliding: window.Settings,
) -> payload.Settings:
    """Return how a load in the tip changes the base parameters, and which rows count."""
    n = len(config.joints)
    settings = payload.Settings(
        size=0,
        inertial=0,
        since=payload.LOAD,
        unknowns=0,
        window=sliding.length,
        row_interval=sliding.row_interval,
        pole=row.filter_pole,
        motion_scale=row.motion_scale,
        unmodelled=_excitation(config).residual_floor / n,
        load_friction=_LOAD_FRICTION**-2.0,
        breakaway=np.zeros(n),
        columns=np.zeros((0, payload.LOAD)),
        scale=np.zeros((4, payload.LOAD)),
    )
    if not config.weighs:
        return settings
    D = deviations(
        payload_inertia(max(config.robot.payload, 1.0)), 1.0, 2.0 * PAYLOAD_SIZE
    )
    loaded = tip_parameters(config, map(pseudo_inertia, D.T))
    p = len(loaded)
    changed = _changed_friction(learned)
    since = payload.LOAD + changed.shape[1]
    columns = np.zeros((p + len(learned) + 2 * n + 1, since))
    columns[:p, : payload.LOAD] = loaded
    columns[p:, payload.LOAD :][: len(learned)] = changed
    scale = np.zeros((4, since))
    scale[:, : payload.LOAD] = D[:4]
    return settings._replace(
        size=len(columns),
        inertial=p,
        since=since,
        unknowns=len(columns) - 1 + since,
        breakaway=_unsure_breakaway(config) ** -2.0,
        columns=columns,
        scale=scale,
    )


def _unsure_breakaway(config: ControllerConfig) -> np.ndarray:
    """Return the standard deviation (n,) [N m] of what friction has more at breakaway."""
    known = np.array(
        config.robot.friction(config.robot.chain(config.joints))['coulomb']
    )
    usual = UNKNOWN_FRICTION * np.array(config.torque.limit)
    return np.asarray(_BREAKAWAY * np.where(known > 0.0, known, usual))


def _changed_friction(learned: Sequence[Column]) -> np.ndarray:
    """Return E, deviations of viscous and Coulomb friction from before to since, a column each."""
    deviations = np.diag([_CHANGED_FRICTION * each.deviation for each in learned])
    return deviations[:, [each.is_friction for each in learned]]
