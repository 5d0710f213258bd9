# SPDX-License-Identifier: Apache-2.0
"""What a law estimates of an arm: names, units, initial values and their covariance."""

from __future__ import annotations

from collections.abc import Iterable
from copy import deepcopy
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from blf_dsc_controller.arms.base_parameters import (
    GUESSED_ROTORS,
    ROTORS,
    UNKNOWN_ROTOR,
    prior_factor,
)
from blf_dsc_controller.arms.inertia import inertia_of, moved
from blf_dsc_controller.arms.model import ArmModel, arm_model, regressors_at
from blf_dsc_controller.arms.serial_chain import ROTOR
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.robot import UNKNOWN_FRICTION, parameters_of
from blf_dsc_controller.configuration.two_link import two_link
from blf_dsc_controller.law import columns
from blf_dsc_controller.numerics.algebra import product
from blf_dsc_controller.run import LearnedArm

_MOST_FRICTION = 3.0  # times its initial estimate
_SHARE, _MOST_SHARE = 0.05, 0.2  # of the torque in a gear: standard deviation, and most
_RIPPLE = 0.01  # standard deviation of a torque ripple, of the rated torque


def model_of(config: ControllerConfig) -> ArmModel:
    """Return the model of the arm, with the geometry known to the controller."""
    if config.model == 'urdf':
        robot = config.robot
        base = parameters_of(robot, robot.chain(config.joints))
        return deepcopy(base.model)  # has working memory
    given = two_link(config)
    return arm_model(given.l1, given.gravity)


class Block(NamedTuple):
    """A block of disturbance columns, one for each joint: see `law.columns`."""

    name: str
    kind: int
    rate: float = 0.0  # of a sine or cosine: rad/s, or periods per turn


class Column(NamedTuple):
    """A disturbance column: what is known of its coefficient in theta before the start."""

    name: str
    unit: str
    initial: float  # of a URDF's friction; else zero
    deviation: float  # of the prior
    least: float  # value that it can have
    most: float
    is_friction: bool


def columns_of(config: ControllerConfig) -> tuple[Column, ...]:
    """Return the disturbance columns, in the order of `blocks_of`.

    The standard deviation is half the initial estimate, or 5 % of the rated torque
    where that is zero, for `viscous` at the largest velocity of the reference.  Ripple
    has 1 %: what is learned faster than it is known costs more than a weak ripple does.
    Friction is between a third of its initial estimate and three times that, or between
    0 and those 5 %: a push that is learned as friction, negative or none, changes
    sign where the joint reverses.
    """
    known: dict[str, Any] = {}
    if config.model == 'urdf':
        known = config.robot.friction(config.robot.chain(config.joints))
    return tuple(
        _column(config, block, i, known[block.name][i] if block.name in known else 0.0)
        for block in blocks_of(config)
        for i in range(len(config.joints))
    )


def blocks_of(config: ControllerConfig) -> tuple[Block, ...]:
    """Return the blocks of disturbance columns: friction of a URDF, or what disturbs two links."""
    if config.model == 'urdf':
        blocks = [
            Block('viscous', columns.VISCOUS),
            Block('coulomb', columns.COULOMB),
        ]
        tones: tuple[float, ...] = ()
    else:
        given = two_link(config)
        blocks = [Block('bias', columns.BIAS)] if given.bias else []
        tones = given.frequencies
    if config.learns_load_friction:
        blocks.append(Block('load_friction', columns.LOAD_FRICTION))
    for w in tones:
        blocks.append(Block(f'sin {w:g} rad/s', columns.SINE, w))
        blocks.append(Block(f'cos {w:g} rad/s', columns.COSINE, w))
    for N in config.learning.ripple_cycles:
        blocks.append(Block(f'sin {N:g} q', columns.RIPPLE_SINE, N))
        blocks.append(Block(f'cos {N:g} q', columns.RIPPLE_COSINE, N))
    return tuple(blocks)


