# SPDX-License-Identifier: Apache-2.0
"""Checks that ROS 2 and its middleware are there and new enough."""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import os
import subprocess

from blf_dsc_controller import child
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.extras import install_command

_RCLPY = '7.1.4'  # the first in Jazzy with an EventsExecutor
_DEFAULT = 'rmw_fastrtps_cpp'
_LOAD = 'import rclpy; rclpy.get_rmw_implementation_identifier()'


def require_ros() -> None:
    """Raise BlfDscError if ROS 2 or its middleware is missing or too old."""
    _require_middleware(os.environ.get('RMW_IMPLEMENTATION') or _DEFAULT)
    try:
        importlib.import_module('rclpy')
    except ImportError as error:
        raise BlfDscError(
            f'ROS 2 cannot be imported ({error}): source ROS 2 Jazzy '
            '(source /opt/ros/jazzy/setup.bash), or install it as wheels '
            f'({install_command("ros")})'
        ) from error
    try:
        importlib.import_module('rclpy.experimental').EventsExecutor  # noqa: B018 - is it there?
    except (ImportError, AttributeError) as error:
        raise BlfDscError(
            f'rclpy {_version()} has no EventsExecutor, which the nodes run in: {_RCLPY} or newer '
            'is needed (sudo apt update && sudo apt install ros-jazzy-rclpy)'
        ) from error


def _require_middleware(name: str) -> None:
    """Raise BlfDscError if a chosen middleware cannot be loaded: ROS would end the process."""
    if name == _DEFAULT or importlib.util.find_spec('rclpy') is None:
        return
    load = child.running(_LOAD)
    run = subprocess.run(load, capture_output=True, text=True, check=False)
    if run.returncode:
        reason = (run.stderr.strip().splitlines() or ['no reason given'])[-1]
        raise BlfDscError(
            f'RMW_IMPLEMENTATION={name}: this middleware cannot be loaded ({reason}): install it '
            f'(sudo apt install ros-jazzy-{name.replace("_", "-")}), or unset the variable'
        )


def _version() -> str:
    try:
        return importlib.metadata.version('rclpy')
    except importlib.metadata.PackageNotFoundError:
        return 'as installed'
