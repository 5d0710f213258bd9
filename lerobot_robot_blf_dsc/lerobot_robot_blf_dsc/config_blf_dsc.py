# SPDX-License-Identifier: Apache-2.0
"""What LeRobot asks for on its command line: `--robot.config`, `--robot.address` and so on."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot.cameras import CameraConfig
from lerobot.robots import RobotConfig


@RobotConfig.register_subclass('blf_dsc')
@dataclass
class BlfDscConfig(RobotConfig):
    """An arm, its parameter file, and cameras.

    Attributes:
        config: parameter file of blf_dsc_controller, or a preset.
        address: of the robot, for the driver that the file names; or `simulated`.
        record: new folder for a bag of all states and torques; empty: none.
    """

    config: str = 'fr3_direct'
    address: str = 'simulated'
    record: str = ''
    cameras: dict[str, CameraConfig] = field(default_factory=dict)
