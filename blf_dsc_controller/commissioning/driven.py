# SPDX-License-Identifier: Apache-2.0
"""Commissioning of a robot over its driver: each run is one of `drive.loop`.

Between two of them the robot holds itself by its own means.
"""

from __future__ import annotations

import time
from pathlib import Path

from numpy.typing import ArrayLike

from blf_dsc_controller.commissioning.commissioning import Commissioning
from blf_dsc_controller.commissioning.postures import PostureByPosture
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.control.arm_controller import ArmController
from blf_dsc_controller.drive.driver import Driver
from blf_dsc_controller.drive.loop import DriveLoop, End


class Driven(PostureByPosture):
    """A robot with a driver of this package."""

    def __init__(
        self,
        driver: Driver,
        commissioning: Commissioning,
        folder: Path,
    ) -> None:
        """Use a connected driver, and write bags into `folder`."""
        super().__init__(commissioning, folder)
        self._driver = driver
        self._loop: DriveLoop | None = None

    def request_end(self) -> None:
        """Bring the arm to rest and end; a second request ends at once."""
        super().request_end()
        if self._loop is not None:
            self._loop.request_end()

    def _positions(self) -> ArrayLike:
        return self._driver.positions()

    def _pause(self, seconds: float) -> None:
        time.sleep(seconds)

    def _control(
        self, config: ControllerConfig, duration: float, bag: Path, name: str
    ) -> None:
        with ArmController(config, record=bag, stamps='wall') as controller:
            self._loop = DriveLoop(
                self._driver,
                controller,
                duration=duration,
                settle_time=self._driver.config.settle_time,
                feedback='host',  # what moves the arm is the torque alone, as recorded
            )
            if self._requests:
                raise self._ended(name, End.REQUESTED, '', None)
            outcome = self._loop.run()
            self._loop = None
        if outcome.end is not End.DURATION:
            raise self._ended(name, outcome.end, outcome.text, controller.guard)
        if controller.output_problem:
            raise self._not_whole(name)
