# SPDX-License-Identifier: Apache-2.0
"""An arm under blf_dsc_controller as a robot of LeRobot: type `blf_dsc`."""

from lerobot_robot_blf_dsc.blf_dsc import BlfDsc
from lerobot_robot_blf_dsc.config_blf_dsc import BlfDscConfig

__all__ = ['BlfDsc', 'BlfDscConfig']
