# SPDX-License-Identifier: Apache-2.0
"""The arm of a configuration: two point masses, or the arm of a URDF."""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.arms.inertia import inertia_of, pseudo_inertia
from blf_dsc_controller.arms.two_link import PARAMETER_NAMES, urdf
from blf_dsc_controller.arms.urdf import Chain
from blf_dsc_controller.compiled.layout import pack
from blf_dsc_controller.configuration.nodes import PLANT
from blf_dsc_controller.configuration.plant import Deviation, PlantConfig
from blf_dsc_controller.configuration.robot import parameters_of
from sim_plant.arm import Arm
from sim_plant.dynamics import PointMassArm
from sim_plant.rigid_arm import rigid_arm
from sim_plant.rigid_body import rigid_bodies


def arm_of(config: PlantConfig) -> Arm:
    """Return the arm of a configuration."""
    robot = config.robot
    if not robot.urdf:
        return PointMassArm(*vars(config.arm).values())
    chain = robot.chain(config.joints)
    rotors = config.truth.rotor_factor * robot.rotors(chain)
    inertias, parameters = true_inertias(chain, config.truth), parameters_of(robot, chain)
    return rigid_arm(chain, robot.gravity, inertias, rotors, parameters)


def drive_bodies(config: PlantConfig) -> np.ndarray:
    """Return the packed `RigidBodies` by which the drives compensate gravity; empty without."""
    robot = config.robot
    if robot.drive_compensates == 'none':
        return np.zeros(0)
    chain = robot.chain(config.joints)
    inertias = robot.drive_inertias(chain, true_inertias(chain, config.drive))
    return pack(rigid_bodies(chain, robot.gravity, inertias, np.zeros(len(chain.joints))))


def true_inertias(chain: Chain, truth: Deviation) -> np.ndarray:
    """Return the inertias (n, 10) of the URDF with each mass distribution scaled and shifted."""
    moved = np.eye(4)
    inertias = np.empty((len(chain.joints), 10))
    for i, (factor, shift) in enumerate(zip(*truth.changes(len(inertias)), strict=True)):
        moved[:3, 3] = shift
        J = pseudo_inertia(chain.joints[i].inertia)
        inertias[i] = inertia_of(factor * (moved @ J @ moved.T))
    return inertias


def parameter_names_of(config: PlantConfig) -> tuple[str, ...]:
    """Return the names of the true parameters P of a configured arm."""
    robot = config.robot
    if not robot.urdf:
        return PARAMETER_NAMES
    return parameters_of(robot, robot.chain(config.joints)).model.parameter_names


def urdf_of(config: PlantConfig) -> str:
    """Return the URDF of a configured arm."""
    if config.robot.urdf:
        return config.robot.text
    arm, limits = config.arm, config.actuator.torque_limit
    return urdf(PLANT, config.joints, (arm.l1, arm.l2), (arm.m1, arm.m2), limits)