def _column(config: ControllerConfig, block: Block, i: int, initial: float) -> Column:
    """Return the column of a block for joint i, with its initial estimate."""
    name = f'{block.name} {config.joints[i]}'
    if block.kind == columns.LOAD_FRICTION:
        return Column(name, '1', 0.0, _SHARE, 0.0, _MOST_SHARE, is_friction=False)
    is_viscous = block.kind == columns.VISCOUS
    is_friction = block.kind in {columns.VISCOUS, columns.COULOMB}
    is_ripple = block.kind in {columns.RIPPLE_SINE, columns.RIPPLE_COSINE}
    velocity = config.limits.velocity[i] if is_viscous else 1.0
    share = _RIPPLE if is_ripple else UNKNOWN_FRICTION
    usual = share * config.torque.limit[i] / velocity
    return Column(
        name=name,
        unit=config.units[i].of('N m s/rad' if is_viscous else 'N m'),
        initial=initial,
        deviation=0.5 * initial or usual,
        least=initial / _MOST_FRICTION if is_friction else -np.inf,
        most=(_MOST_FRICTION * initial or usual) if is_friction else np.inf,
        is_friction=is_friction,
    )


def estimate_names(config: ControllerConfig) -> tuple[str, ...]:
    """Return the name of each entry of theta^: model parameters, then disturbance columns."""
    return (
        *model_of(config).parameter_names,
        *(column.name for column in columns_of(config)),
    )


def tip_parameters(config: ControllerConfig, loads: Iterable[np.ndarray]) -> np.ndarray:
    """Return by how much each of k loads changes the base parameters (p, k).

    A load is a pseudo-inertia (4, 4) in the frame of the tip.
    """
    robot = config.robot
    chain = robot.chain(config.joints)
    K = parameters_of(robot, chain).K[:, -(ROTOR + 1) : -1]
    moves = [inertia_of(moved(load, chain.tip_placement)) for load in loads]
    return product(K, np.transpose(moves))


def prior_covariance(config: ControllerConfig) -> np.ndarray:
    """Return the prior covariance (m, m) of theta: identity for planar arms, else of the URDF."""
    return _covariance(config, ROTORS)


def doubting_covariance(config: ControllerConfig) -> np.ndarray:
    """Return the same (m, m) where inertias of drives that are a guess are doubted as they must be.

    Rows of an arm with other drives are compared with it.  Learning does not use it: its rate
    follows from its prior, and must not rise with what is not known of drives.
    """
    robot = config.robot
    is_known = config.model != 'urdf' or robot.known_rotors(robot.chain(config.joints))
    return _covariance(config, ROTORS if is_known else GUESSED_ROTORS)


def _covariance(config: ControllerConfig, relative: float) -> np.ndarray:
    """Return a covariance (m, m) of theta, with a `relative` deviation of the drives' inertias."""
    learned = columns_of(config)
    if config.model != 'urdf':
        return np.eye(model_of(config).p + len(learned))
    robot = config.robot
    chain = config.robot.chain(config.joints)
    rotors = robot.rotors(chain)
    unsure = np.where(rotors > 0.0, relative * rotors, UNKNOWN_ROTOR)
    L = prior_factor(chain, parameters_of(robot, chain), robot.payload, unsure)
    covariance = np.diag([0.0] * len(L) + [column.deviation**2 for column in learned])
    covariance[: len(L), : len(L)] = product(L, L.T)
    return covariance


def learned_arm(config: ControllerConfig) -> LearnedArm | None:
    """Return units, prior and regressor of what is learned of a URDF; None for other models."""
    if config.model != 'urdf':
        return None
    model = model_of(config)
    names = estimate_names(config)
    friction = (column.unit for column in columns_of(config))
    deviations = np.sqrt(np.diag(prior_covariance(config))).tolist()
    return LearnedArm(
        dict(zip(names, (*model.parameter_units, *friction), strict=True)),
        dict(zip(names, deviations, strict=True)),
        partial(regressors_at, model),
    )
