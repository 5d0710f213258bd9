# SPDX-License-Identifier: Apache-2.0
"""What checks that span several groups read of a controller's configuration."""

from __future__ import annotations

from typing import Protocol

from blf_dsc_controller.configuration.controller_groups import (
    Barrier,
    Safety,
    Torque,
)
from blf_dsc_controller.configuration.motion_groups import MotionLimits
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.run import JointUnits


class Checked(Protocol):
    """Some parameters of a `ControllerConfig`, whose module imports these checks."""

    @property
    def law(self) -> str:
        """Name or file of the control law."""

    @property
    def model(self) -> str:
        """Model of the arm."""

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints, from the base."""

    @property
    def units(self) -> tuple[JointUnits, ...]:
        """Units of each joint."""

    @property
    def insist(self) -> tuple[str, ...]:
        """Parameters whose values are meant although no arm seems to have them."""

    @property
    def robot(self) -> Robot:
        """Group `robot`."""

    @property
    def limits(self) -> MotionLimits:
        """Group `limits`."""

    @property
    def barrier(self) -> Barrier:
        """Group `barrier`."""

    @property
    def torque(self) -> Torque:
        """Group `torque`."""

    @property
    def safety(self) -> Safety:
        """Group `safety`."""
