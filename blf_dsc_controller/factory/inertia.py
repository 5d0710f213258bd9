# SPDX-License-Identifier: Apache-2.0
"""Inertias of the joints of a configured arm, by which gains are scaled."""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.arms.model import free_inertias, inertia_matrices
from blf_dsc_controller.arms.tuning import over_postures
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.robot import parameters_of
from blf_dsc_controller.factory.estimate import model_of
from blf_dsc_controller.factory.gains import law_gains

_POSTURES = 1000  # random ones of a planar arm


def joint_inertia(config: ControllerConfig, P: tuple[float, ...]) -> np.ndarray:
    """Return m (n,) [kg m^2] of parameters P: least inertia of a joint with the others free."""
    robot = config.robot
    chain = robot.chain(config.joints)
    limits = (config.limits.position_lower, config.limits.position_upper)
    base = parameters_of(robot, chain)
    return over_postures(chain, base, robot.payload, P, *limits).free_inertia


def least_inertias(config: ControllerConfig) -> np.ndarray:
    """Return the least inertia (n,) [kg m^2] of each joint over the postures, the others free."""
    P0 = law_gains(config).initial_estimate
    if config.model == 'urdf':
        return joint_inertia(config, P0)
    lower = config.limits.position_lower
    upper = config.limits.position_upper
    rng = np.random.default_rng(0)
    postures = rng.uniform(lower, upper, (_POSTURES, len(lower)))
    inertias = inertia_matrices(model_of(config), np.array(P0), postures)
    return np.asarray(free_inertias(inertias).min(axis=0))
