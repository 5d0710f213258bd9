# SPDX-License-Identifier: Apache-2.0
"""What `blf_dsc drive` needs of a robot: facts, states in, torques or frames out.

A driver of your own is a Python file with a subclass of `Driver` that is called
`DRIVER`, named by the parameter `driver`.  It is made with the robot's address and both
configurations.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.drive import DriveConfig
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.tip_load import TipLoad
from blf_dsc_controller.motors.frame import Frame, Ranges

if TYPE_CHECKING:
    from blf_dsc_controller.control.arm_controller import ArmController
    from blf_dsc_controller.control.motion_input import MotionInput
    from blf_dsc_controller.supervision.load_declaration import LoadDeclaration

Vector = NDArray[np.float64]
_POLL = 0.01  # s


class DriverError(BlfDscError):
    """The robot cannot be reached, or refuses; the message says what to do."""


class ReflexError(DriverError):
    """The robot ended the motion by itself, such as after a collision."""


class ConnectionLostError(DriverError):
    """The robot sends no more states."""


class RobotState(NamedTuple):
    """What a robot reports in one cycle.

    The arrays have an entry for each of its n joints. Those of motors are recorded, and
    are not used.
    """

    stamp: float  # s, of the robot's clock
    q: ArrayLike  # rad
    dq: ArrayLike  # rad/s
    effort: ArrayLike  # N m, as `Facts.effort` says
    # positions and velocities (2, n) of motors whose links have encoders, too [rad, rad/s]
    motors: ArrayLike | None = None


class Facts(NamedTuple):
    """What is true of every robot of a kind; a configuration must agree with it."""

    joints: int
    period: float  # s, between two states
    drive_compensates: str  # as `robot.drive_compensates`
    effort: str  # as `robot.effort`
    torque_limit: Sequence[float]  # N m
    torque_rate: Sequence[float]  # N m/s, beyond which the robot stops by itself
    load_in_motion: bool = False  # whether it may be told a load while it moves


class Driver(ABC):
    """A robot with a torque interface.

    All methods may raise `DriverError`; between `start` and `finish` they raise
    `ReflexError` when the robot has stopped by itself, and `ConnectionLostError` when
    it has fallen silent.

    Attributes:
        facts: what is true of the robot.
        has_feedback: whether its motors close a PD of their own; then there is
            `write_frame`.
        latency: time [s] from a state until the robot acts on the answer.
        answers: whether it answers states by the controller itself, as the node over ROS
            does; then `read` returns those that are answered, or None for a moment without.
        worker: computes what takes long while the robot rests; None: there is time.
        problem: why the arm is to come to rest, and the run to end; empty while all is well.
    """

    facts: ClassVar[Facts]
    has_feedback: ClassVar[bool] = False
    latency: float = 0.0
    answers: ClassVar[bool] = False
    worker: Executor | None = None
    problem: str = ''

    @classmethod
    def facts_for(cls, controller: ControllerConfig) -> Facts:
        """Return what is true of the robot under a configuration: by default `facts`."""
        del controller
        return cls.facts

    def __init__(
        self, address: str, controller: ControllerConfig, config: DriveConfig
    ) -> None:
        """Keep what `connect` needs."""
        self.address = address
        self.controller = controller
        self.config = config

    @abstractmethod
    def connect(self) -> Sequence[str]:
        """Reach the robot, and set its thresholds and its load.

        Return remarks for the user.
        """

    @abstractmethod
    def positions(self) -> ArrayLike:
        """Return the positions (n,) [rad] of the robot at rest, before `start`."""

    def answer_by(  # noqa: B027 - for `answers`
        self, controller: ArmController, took: Callable[[float], None]
    ) -> None:
        """Answer states by this controller from the next `start` on.

        `took` is told the time [s] from each state to its torque.
        """

    @abstractmethod
    def start(self) -> None:
        """Begin to command torques.

        From now on the robot waits for one after each state.
        """

    @abstractmethod
    def read(self) -> RobotState | None:
        """Wait for the next state."""

    @abstractmethod
    def write(self, torque: Vector | None) -> None:
        """Command torques (n,) [N m]; None: whatever lets the robot go on as it is."""

    @property
    def inputs(self) -> MotionInput | None:
        """Where other programs send motions to the controller, if it is the driver that listens."""
        return None

    @property
    def declaration(self) -> LoadDeclaration | None:
        """What declares loads to the robot, if it is not `tell_load`."""
        return None

    @property
    def ranges(self) -> Ranges:
        """What a frame to the motors can carry; known once it is connected.

        Raises:
            DriverError: its motors take torques only.
        """
        raise _only_torques(type(self))

    def write_frame(self, frame: Frame) -> None:
        """Command position, velocity, gains and torque of each motor's own PD."""
        del frame
        raise _only_torques(type(self))

    def tell_load(self, load: TipLoad) -> None:
        """Declare this load, in the frame of the tip; called in another thread.

        Raises:
            DriverError: it refuses, or cannot be told.
        """
        raise DriverError(
            f'the driver of this robot cannot declare a load of {load.mass:.2f} kg: set '
            'load.tell_drive to false'
        )

    def load_in_force(self) -> float | None:
        """Return the mass [kg] whose weight the robot adds since the last state.

        None: it does not report it.
        """
        return None

    @abstractmethod
    def finish(self) -> None:
        """End the motion; the robot holds itself by its own means."""

    def wait(self, seconds: float) -> None:
        """Let time pass while the robot rests."""
        end = time.monotonic() + seconds
        self.wait_until(lambda: time.monotonic() > end)

    def wait_until(self, is_over: Callable[[], bool]) -> None:
        """Likewise, until something is so."""
        while not is_over():
            time.sleep(_POLL)

    def close(self) -> None:  # noqa: B027 - most have nothing to leave
        """Leave the robot, after the last `finish` or an error."""

    @abstractmethod
    def recover(self) -> None:
        """Make a robot that has stopped by itself ready for another start."""


