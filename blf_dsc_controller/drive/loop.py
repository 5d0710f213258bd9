# SPDX-License-Identifier: Apache-2.0
"""The loop on a robot: a torque for each state, and an end at rest whatever happens.

    read -> ArmController -> write          while it runs
    read -> safe torque   -> write          to the end: on request, after a fault or an error
    finish                                  at rest, or after `settle_time`

A robot that stops by itself is made ready for the next start, but its motion is not
resumed.
"""

from __future__ import annotations

import math
from contextlib import nullcontext
from enum import Enum
from time import perf_counter
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.control.arm_controller import ArmController
from blf_dsc_controller.control.realtime import undisturbed_loop
from blf_dsc_controller.drive.beside import Beside
from blf_dsc_controller.drive.driver import (
    ConnectionLostError,
    Driver,
    DriverError,
    ReflexError,
    RobotState,
)
from blf_dsc_controller.drive.driver_declaration import DriverDeclaration
from blf_dsc_controller.drive.latency import Latency
from blf_dsc_controller.drive.motor_feedback import MotorFeedback
from blf_dsc_controller.supervision.supervisor import Phase, Reason

Vector = NDArray[np.float64]


class End(str, Enum):
    """Why a run ended."""

    __str__ = str.__str__

    DURATION = 'the duration is over'
    REQUESTED = 'ended on request'
    STOPPED = 'the controller stopped'
    REFLEX = 'the robot stopped by itself'
    LOST = 'the connection was lost'


class Outcome(NamedTuple):
    """How a run ended.

    `text` has the reason in words, empty after one that was planned.
    """

    end: End
    text: str
    states: int


