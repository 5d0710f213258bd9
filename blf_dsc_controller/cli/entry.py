# SPDX-License-Identifier: Apache-2.0
"""Where the executables start: ROS is imported here, so that its absence can be told in words."""

from __future__ import annotations

import importlib
import sys

from blf_dsc_controller.errors import BlfDscError


class NoRosError(BlfDscError):
    """ROS 2 cannot be imported."""

    def __init__(self, reason: ImportError) -> None:
        self.reason = reason
        super().__init__(
            f'ROS 2 cannot be imported ({reason}): source a ROS 2 Jazzy '
            '(source /opt/ros/jazzy/setup.bash), or install it as wheels '
            "(pip install 'blf_dsc_controller[ros]')"
        )


def require_ros() -> None:
    """Raise NoRosError if rclpy cannot be imported."""
    try:
        importlib.import_module('rclpy')
    except ImportError as error:
        raise NoRosError(error) from error


def _run_node(module: str) -> int:
    try:
        require_ros()
    except NoRosError as error:
        print(error, file=sys.stderr)
        return 1
    code: int = importlib.import_module(module).main()
    return code


def sim_plant() -> int:
    """Run the simulated arm."""
    return _run_node('sim_plant.node')


def blf_dsc_controller() -> int:
    """Run the controller."""
    return _run_node('blf_dsc_controller.nodes.controller_node')


def bag_recorder() -> int:
    """Run the recorder."""
    return _run_node('blf_dsc_controller.nodes.recorder_node')


def arm_markers() -> int:
    """Run the node that draws the arm."""
    return _run_node('blf_dsc_controller.nodes.markers_node')
