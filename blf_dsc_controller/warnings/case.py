# SPDX-License-Identifier: Apache-2.0
"""What the rules of a start look at: a configuration, and what follows from it."""

from __future__ import annotations

from functools import cached_property, lru_cache

import numpy as np

from blf_dsc_controller.arms.known_gears import GearedArm, Gears
from blf_dsc_controller.arms.linear_loop import Loop
from blf_dsc_controller.arms.tuning import geared_arm
from blf_dsc_controller.configuration.controller import ControllerConfig, design_of
from blf_dsc_controller.configuration.law_traits import OWN, PAPER
from blf_dsc_controller.factory.settings import settings_in_loop
from blf_dsc_controller.law.state import Settings
from blf_dsc_controller.warnings.expected_errors import (
    ExpectedErrors,
    expected_errors,
    guesses_rotors,
    linear_feedback,
)
from blf_dsc_controller.warnings.reference_load import ReferenceLoad, reference_load


class Case:
    """A configuration before a start, or before a change; each part is computed once.

    Attributes:
        in_motors: whether the motors close the feedback themselves.
    """

    def __init__(self, config: ControllerConfig, *, in_motors: bool = False) -> None:
        self.config = config
        self.in_motors = in_motors

    @cached_property
    def settings(self) -> Settings:
        """Settings of the law."""
        return settings_in_loop(self.config)

    @cached_property
    def load(self) -> ReferenceLoad:
        """Torque, inertia and excitation along the reference."""
        return reference_load(self.config, self.settings)

    @property
    def is_linear(self) -> bool:
        """Whether the law and its arm have a linear loop that is known."""
        return self.config.model == 'urdf' and self.config.law in (OWN, PAPER)

    @property
    def is_fixed(self) -> bool:
        """Whether the loop is that, and does not adapt to the drives that the law measures."""
        return self.is_linear and self.config.feedback.inertia == 'none'

    @cached_property
    def errors(self) -> ExpectedErrors | None:
        """The errors to expect, if known."""
        return expected_errors(self.config, self.settings) if self.is_linear else None

    @cached_property
    def arm(self) -> GearedArm:
        """The arm with its gears: rigid ones, if nothing is known of them."""
        arm, gears = design_of(self.config)
        if gears is None:
            viscous = np.array(self.config.robot.friction(arm.chain)['viscous'])
            gears = Gears(None, arm.rotors, viscous, has_torque_loop=False)
            if guesses_rotors(self.config):
                gears = gears._replace(unknown=arm.unknown_rotors)
        return geared_arm(arm, gears)

    @cached_property
    def loops(self) -> list[Loop]:
        """The loops that the arm may have with its law; the first is as stated or guessed."""
        settings = self.settings
        feedback = linear_feedback(settings, self.arm.links, settings.barrier.weight)
        return self.arm.loops(feedback)


@lru_cache(maxsize=4)
def case_of(config: ControllerConfig, *, in_motors: bool = False) -> Case:
    """Return the case of a configuration: the same one if it is looked at again."""
    return Case(config, in_motors=in_motors)