def _only_torques(driver: type[Driver]) -> DriverError:
    return DriverError(
        f'drive.feedback: got motor, but {driver.__name__} commands torques only, so its motors '
        'cannot close the feedback: write host'
    )


def check_feedback(driver: type[Driver], config: DriveConfig) -> None:
    """Raise DriverError if the feedback is to be the motors', who have none."""
    if config.feedback == 'motor' and not driver.has_feedback:
        raise _only_torques(driver)


def disagreements(facts: Facts, config: ControllerConfig) -> list[str]:
    """Return where a configuration contradicts its robot, with remedies."""
    problems = []
    if len(config.joints) != facts.joints:
        problems.append(
            f'joints: got {len(config.joints)}, but the robot has {facts.joints}: give the URDF of '
            'this robot, or in drive.driver the driver of another'
        )
        return problems
    if config.sample_time_ns != round(facts.period * 1e9):
        problems.append(
            f'sample_time: got {config.sample_time:g} s, but the robot sends a state every '
            f'{facts.period:g} s: write {facts.period:g}'
        )
    for name, needed in (
        ('drive_compensates', facts.drive_compensates),
        ('effort', facts.effort),
    ):
        got = getattr(config.robot, name)
        if got != needed:
            problems.append(
                f'robot.{name}: got {got}, but of this robot it is {needed}: write {needed}. If '
                'the start is then rejected, since the states of a simulator do not show it, set '
                'safety.first_torque: send'
            )
    problems += _excesses('torque.limit', config.torque.limit, facts.torque_limit)
    rates = [rate or float('inf') for rate in config.torque.rate_limit]
    problems += _excesses('torque.rate_limit', rates, facts.torque_rate)
    return problems


def _excesses(name: str, given: Sequence[float], largest: Sequence[float]) -> list[str]:
    """Return a problem if a limit is above what the robot takes."""
    if all(got <= most for got, most in zip(given, largest, strict=True)):
        return []
    problem = (
        f'{name}: got {list(given)}, but the robot stops by itself beyond {list(largest)}: stay '
        'below'
    )
    return [problem]