class DriveLoop:
    """A controller on a robot.

    Attributes:
        latency: of the torques, from the return of `read` to that of `write`.
        worst: largest tracking error so far, relative to its bound.
        worst_at_tool: largest error at the tool so far [m]; NaN without a bound there.
    """

    def __init__(
        self,
        driver: Driver,
        controller: ArmController,
        *,
        duration: float = math.inf,
        beside: Beside | None = None,
        feedback: Literal['host', 'motor'] = 'host',
    ) -> None:
        """Run for `duration` [s] of the robot's time, with what is beside the loop.

        The end may take `drive.settle_time` more.  The driver is connected; `feedback` is
        `drive.feedback`.

        Raises:
            BlfDscError: `drive.feedback` is motor, and the driver takes torques only, or
                the law is one of a file.
        """
        self.latency = Latency()
        self.worst = 0.0
        self.worst_at_tool = math.nan
        self._driver = driver
        self._controller = controller
        self._duration = duration
        self._settle_time = driver.config.settle_time
        self._declaration = driver.declaration or DriverDeclaration(driver)
        self._load_in_motion = driver.facts_for(controller.config).load_in_motion
        self._feedback: MotorFeedback | None = None
        if feedback == 'motor':
            self._feedback = MotorFeedback(controller, driver.ranges, driver.latency)
        self._beside = beside
        self._requests = 0
        self._states = 0
        self._stamp = math.nan  # s, of the last state
        self._received = 0.0  # s, when `read` returned last
        self._begin = math.nan  # s, stamp of the first state
        self._end: End | None = None
        self._end_at = math.nan  # s, stamp at which the end began
        self._text = ''
        self._error: Exception | None = None

    @property
    def remark(self) -> str:
        """Why the robot is told no more loads, or empty."""
        return self._declaration.problem

    def request_end(self) -> None:
        """Bring the arm to rest and end, as for a signal; a second request ends at once."""
        self._requests += 1

    def run(self) -> Outcome:
        """Control the robot until the end.

        Raises:
            DriverError: the robot refused to start.
            StartError: the law cannot take over where the arm is.
            MotionError: no approach from there keeps the limits.
            Exception: an error of the controller, after the arm was brought to rest.
        """
        try:
            # a node is undisturbed from its start on: it holds the arm between two runs, too
            with nullcontext() if self._driver.answers else undisturbed_loop():
                self._controller.prepare(self._driver.positions())
                self._driver.answer_by(self._controller, self.latency.add)
                self._driver.start()
                self._control()
        except ReflexError as error:
            self._withdraw(End.REFLEX, str(error))
            self._recover()
        except ConnectionLostError as error:
            self._withdraw(End.LOST, str(error))
        finally:
            if isinstance(self._declaration, DriverDeclaration):
                self._declaration.close()
        if self._error is not None:
            raise self._error
        return Outcome(self._end or End.REQUESTED, self._text, self._states)

    def _control(self) -> None:
        """Answer states until the arm rests, then end the motion."""
        try:
            while not self._is_over(state := self._driver.read()):
                self._received = perf_counter()
                self._step(state)
        except (ReflexError, ConnectionLostError):
            raise
        except BaseException:
            self._driver.finish()
            raise
        self._driver.finish()

    def _step(self, state: RobotState | None) -> None:
        """Answer a state, if there is one.

        The first error leads to the safe torque, a second one ends the run.
        """
        try:
            if state is not None:
                self._states += 1
                self._stamp = state.stamp
                self._answer(state)
            if self._beside is not None:
                self._beside.follow()
        except DriverError:
            raise
        except Exception as error:
            if self._error is not None:
                raise self._error from error
            self._error = error
            text = f'{type(error).__name__}: {error}'
            self._send(self._controller.fail(text))
            self._begin_end(End.STOPPED, text)
            return
        self._watch()

    def _answer(self, state: RobotState) -> None:
        """Let the controller answer a state, unless the driver has done so."""
        if self._driver.declaration is None:
            self._declaration.follow(self._controller, in_motion=self._load_in_motion)
        if not self._driver.answers:
            self._controller.update(*state, send=self._send)

    def _send(self, torque: Vector | None) -> None:
        if torque is None or self._feedback is None:
            self._driver.write(torque)
        else:
            self._driver.write_frame(self._feedback.frame(torque))
        self.latency.add(perf_counter() - self._received)

    def _watch(self) -> None:
        """Begin the end if it is time, or if the controller has stopped."""
        if math.isnan(self._begin):
            self._begin = self._stamp
        if self._end is not None:
            return
        controller = self._controller
        if controller.guard.has_sample:
            ratio = abs(controller.error) / controller.bound
            self.worst = max(self.worst, float(ratio.max()))
            at_tool = controller.tool.error
            self.worst_at_tool = float(np.fmax(self.worst_at_tool, at_tool))
        if controller.phase is Phase.SAFE_STOP:
            is_lost = controller.guard.supervisor.reason is Reason.STATE_TIMEOUT
            self._begin_end(End.LOST if is_lost else End.STOPPED, controller.reason)
        elif controller.phase is Phase.INACTIVE:
            self._begin_end(End.REQUESTED, 'somebody deactivated the node')
        elif self._requests:
            controller.stop()
            self._begin_end(End.REQUESTED)
        elif self._driver.problem:
            controller.stop()
            self._begin_end(End.STOPPED, self._driver.problem)
        elif self._stamp - self._begin >= self._duration:
            controller.stop()
            self._begin_end(End.DURATION)

    def _begin_end(self, end: End, text: str = '') -> None:
        if self._end is None:
            self._end = end
            self._text = text
            self._end_at = self._stamp

    def _is_over(self, state: RobotState | None) -> bool:
        """Whether the arm rests under the safe torque, or its time is over."""
        if self._requests > 1:
            return True
        if self._end is None:
            return False
        stamp = self._stamp if state is None else state.stamp
        is_late = stamp - self._end_at > self._settle_time
        return is_late or self._controller.is_settled

    def _withdraw(self, end: End, text: str) -> None:
        """Note that the robot takes no more torques."""
        self._end = None
        self._begin_end(end, text)
        self._controller.withdraw(text)

    def _recover(self) -> None:
        try:
            self._driver.recover()
        except DriverError as error:
            self._text += f'; {error}'
        else:
            self._text += '; it has recovered, and may be started again'
