# SPDX-License-Identifier: Apache-2.0
"""Parameters of the controller that follow from others, by the arm of a URDF."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from blf_dsc_controller.arms import tuning
from blf_dsc_controller.arms.base_parameters import BaseParameters
from blf_dsc_controller.arms.joint_gains import (
    GIVEN,
    JointGains,
    max_integral_fraction,
    unknown_arm,
)
from blf_dsc_controller.arms.known_gears import Gears
from blf_dsc_controller.arms.urdf import Chain
from blf_dsc_controller.configuration import tool_bound
from blf_dsc_controller.configuration.controller_groups import Feedback
from blf_dsc_controller.configuration.law_traits import OWN, PAPER
from blf_dsc_controller.configuration.robot import (
    ArmConfig,
    Robot,
    described,
    given_robot,
    parameters_of,
)
from blf_dsc_controller.configuration.schema import Value


def followed_by(given: Mapping[str, Any]) -> Mapping[str, Value]:
    """Return the gains and limits that follow from given parameters by dotted name."""
    if not given.get('robot.urdf'):
        return {}
    robot, chain = given_robot(given)
    arm = used_design(given, robot, chain, parameters_of(robot, chain))
    usual = tuning.defaults_of(arm)
    if 'barrier.bound' not in given and tool_bound.is_given(given):
        bound = tool_bound.joint_bounds({**usual, **given}, robot, arm)
        if bound is not None:
            usual = {**usual, 'barrier.bound': bound}
    return {
        **described(robot, chain),
        'feedback.stiffness': arm.stiffness,
        **usual,
    }


def used_design(
    given: Mapping[str, Any], robot: Robot, chain: Chain, base: BaseParameters
) -> tuning.Design:
    """Return what the gains follow from: as given, by known gears, or of an unknown arm."""
    arm, gears = stated_design(given, robot, chain, base)
    chosen = _given_gains(given, len(chain.joints)) is not None
    if chosen or gears is None or arm.joints is None:
        return arm
    return arm._replace(joints=tuning.geared_arm(arm, gears).joint_gains())


def stated_design(
    given: Mapping[str, Any], robot: Robot, chain: Chain, base: BaseParameters
) -> tuple[tuning.Design, Gears | None]:
    """Return the design by what is given alone, and the gears, if known.

    Laws of other files have feedback through the inertia matrix.
    """
    motors = robot.rotors(chain)
    gears = _gears(robot, chain, motors)
    is_own = given.get('law', OWN) in (OWN, PAPER)
    usual = 'none' if is_own else 'whole'
    is_whole = given.get('feedback.inertia', usual) != 'none'
    gains = _given_gains(given, len(motors)) or unknown_arm(motors)
    integral_fraction = max_integral_fraction(has_torque_loop=robot.torque_loop)
    arm = tuning.Design(
        chain,
        base,
        robot.efforts(chain),
        motors,
        robot.unknown_rotors(chain),
        robot.unknown_friction(chain),
        robot.payload,
        robot.lag,
        None if is_whole else gains._replace(integral_fraction=integral_fraction),
        given.get('feedback.stiffness', Feedback().stiffness),
        given.get('sample_time', ArmConfig.sample_time),
    )
    return arm, gears


def _gears(robot: Robot, chain: Chain, motors: np.ndarray) -> Gears | None:
    """Return the gears of the arm, if their stiffness is known."""
    stiffness = np.array(robot.joint_stiffness)
    if stiffness.shape != motors.shape or not stiffness.all():
        return None
    viscous = np.array(robot.friction(chain)['viscous'])
    return Gears(stiffness, motors, viscous, robot.torque_loop)


def _given_gains(given: Mapping[str, Any], n: int) -> JointGains | None:
    """Return the given gains of n joints; None: not given, or not valid (`problems`)."""
    stiffness, damping = (
        np.array(given.get(f'feedback.joint_{each}', ())) for each in GIVEN
    )
    gains = stiffness, damping
    is_valid = all(each.shape == (n,) and (each > 0.0).all() for each in gains)
    return JointGains(stiffness, damping) if is_valid else None
