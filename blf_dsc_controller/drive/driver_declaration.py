# SPDX-License-Identifier: Apache-2.0
"""Declares loads by a robot's driver, in a thread beside the loop."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor

from blf_dsc_controller.drive.driver import Driver, DriverError
from blf_dsc_controller.messages.tip_load import TipLoad
from blf_dsc_controller.supervision.load_declaration import (
    DeclarationError,
    LoadDeclaration,
)

_SAME = 1e-5  # kg; robots report single precision


class DriverDeclaration(LoadDeclaration):
    """Declares loads to a robot: as weighed, or as a script wants them.

    A load is in force from the state on that reports it.  If the robot reports no load, it is
    from the first state after the robot has accepted it.
    """

    def __init__(self, driver: Driver) -> None:
        super().__init__()
        self._driver = driver
        self._answer: Future[None] | None = None
        self._thread: ThreadPoolExecutor | None = None

    def declare(self, load: TipLoad) -> None:
        """Tell the driver, in the thread."""
        self._thread = self._thread or ThreadPoolExecutor(1, 'load')
        self._answer = self._thread.submit(self._driver.tell_load, load)

    def is_in_force(self, load: TipLoad) -> bool:
        """Whether the robot reports this load, or has accepted it and reports none.

        Raises:
            DeclarationError: it has refused the load.
        """
        assert self._answer is not None  # noqa: S101 - for mypy
        is_answered = self._answer.done()
        error = self._answer.exception() if is_answered else None
        if isinstance(error, DriverError):
            raise DeclarationError(str(error)) from error
        if error is not None:
            raise error
        mass = self._driver.load_in_force()
        return is_answered if mass is None else abs(mass - load.mass) < _SAME

    def close(self) -> None:
        """Wait for the last answer."""
        if self._thread is not None:
            self._thread.shutdown()
