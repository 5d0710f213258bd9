# SPDX-License-Identifier: Apache-2.0
"""Declares the weighed load to a robot, step by step, in a thread beside the loop."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor

from blf_dsc_controller.control.arm_controller import ArmController
from blf_dsc_controller.drive.driver import Driver, DriverError
from blf_dsc_controller.supervision.drive_load import EVERY, DriveLoad

_SAME = 1e-5  # kg; robots report single precision


class LoadTeller:
    """What a robot is told of its load: as weighed, or as a script declares it.

    A step of the load counts for the law from the state on that reports it.  If the robot reports
    no load, it counts from the first state after the robot has accepted it.

    Attributes:
        problem: why the robot is told nothing more, or empty.
    """

    def __init__(self, driver: Driver, controller: ArmController) -> None:
        self.problem = ''
        self._driver = driver
        self._controller = controller
        self._asked: DriveLoad | None = None
        self._answer: Future[None] | None = None
        self._states = 0
        self._in_motion = driver.facts_for(controller.config).load_in_motion
        self._thread: ThreadPoolExecutor | None = None

    def follow(self) -> None:
        """Take over what the robot adds since the last state; ask for the next step."""
        if self.problem:
            return
        if self._asked is not None:
            self._await(self._asked)
            return
        self._states += 1
        if self._states % EVERY:
            return
        if self._in_motion or self._controller.is_at_rest:
            self._asked = self._controller.load_to_tell()
            if self._asked is not None:
                self._thread = self._thread or ThreadPoolExecutor(1, 'load')
                self._answer = self._thread.submit(self._driver.tell_load, self._asked)

    def _await(self, asked: DriveLoad) -> None:
        """Take a step over once it is in force."""
        assert self._answer is not None  # noqa: S101 - for mypy
        is_answered = self._answer.done()
        error = self._answer.exception() if is_answered else None
        if isinstance(error, DriverError):
            self.problem = str(error)
            return
        if error is not None:
            raise error
        mass = self._driver.load_in_force()
        if is_answered if mass is None else abs(mass - asked.mass) < _SAME:
            self._controller.take_over(asked)
            self._asked = None

    def close(self) -> None:
        """Wait for the last answer."""
        if self._thread is not None:
            self._thread.shutdown()
