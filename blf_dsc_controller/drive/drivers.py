# SPDX-License-Identifier: Apache-2.0
"""The driver of a robot: of the simulated arm, of this package, or a Python file."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.drive import DriveConfig
from blf_dsc_controller.configuration.nodes import CONTROLLER, DRIVE, PLANT, load
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import suggestion
from blf_dsc_controller.drive.driver import Driver, check_feedback, disagreements
from blf_dsc_controller.drive.simulated import SIMULATED, simulated
from blf_dsc_controller.errors import BlfDscError, ConfigurationError
from blf_dsc_controller.extras import import_extra
from blf_dsc_controller.nodes.ros_check import require_ros

if TYPE_CHECKING:
    from blf_dsc_controller.drive.ros import RosDriver

FRANKA, DAMIAO = 'franka', 'damiao'  # drivers of this package
ROS = 'ros'
"""The address of a robot behind ROS: its driver publishes joint states and takes torques."""
_BUS = re.compile(r'[a-z]*can\d+$|[a-z_]+:(?!\d+$)')  # can0, vcan1, slcan:/dev/ttyACM0
_HOST = re.compile(r'\d+(\.\d+){3}$')
_SHORTEST = 3  # letters of an address that may mean `simulated`
_LIKE = 0.7  # likeness of such an address


def driver_of(
    address: str,
    path: Path,
    config: ControllerConfig,
    overrides: Mapping[str, Mapping[str, object]] | None = None,
) -> Driver:
    """Return the driver that a file names, for the robot at an address.

    `overrides`, by node and dotted name, take precedence over the file.  The address
    `simulated` is that of its simulated arm, `ros` that of a robot behind ROS.

    Raises BlfDscError if there is no such driver, or the file contradicts the robot.
    """
    given = overrides or {}
    settings = load(path, DRIVE, DriveConfig, given.get(DRIVE))
    if address == SIMULATED:
        plant = load(path, PLANT, PlantConfig, given.get(PLANT))
        made: type[Driver] = simulated(plant, settings.feedback)
    elif address == ROS:
        return _ros()(address, config, settings)
    else:
        if is_nearly_simulated(address):
            raise BlfDscError(
                f'there is no robot {address}, did you mean {SIMULATED}? The host of a robot that '
                'is called so has an address in numbers, too'
            )
        _check_kind(address, path, settings)
        made = find_driver(settings.driver)
    check_feedback(made, settings)
    problems = disagreements(made.facts_for(config), config)
    if problems:
        of_driver = (
            '' if address == SIMULATED else f', for the driver {settings.driver}'
        )
        raise ConfigurationError(problems, f'{path}{of_driver}')
    return made(address, config, settings)


def config_of(
    address: str, path: Path, overrides: Mapping[str, Mapping[str, object]]
) -> ControllerConfig:
    """Return the configuration of a file; behind ROS, the URDF may come from a topic."""
    given = dict(overrides.get(CONTROLLER, {}))
    if address == ROS:
        settings = load(path, DRIVE, DriveConfig, overrides.get(DRIVE))
        given |= _ros().received(path, given, settings)
    return load(path, CONTROLLER, ControllerConfig, given)


def _ros() -> type[RosDriver]:
    """Return the driver `ros`; raises BlfDscError without ROS."""
    require_ros()
    from blf_dsc_controller.drive.ros import RosDriver

    return RosDriver


def _check_kind(address: str, path: Path, settings: DriveConfig) -> None:
    """Raise BlfDscError if a CAN bus is given to the driver of a Franka, or no bus to motors'."""
    if '://' in address:
        alone = address.split('/')[2]
        raise BlfDscError(f'{address} is a web page: give the address alone, {alone}')
    is_bus = _BUS.match(address) is not None
    if is_bus and settings.driver == FRANKA:
        raise BlfDscError(
            f'{address} is a CAN bus, but {path} names no driver of motors: drive.driver is '
            f'{FRANKA}, whose robot has an address in the network. For Damiao motors '
            f'write a file with drive.driver: {DAMIAO}, as doc/motor_arms.md says'
        )
    if _HOST.match(address) and settings.driver == DAMIAO:
        raise BlfDscError(
            f'{address} is an address in the network, but drive.driver in {path} is {DAMIAO}, '
            'whose motors are on a CAN bus: give its channel, such as can0'
        )


def is_in_network(address: str) -> bool:
    """Whether an address is that of a computer, not of a CAN bus or the simulated arm."""
    return address not in (SIMULATED, ROS) and _BUS.match(address) is None


def is_nearly_simulated(address: str) -> bool:
    """Return whether `simulated` was meant, as by sim, simulation or Simulated."""
    word = address.lower()
    is_begin = len(word) >= _SHORTEST and SIMULATED.startswith(word)
    return is_begin or bool(suggestion(word, [SIMULATED], cutoff=_LIKE))


def find_driver(name: str) -> type[Driver]:
    """Return the class of a driver by the parameter `driver`.

    Raises:
        BlfDscError: there is none of this name, or its file defines none.
        MissingExtraError: what it needs is not installed.
    """
    if name.endswith('.py'):
        return _load(Path(name).expanduser())
    if name == FRANKA:
        import_extra('pylibfranka', 'franka', 'the driver franka')
        from blf_dsc_controller.drive.franka import FrankaDriver

        return FrankaDriver
    if name == DAMIAO:
        import_extra('can', 'damiao', 'the driver damiao')
        from blf_dsc_controller.drive.damiao import DamiaoDriver

        return DamiaoDriver
    raise BlfDscError(
        f'drive: driver: got {name!r}, but expected franka, damiao, or a Python file (.py)'
    )


def _load(path: Path) -> type[Driver]:
    """Return `DRIVER` of a Python file."""
    if not path.is_file():
        raise BlfDscError(f'drive: driver: there is no file {path.absolute()}')
    spec = importlib.util.spec_from_file_location(f'driver_{path.stem}', path)
    if spec is None or spec.loader is None:
        raise BlfDscError(f'drive: driver: {path} is not a Python file')
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise BlfDscError(f'{path} cannot be imported: {error!r}') from error
    found = getattr(module, 'DRIVER', None)
    if not (isinstance(found, type) and issubclass(found, Driver)):
        raise BlfDscError(
            f'{path}: expected a class DRIVER, a subclass of '
            'blf_dsc_controller.drive.driver.Driver'
        )
    return found
