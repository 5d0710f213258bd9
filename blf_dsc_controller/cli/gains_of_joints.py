# SPDX-License-Identifier: Apache-2.0
"""The gains of each joint, and where they come from: given, measured, derived or assumed."""

from __future__ import annotations

from collections.abc import Iterator

from blf_dsc_controller.arms.tuning import defaults_of
from blf_dsc_controller.configuration.controller import (
    ControllerConfig,
    used_design_of,
)


def gains_of_joints(config: ControllerConfig) -> Iterator[str]:
    """Yield a line for each joint of an arm from a URDF whose joints have gains."""
    arm = used_design_of(config)
    if arm.joints is None:
        return
    gains = arm.joints.scaled(arm.stiffness)
    usual = defaults_of(arm)
    bound = _source(is_given=config.barrier.bound != usual['barrier.bound'])
    gamma = _source(is_given=config.disturbance.gain != usual['disturbance.gain'])
    drives = 'given' if config.robot.rotor_inertia else 'assumed, by its rated torque'
    for j, (joint, units) in enumerate(zip(config.joints, config.units, strict=True)):
        yield (
            f'{joint}: {gains.stiffness[j]:.3g} {units.of("N m/rad")} and '
            f'{gains.damping[j]:.3g} {units.of("N m s/rad")}, {_source_of_gains(config)}; '
            f'integral {config.disturbance.gain[j]:.3g} {units.of("N m/rad")}, {gamma}; '
            f'bound {config.barrier.bound[j]:.3g} {units.position}, {bound}; '
            f'drive {arm.rotors[j]:.3g} {units.inertia}, {drives}'
        )


def _source(*, is_given: bool) -> str:
    return 'given' if is_given else 'derived'


def _source_of_gains(config: ControllerConfig) -> str:
    """Return where stiffness and damping come from."""
    if config.feedback.joint_stiffness:
        return 'measured' if config.commissioning.friction else 'given'
    if config.robot.joint_stiffness:
        return 'derived from robot.joint_stiffness'
    return 'assumed, for gears of any stiffness'
