# SPDX-License-Identifier: Apache-2.0
"""An arm whose joint positions are the action; the guarded law follows them at its own rate."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any

import numpy as np
from lerobot.cameras.utils import make_cameras_from_configs
from lerobot.robots import Robot
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

import blf_dsc_controller as blf
from blf_dsc_controller.configuration.nodes import CONTROLLER, load, locate
from lerobot_robot_blf_dsc.config_blf_dsc import BlfDscConfig


class BlfDsc(Robot):
    """Positions in, states out.

    Observations are of each joint `.pos` [rad], `.vel` [rad/s] and `.torque` [N m]
    (commanded); `load` [kg] at the tip (0 until it is weighed), `contact` (1 while
    something touches the arm, with `contact.enabled`), and the cameras.  Actions are
    `.pos` [rad] of each joint.
    """

    config_class = BlfDscConfig
    name = 'blf_dsc'

    def __init__(self, config: BlfDscConfig) -> None:
        super().__init__(config)
        self.config = config
        self.cameras = make_cameras_from_configs(config.cameras)
        self._arm: blf.Drive | None = None
        self._is_open = False

    @cached_property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints, from the file: features are asked for without a robot."""
        path = locate(self.config.config)
        return load(path, CONTROLLER, blf.ControllerConfig).joints

    @cached_property
    def observation_features(self) -> dict[str, type | tuple]:
        """Names and types of what `get_observation` returns."""
        kinds = ('pos', 'vel', 'torque')
        names = [f'{joint}.{kind}' for kind in kinds for joint in self.joints]
        pictures = {
            name: (camera.height, camera.width, 3)
            for name, camera in self.config.cameras.items()
        }
        return dict.fromkeys([*names, 'load', 'contact'], float) | pictures

    @cached_property
    def action_features(self) -> dict[str, type]:
        """Names and types of what `send_action` takes."""
        return dict.fromkeys([f'{joint}.pos' for joint in self.joints], float)

    @property
    def is_connected(self) -> bool:
        """Whether the law is in command of the arm, and all cameras are connected."""
        commands = self._arm is not None and not self._arm.ended
        has_cameras = all(each.is_connected for each in self.cameras.values())
        return self._is_open and commands and has_cameras

    def connect(self, calibrate: bool = True) -> None:  # noqa: FBT001, FBT002, ARG002 - LeRobot's
        """Take command: the arm holds where it is; there is nothing to calibrate.

        After a stop, or after `disconnect`, take command again; a bag then has another
        number in its name.

        Raises:
            DriveError: file, robot or arm are not as they should be.
        """
        if self.is_connected:
            raise DeviceAlreadyConnectedError(f'{self} is already connected')
        if self._arm is None:
            record = self.config.record or None
            self._arm = blf.Drive(
                self.config.config, robot=self.config.address, record=record
            )
        else:
            self._arm.recover()
        self._is_open = True
        try:
            for camera in self.cameras.values():
                if not camera.is_connected:
                    camera.connect()
        except BaseException:
            self.disconnect()
            raise

    @property
    def is_calibrated(self) -> bool:
        """Always: the encoders are the driver's."""
        return True

    def calibrate(self) -> None:
        """Do nothing."""

    def configure(self) -> None:
        """Do nothing: the parameter file has all settings."""

    def get_observation(self) -> dict[str, Any]:
        """Return the state of some milliseconds ago, and the pictures.

        Raises:
            LoopEndedError: the controller or the robot has stopped.
        """
        state = self._connected().state
        found: dict[str, Any] = {}
        for kind, values in zip(
            ('pos', 'vel', 'torque'), (state.q, state.dq, state.tau), strict=True
        ):
            names = (f'{joint}.{kind}' for joint in self.joints)
            found |= dict(zip(names, values.tolist(), strict=True))
        found['load'] = 0.0 if math.isnan(state.load) else state.load
        found['contact'] = float(state.contact)
        for name, camera in self.cameras.items():
            found[name] = camera.async_read()
        return found

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Follow positions as the next ones of a stream; return what is followed.

        Raises:
            LoopEndedError: the controller or the robot has stopped.
            ValueError: the action lacks a joint, as one for another robot does.
        """
        arm = self._connected()
        names = list(self.action_features)
        lacking = [name for name in names if name not in action]
        if lacking:
            raise ValueError(
                f'action: got {", ".join(action) or "nothing"}, but {", ".join(lacking)} '
                f'{"is" if len(lacking) == 1 else "are"} needed, too [rad]'
            )
        wanted = {name: float(action[name]) for name in names}
        arm.stream(np.array(list(wanted.values())))
        return wanted

    def disconnect(self) -> None:
        """Bring the arm to rest; the robot then holds it by its own means."""
        arm = self._connected()
        self._is_open = False
        try:
            arm.close()
        finally:
            for camera in self.cameras.values():
                if camera.is_connected:
                    camera.disconnect()

    def _connected(self) -> blf.Drive:
        if self._arm is None or not self._is_open:
            raise DeviceNotConnectedError(f'{self} is not connected: call connect()')
        return self._arm
