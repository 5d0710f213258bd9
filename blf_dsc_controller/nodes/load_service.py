# SPDX-License-Identifier: Apache-2.0
"""Declares the weighed load to a driver's service, step by step.

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
from rclpy.node import Node

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.supervision.drive_load import EVERY, DriveLoad
from blf_dsc_controller.supervision.guard import Guard

_PATIENCE = 2000  # states, until an answer is no longer waited for
_DENSITY = 1000.0  # kg/m^3, of the ball that stands for the shape of a load


class LoadService:
    """Declares loads to the drives over ROS, while `load.tell_drive` is true.

    The law takes a step over with the first state after the service has accepted it.

    Attributes:
        problem: why no more loads are declared, or empty.
        told: the load that they have accepted last; None: none.
        to_frame: points of the tip in the frame that the service wants (4, 4).
        client: of the service; None until it is found.
    """

    def __init__(self, node: Node, config: ControllerConfig) -> None:
        robot = config.robot
        tip = robot.chain(config.joints).tip_placement
        link = config.load.frame or robot.tip
        frame = replace(robot, tip=link).chain(config.joints).tip_placement
        self.problem = ''
        self.told: DriveLoad | None = None
        self._node = node
        self._name = node.resolve_service_name(config.load.service)
        self.to_frame = np.linalg.solve(frame, tip)
        self.client: Any = None
        self._type = ''
        self._asked: DriveLoad | None = None
        self._answer: Any = None
        self._states = 0

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
            self._give_up(
                f'{self._name} is a {types[0]}, but only {known} can be called'
            )
            return
        try:
            service = getattr(importlib.import_module(f'{package}.srv'), name)
        except ImportError:
            self._give_up(
                f'{self._name} is there, but {package} cannot be imported: source the workspace '
                'that has it'
            )
            return
        self._type = types[0]
        self.client = self._node.create_client(service, self._name)

    def begin(self) -> None:
        """Begin with a new law, which does not count loads declared before."""
        if self.told is not None and not self.problem:
            self._give_up(
                f'a load of {self.told.mass:.2f} kg is still declared to the drives, from before '
                'the node was configured again: set it back to robot.drive_payload, and restart '
                'the node'
            )

    def follow(self, guard: Guard, config: ControllerConfig) -> None:
        """Take over what was accepted since the last state; ask for the next step."""
        if self.client is None or self.problem:
            return
        self._states += 1
        if self._asked is not None:
            self._await(guard, self._asked)
        elif self._states >= EVERY and self.client.service_is_ready():
            self._states = 0
            if config.load.in_motion or guard.is_at_rest:
                self.ask(guard.load_to_tell())

    def ask(self, load: DriveLoad | None) -> None:
        """Ask the service to accept a load in the tip, if it is one."""
        if load is None:
            return
        centre = (self.to_frame @ np.append(load.centre, 1.0))[:3]
        request = self.client.srv_type.Request()
        try:
            _FILLS[self._type](request, load.mass, centre * (load.mass > 0.0))
        except AttributeError as error:
            self._give_up(f'{self._name}: its request has other fields ({error})')
            return
        self._asked = load
        self._answer = self.client.call_async(request)

    def _await(self, guard: Guard, asked: DriveLoad) -> None:
        if not self._answer.done():
            if self._states > _PATIENCE:
                self._give_up(
                    f'{self._name} has not answered for {self._states} states'
                )
            return
        answer = self._answer.result()
        self._states = 0
        self._asked = None
        if not answer.success:
            why = getattr(answer, 'error', '') or 'it does not say why'
            self._give_up(f'{self._name} refused {asked.mass:.2f} kg: {why}')
            return
        self.told = asked
        guard.take_over(asked)

    def _give_up(self, problem: str) -> None:
        self.problem = problem
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
    'ur_msgs/srv/SetPayload': _fill_ur,
    'franka_msgs/srv/SetLoad': _fill_franka,
}
