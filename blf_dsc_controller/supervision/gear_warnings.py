# SPDX-License-Identifier: Apache-2.0
"""Warnings about gains that are too high for the gears, known ones or unknown ones."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from blf_dsc_controller.arms import tuning
from blf_dsc_controller.configuration.controller import ControllerConfig, design_of
from blf_dsc_controller.law.state import Settings
from blf_dsc_controller.supervision.digits import two_digits
from blf_dsc_controller.supervision.expected_errors import linear_feedback

LEAST_MARGIN = 0.2
"""Modulus margin below which gains are warned of."""


def gear_warnings(config: ControllerConfig, settings: Settings) -> Iterator[str]:
    """Check the gains of an arm from a URDF against what is known of its gears."""
    feedback = config.feedback
    robot = config.robot
    if robot.joint_stiffness:
        yield from _of_margin(config, settings)
    elif feedback.inertia == 'none' and not feedback.joint_stiffness:
        damping = settings.feedback.gain
        softest = int(np.argmin(damping))
        joint = config.joints[softest]
        unit = config.units[softest].of('N m s/rad')
        yield (
            'feedback.joint_stiffness: nothing is known of the gears of this arm, so its gains '
            f'only hold it softly, {joint} with a damping of {damping[softest]:.2g} {unit}. '
            'Measure it with `blf_dsc commission`, or give feedback.joint_stiffness and '
            'feedback.joint_damping as the maker of the arm publishes them, or '
            'robot.joint_stiffness'
        )


def _of_margin(config: ControllerConfig, settings: Settings) -> Iterator[str]:
    """Check the modulus margin of the loop with the stated gears."""
    arm, gears = design_of(config)
    if gears is None:
        return
    known = tuning.geared_arm(arm, gears)
    M0 = known.links + np.diag(arm.rotors)
    margin = known.margin(linear_feedback(settings, M0, settings.barrier.weight))
    if margin.value >= LEAST_MARGIN:
        return
    oscillates = 'is unstable' if margin.value == 0.0 else 'rings'
    yield (
        f'feedback.stiffness: with robot.joint_stiffness the loop {oscillates} near '
        f'{two_digits(margin.frequency)} Hz, its modulus margin is {margin.value:.2g}: lower it, '
        'or leave the gains out, so that they follow from robot.joint_stiffness'
    )
