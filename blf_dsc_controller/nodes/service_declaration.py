# SPDX-License-Identifier: Apache-2.0
"""Declares loads by the ROS service of a robot's driver.

The message packages of the drivers are imported when their service is there: a sourced
workspace that runs such a driver has them.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from math import pi
from typing import Any

import numpy as np
from rclpy._rclpy_pybind11 import RCLError
from rclpy.node import Node

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.messages.tip_load import TipLoad
from blf_dsc_controller.supervision.load_declaration import (
    DeclarationError,
    LoadDeclaration,
)

_PATIENCE = 2000  # states, until an answer is no longer waited for
_UR = 'ur_msgs/srv/SetPayload'
_DENSITY = 1000.0  # kg/m^3, of the ball that stands for the shape of a load


class ServiceDeclaration(LoadDeclaration):
    """Declares loads over ROS, while `load.tell_drive` is true.

    A load is in force from the first state after the service has accepted it.

    Attributes:
        to_frame: points of the tip in the frame that the service wants (4, 4).
        client: of the service; None until it is found.
    """

    def __init__(self, node: Node, config: ControllerConfig) -> None:
        super().__init__()
        robot = config.robot
        tip = robot.chain(config.joints).tip_placement
        link = config.load.frame or robot.tip
        frame = replace(robot, tip=link).chain(config.joints).tip_placement
        self._node = node
        self._name = node.resolve_service_name(config.load.service)
        self.to_frame = np.linalg.solve(frame, tip)
        self.client: Any = None
        self._type = ''
        self._answer: Any = None

    def look(self) -> None:
        """Look for the service, rarely: its type says what it needs."""
        if self.client is not None or self.problem:
            return
        types = dict(self._node.get_service_names_and_types()).get(self._name, ())
        if not types:
            return
        package, _, name = types[0].partition('/srv/')
        if types[0] not in _FILLS:
            known = ' and '.join(_FILLS)
            self.give_up(
                f'{self._name} is a {types[0]}, but only {known} can be called'
            )
            return
        try:
            service = getattr(importlib.import_module(f'{package}.srv'), name)
        except ImportError:
            self.give_up(
                f'{self._name} is there, but {package} cannot be imported: source the workspace '
                'that has it'
            )
            return
        self._type = types[0]
        self.client = self._node.create_client(service, self._name)

    @property
    def in_motion(self) -> bool:
        """Whether the drives accept a load while the arm moves: those of a UR do."""
        return self._type == _UR

    def begin(self) -> None:
        """Begin with a new law, which does not count loads declared before."""
        if self.in_force is not None and not self.problem:
            self.give_up(
                f'a load of {self.in_force.mass:.2f} kg is still declared to the drives, from '
                'before the node was configured again: set it back to robot.drive_payload, and '
                'restart the node'
            )

    def can_declare(self) -> bool:
        """Whether the service is there."""
        return self.client is not None and self.client.service_is_ready()

    def declare(self, load: TipLoad) -> None:
        """Ask the service to accept a load.

        Raises:
            DeclarationError: its request has other fields, or cannot be sent.
        """
        centre = (self.to_frame @ np.append(load.centre, 1.0))[:3]
        request = self.client.srv_type.Request()
        try:
            _FILLS[self._type](request, load.mass, centre * (load.mass > 0.0))
        except AttributeError as error:
            raise DeclarationError(
                f'{self._name}: its request has other fields ({error})'
            ) from error
        try:
            self._answer = self.client.call_async(request)
        except RCLError as error:
            raise DeclarationError(
                f'{self._name} cannot be called ({error}): see whether its driver still runs'
            ) from error

    def is_in_force(self, load: TipLoad) -> bool:
        """Whether the service has accepted this load.

        Raises:
            DeclarationError: it has refused the load, has not answered for long, or does not
                say whether it has accepted.
        """
        if not self._answer.done():
            if self.states > _PATIENCE:
                raise DeclarationError(
                    f'{self._name} has not answered for {self.states} states'
                )
            return False
        answer = self._answer.result()
        if not hasattr(answer, 'success'):
            raise DeclarationError(
                f'{self._name}: its answer does not say whether {load.mass:.2f} kg are accepted'
            )
        if not answer.success:
            why = getattr(answer, 'error', '') or 'it does not say why'
            raise DeclarationError(f'{self._name} refused {load.mass:.2f} kg: {why}')
        return True

    def give_up(self, problem: str) -> None:
        """Declare no more loads, and warn once."""
        super().give_up(problem)
        self._node.get_logger().warning(
            f'load.tell_drive: {problem}; no more loads are declared to the drives'
        )


def _ball(mass: float) -> float:
    """Return the moment of inertia [kg m^2] of a ball of water of this mass."""
    radius = float(np.cbrt(0.75 * mass / (pi * _DENSITY)))
    return 0.4 * mass * radius * radius


def _fill_ur(request: Any, mass: float, centre: np.ndarray) -> None:
    request.mass = mass
    at = request.center_of_gravity
    at.x, at.y, at.z = centre.tolist()
    request.ixx = request.iyy = request.izz = _ball(mass)


def _fill_franka(request: Any, mass: float, centre: np.ndarray) -> None:
    request.mass = mass
    request.center_of_mass = centre.tolist()
    request.load_inertia = (_ball(mass) * np.eye(3)).ravel().tolist()


_FILLS: Mapping[str, Callable[[Any, float, np.ndarray], None]] = {
    _UR: _fill_ur,
    'franka_msgs/srv/SetLoad': _fill_franka,
}
